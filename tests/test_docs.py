"""The site of the documentation: every page and every public name has its place; it builds where MkDocs is there."""

import importlib.util
import runpy
from pathlib import Path

import pytest

import rsvib_torch as rsv

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def docs():
    return runpy.run_path(str(ROOT / "scripts" / "docs.py"))


def test_pages_come_in_order_and_none_is_left_out(docs, tmp_path):
    _, guide, reference, _ = docs["write_sources"](tmp_path / "sources")
    pages = guide["Guide"]
    assert sorted(pages) == sorted(path.name for path in (ROOT / "docs").glob("*.md"))
    assert pages[0] == "method.md"
    assert {page for entry in reference["Reference"] for page in entry.values()} == {
        f"api/{room}.md" for room in docs["rooms"]()
    }
    assert docs["ordered"](["new", "b", "a"], ("b", "a")) == ["b", "a", "new"]


def test_every_public_name_is_in_the_reference(docs):
    paths = [path for room in docs["rooms"]().values() for path in room]
    assert sorted(path.rsplit(".", 1)[1] for path in paths) == sorted(rsv.__all__)


def test_links_out_of_the_site_are_plain_text(docs, tmp_path):
    (tmp_path / "method.md").touch()
    text = "[configs](configs) [the method](method.md#signs) [web](https://example.org) [lost](nowhere.md)"
    expected = "configs [the method](method.md#signs) [web](https://example.org) [lost](nowhere.md)"
    assert docs["without_outer_links"](text, tmp_path) == expected


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is not None, reason="MkDocs is there")
def test_missing_builder_is_named(docs, capsys):
    with pytest.raises(SystemExit, match="2"):
        docs["main"]([])
    assert "pip install -c scripts/constraints.txt -e '.[docs]'" in capsys.readouterr().err


@pytest.mark.skipif(importlib.util.find_spec("mkdocstrings") is None, reason="MkDocs is not there (extra docs)")
def test_site_builds_without_a_warning(docs, tmp_path):
    docs["main"](["--out", str(tmp_path / "site")])
    page = (tmp_path / "site" / "api" / "augmentation" / "index.html").read_text(encoding="utf-8")
    assert "RollingShutterVibration" in page
    assert (tmp_path / "site" / "ml_pipeline" / "index.html").exists()
