"""The documentation contains every page, public name and command, and builds without warnings."""

import importlib.util
import re
import runpy
from pathlib import Path

import cv2
import figures
import pytest
from shown_output import differing_lines

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def docs():
    return runpy.run_path(str(ROOT / "scripts" / "docs.py"))


def test_every_page_is_in_the_navigation(docs, tmp_path):
    pytest.importorskip("nbconvert")
    pytest.importorskip("ziamath")
    navigation = docs["write_sources"](tmp_path / "sources")
    sections = {title: pages for section in navigation for title, pages in section.items()}
    listed = [page for title in ("Tutorials", "Guides", "Method", "Development") for page in sections[title]]
    reference = [page for entry in sections["Reference"] for page in entry.values()]
    outside = {"CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"}
    pages = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")} | outside
    pages |= {f"notebooks/{path.stem}.md" for path in (ROOT / "docs" / "notebooks").glob("*.ipynb")}
    assert sorted(listed) == sorted(pages - {"commands.md", "configuration.md"})
    assert sections["Guides"][0] == "quickstart.md"
    assert [Path(page).stem for page in sections["Tutorials"]] == ["satellite", "video", "training", "first_vibration"]
    assert set(reference) == {"configuration.md", "commands.md"} | {f"api/{name}.md" for name in docs["public_names"]()}


def test_pages_are_plain_markdown():
    """Without admonitions, tabs, icons, attribute lists and macros of a builder, so that another one can be used."""
    special = re.compile(r"^(?:!!!|\?\?\?|===) |:(?:material|octicons|fontawesome)-|\{: |\{%|--8<--", re.MULTILINE)
    pages = [*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")]
    assert len(pages) > 20
    assert [path.name for path in pages if special.search(path.read_text(encoding="utf-8"))] == []


def test_reference_pages_are_up_to_date():
    pytest.importorskip("griffe")
    for path, text in runpy.run_path(str(ROOT / "scripts" / "reference_pages.py"))["pages"]().items():
        assert path.read_text(encoding="utf-8") == text, f"{path.name} is out of date: make pages"


def test_page_on_tables_runs_and_prints_what_it_shows(tmp_path):
    """Its simulated tones are in every table."""
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    pages = runpy.run_path(str(ROOT / "scripts" / "run_pages.py"))
    page = ROOT / "docs" / "tables.md"
    text, names = pages["run_page"](page, tmp_path)
    assert not differing_lines(page.read_text(encoding="utf-8"), text), "out of date: make pages"
    assert names["tones"].frequency_Hz.tolist() == pytest.approx([137.0, 411.0, 90.5], abs=0.05)
    assert names["tones"].amplitude_um.tolist() == pytest.approx([15.0, 5.0, 8.75], rel=0.02)
    written = {path.name for path in (tmp_path / "found").iterdir()}
    assert written == {"vibration.json", "tones.csv", "offsets.csv", "offsets.png", "spectrum.csv", "spectrum.png"}


def test_drawings_are_files_of_the_documentation(tmp_path):
    figures.main(["--drawings", "--out", str(tmp_path)])
    drawn = {path.name for path in (tmp_path / "drawings").iterdir()}
    assert drawn == {path.name for path in (ROOT / "docs" / "drawings").iterdir()}
    used = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md"))
    assert all(f"](drawings/{name})" in used for name in drawn)


def test_figures_are_drawn_and_on_a_page(tmp_path):
    short = ("gallery/kernels", "gallery/training_data")
    figures.main(["--out", str(tmp_path), "--only", *short])
    for name in short:
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 10
    assert {path.stem for path in (ROOT / "docs" / "gallery").glob("*.png")} == {
        name.removeprefix("gallery/") for name in figures.PICTURES if name.startswith("gallery/")
    }
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))
    assert all(f"]({name}." in pages for name in figures.PICTURES)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mkdocstrings") is None, reason="MkDocs is not installed (extra docs)")
def test_site_builds_without_a_warning(docs, tmp_path):
    site = tmp_path / "site"
    docs["main"](["--out", str(site)])
    assert "RollingShutterVibration" in (site / "api" / "augmentation.html").read_text(encoding="utf-8")
    assert (site / "ml_pipeline.html").exists()
    index = (site / "search" / "search_index.js").read_text(encoding="utf-8")
    assert len(index) > 100_000  # the search also works without a server
    assert "RollingShutterVibration" in index
    resource = re.compile(r'<(?:script|link|img)[^>]*(?:src|href)="(?:https?:)?//')
    pages = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    assert not [path for path, text in pages.items() if resource.search(text)]  # no resources from the network
    assert 'src="iframe-worker.js"' in pages[site / "index.html"]
    assert pages[site / "bound.html"].count("<math") > 20
    assert '<span class="k">import</span>' in pages[site / "tutorials" / "training.html"] or (
        '<span class="kn">import</span>' in pages[site / "tutorials" / "training.html"]
    )
    assert pages[site / "notebooks" / "first_vibration.html"].count("<img") >= 3
