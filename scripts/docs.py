#!/usr/bin/env python
"""Build the documentation as a site: the pages in docs/, and a reference of the public names.

Needs the extra ``docs``: ``.venv/bin/python -m pip install -c scripts/constraints.txt -e '.[docs]'``. Warnings are
errors: a broken link, or a docstring with a parameter that its function does not have, fails the build. The site works
without a network and without a server, its search included; it is written to out/site.
"""

import argparse
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import rsvib_torch as rsv

ROOT = Path(__file__).resolve().parents[1]
# Names that the code of these pages uses are first in the reference, in the order of their first use.
PAGES = ("README.md", "docs/quickstart.md", "docs/tutorials/satellite.md", "docs/tutorials/training.md")
USED = re.findall(r"\brsv\.(\w+)", "".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES))
# Sections of the site and the order of their pages; pages that are missing here are added to the last section.
SECTIONS = {
    "Tutorials": "tutorials/satellite tutorials/video tutorials/training notebooks/first_vibration",
    "Guides": "quickstart concepts tables your_own_camera roll_and_zoom finer_grid gyroscope live stacks export "
    "reliability ml_pipeline measuring gallery",
    "Method": "method conventions verdicts reasons bound accuracy benchmarks",
    "Development": "architecture ablation CONTRIBUTING SECURITY CHANGELOG",
}
DOCUMENTATION = ROOT / "scripts" / "documentation"  # settings and extensions of the builder, and files of the site
STYLE, SEARCH_SHIM = "site.css", "iframe-worker.js"
BUILDERS = ("mkdocs", "mkdocstrings", "material", "nbconvert", "latex2mathml", "ziamath")
OUTSIDE_DOCS = ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")  # pages that lie at the top level of the project


def public_names() -> dict[str, list[str]]:
    """Public names with their full paths, by package, in the order of ``USED``."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in sorted(rsv.__all__, key=lambda name: (USED.index(name) if name in USED else len(USED), name)):
        thing = getattr(rsv, name)
        found[thing.__module__.split(".")[1]].append(f"{thing.__module__}.{name}")
    return found


def reference_page(package: str, paths: list[str]) -> str:
    """Markdown of one page of the reference."""
    module = sys.modules[f"rsvib_torch.{package}"]
    lines = [f"# {package}", "", inspect.getdoc(module) or "", ""]
    return "\n".join([*lines, *(f"::: {path}\n" for path in paths)])


def without_outer_links(text: str, folder: Path) -> str:
    """Markdown whose links to files and folders of the project that are no pages are plain text."""

    def kept(link: re.Match[str]) -> str:
        target = link[2].split("#")[0]
        outer = "://" not in target and not (folder / target).exists() and (ROOT / target).exists()
        return link[1] if outer else link[0]

    return re.sub(r"\[([^\]\n]+)\]\(([^)\s]+)\)", kept, text)


def notebook_page(notebook: Path) -> None:
    """Write a notebook with its stored outputs as a page, with its pictures in a folder beside it, and remove it."""
    from nbconvert import MarkdownExporter  # part of the extra docs # noqa: PLC0415

    text, resources = MarkdownExporter().from_filename(str(notebook), {"output_files_dir": notebook.stem})
    notebook.with_suffix(".md").write_text(text, encoding="utf-8")
    for name, data in resources["outputs"].items():
        (notebook.parent / name).parent.mkdir(exist_ok=True)
        (notebook.parent / name).write_bytes(data)
    notebook.unlink()


def write_sources(folder: Path) -> list[object]:
    """Fill a folder with the pages of the site; returns its navigation."""
    shutil.copytree(ROOT / "docs", folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".ipynb_checkpoints"))
    for notebook in folder.rglob("*.ipynb"):
        notebook_page(notebook)
    for name, page in (("README.md", "index.md"), *((name, name) for name in OUTSIDE_DOCS)):
        shutil.copy(ROOT / name, folder / page)
    for page in folder.glob("*.md"):
        text = page.read_text(encoding="utf-8").replace("](docs/", "](").replace("](../README.md", "](index.md")
        text = text.replace(".ipynb)", ".md)")
        page.write_text(without_outer_links(text, folder), encoding="utf-8")
    fonts = find_spec("ziamath")  # its import warns
    assert fonts is not None
    assert fonts.origin is not None
    font = Path(fonts.origin).parent / "fonts" / "STIXTwoMath-Regular.ttf"
    for path in (DOCUMENTATION / STYLE, DOCUMENTATION / SEARCH_SHIM, font):
        shutil.copy(path, folder)
    (folder / "api").mkdir()
    reference: list[object] = [{"Configuration": "configuration.md"}, {"Commands": "commands.md"}]
    for package, paths in public_names().items():
        (folder / "api" / f"{package}.md").write_text(reference_page(package, paths), encoding="utf-8")
        reference.append({f"rsvib_torch.{package}": f"api/{package}.md"})
    pages = {str(page.relative_to(folder)) for page in folder.rglob("*.md") if page.parent.name != "api"}
    existing = pages - {"index.md", "commands.md", "configuration.md"}
    sections = {
        title: [page for name in names.split() if (page := f"{name}.md") in existing]
        for title, names in SECTIONS.items()
    }
    sections["Development"] += sorted(existing - {page for pages in sections.values() for page in pages})
    navigation: list[object] = [{"Home": "index.md"}]
    for title, section in sections.items():
        navigation += [{"Reference": reference}] if title == "Method" else []
        navigation.append({title: section})
    return navigation


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "site", help="folder (default: out/site)")
    options = parser.parse_args(arguments)
    if any(find_spec(name) is None for name in BUILDERS):
        parser.error("MkDocs is missing: .venv/bin/python -m pip install -c scripts/constraints.txt -e '.[docs]'")
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder) / "site"
        sources = Path(folder) / "sources"
        navigation = write_sources(sources)
        config = Path(folder) / "mkdocs.yml"
        folders = {"docs_dir": str(sources), "site_dir": str(site)}
        settings = {"INHERIT": str(DOCUMENTATION / "mkdocs.yml"), **folders, "nav": navigation}
        config.write_text(json.dumps(settings), encoding="utf-8")  # JSON is YAML
        command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--clean", "-f", str(config)]
        paths = [str(DOCUMENTATION), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        # the theme prints an advertisement of another builder without NO_MKDOCS_2_WARNING
        variables = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "NO_MKDOCS_2_WARNING": "1"}
        code = subprocess.run(command, check=False, env=variables).returncode
        if code:
            raise SystemExit(code)
        shutil.copytree(site, options.out, dirs_exist_ok=True)
    print(f"the site is in {options.out}")


if __name__ == "__main__":
    main()
