#!/usr/bin/env python
"""Build the documentation as a site: the pages in docs/, and a reference of the public names.

Needs the extra ``docs``: ``.venv/bin/python -m pip install -c scripts/constraints.txt -e '.[docs]'``. Warnings are
errors: a broken link, or a docstring with a parameter that its function does not have, fails the build. The site works
without a network and has a search; it is written to out/site.
"""

import argparse
import inspect
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path

import rsvib_torch as rsv

ROOT = Path(__file__).resolve().parents[1]
# Order of the packages in the reference; others follow in alphabetical order.
PACKAGES = (
    "motion",
    "detection",
    "restoration",
    "imaging",
    "registration",
    "calibration",
    "io",
    "stacks",
    "evaluation",
    "augmentation",
)
# Sections of the site and the order of their pages; pages that are missing here are added to the last section.
SECTIONS = {
    "Guides": (
        "quickstart.md",
        "concepts.md",
        "your_own_camera.md",
        "roll_and_zoom.md",
        "stacks.md",
        "reliability.md",
        "ml_pipeline.md",
        "measuring.md",
        "gallery.md",
    ),
    "Method": ("method.md", "conventions.md", "verdicts.md", "bound.md", "accuracy.md", "benchmarks.md"),
    "Development": ("architecture.md", "ablation.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"),
}
STYLE = "site.css"  # wide pages, and tables that wrap
OUTSIDE_DOCS = ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")  # pages that lie at the top level of the project


def ordered(names: Iterable[str], order: Sequence[str]) -> list[str]:
    """Names in this order, and what it does not hold behind, sorted."""
    return sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))


def public_names() -> dict[str, list[str]]:
    """Public names with their full paths, by package."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in rsv.__all__:
        thing = getattr(rsv, name)
        found[thing.__module__.split(".")[1]].append(f"{thing.__module__}.{name}")
    return {package: found[package] for package in ordered(found, PACKAGES)}


def reference_page(package: str, paths: list[str]) -> str:
    """Markdown of one page of the reference."""
    module = sys.modules[f"rsvib_torch.{package}"]
    lines = [f"# {package}", "", inspect.getdoc(module) or "", ""]
    for path in sorted(paths, key=str.casefold):
        lines += [f"::: {path}", ""]
    return "\n".join(lines)


def without_outer_links(text: str, folder: Path) -> str:
    """Markdown whose links to files and folders of the project that are no pages are plain text."""

    def kept(link: re.Match[str]) -> str:
        target = link[2].split("#")[0]
        outer = "://" not in target and not (folder / target).exists() and (ROOT / target).exists()
        return link[1] if outer else link[0]

    return re.sub(r"\[([^\]\n]+)\]\(([^)\s]+)\)", kept, text)


def write_sources(folder: Path) -> list[object]:
    """Fill a folder with the pages of the site; returns its navigation."""
    shutil.copytree(ROOT / "docs", folder, dirs_exist_ok=True)
    for name, page in (("README.md", "index.md"), *((name, name) for name in OUTSIDE_DOCS)):
        shutil.copy(ROOT / name, folder / page)
    for page in folder.glob("*.md"):
        text = page.read_text(encoding="utf-8").replace("](docs/", "](").replace("](../README.md", "](index.md")
        page.write_text(without_outer_links(text, folder), encoding="utf-8")
    (folder / STYLE).write_text(
        ".wy-nav-content {max-width: 60rem} .wy-table-responsive table td {white-space: normal}"
    )
    (folder / "api").mkdir()
    reference: list[object] = [{"Configuration": "configuration.md"}, {"Commands": "commands.md"}]
    for package, paths in public_names().items():
        (folder / "api" / f"{package}.md").write_text(reference_page(package, paths), encoding="utf-8")
        reference.append({f"rsvib_torch.{package}": f"api/{package}.md"})
    existing = {page.name for page in folder.glob("*.md")} - {"index.md", "commands.md", "configuration.md"}
    sections = {title: [page for page in pages if page in existing] for title, pages in SECTIONS.items()}
    sections["Development"] += sorted(existing - {page for pages in sections.values() for page in pages})
    return [
        {"Home": "index.md"},
        {"Guides": sections["Guides"]},
        {"Reference": reference},
        {"Method": sections["Method"]},
        {"Development": sections["Development"]},
    ]


def settings(sources: Path, navigation: list[object], site: Path) -> dict[str, object]:
    """Configuration of MkDocs."""
    options = {
        "docstring_style": "google",
        "extensions": [str(ROOT / "scripts" / "documentation" / "examples.py")],
        "show_source": False,
        "show_root_heading": True,
        "show_root_full_path": False,
        "show_root_toc_entry": True,
        "merge_init_into_class": True,
        "members_order": "source",
        "filters": ["!^_"],
        "separate_signature": True,
        "show_signature_annotations": True,
    }
    return {
        "site_name": "rsvib_torch",
        "docs_dir": str(sources),
        "site_dir": str(site),
        "nav": navigation,
        "validation": {"unrecognized_links": "warn", "anchors": "warn", "absolute_links": "warn"},
        # without highlightjs the theme loads nothing from the network
        "theme": {"name": "readthedocs", "highlightjs": False, "navigation_depth": 3},
        "extra_css": [STYLE],
        "markdown_extensions": ["tables", "fenced_code", {"codehilite": {"noclasses": True, "guess_lang": False}}],
        "plugins": [
            "search",
            {"mkdocstrings": {"handlers": {"python": {"paths": [str(ROOT)], "options": options}}}},
        ],
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=ROOT / "out" / "site", help="folder of the site (default: out/site)"
    )
    options = parser.parse_args(arguments)
    if any(find_spec(name) is None for name in ("mkdocs", "mkdocstrings")):
        parser.error("MkDocs is missing: .venv/bin/python -m pip install -c scripts/constraints.txt -e '.[docs]'")
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder) / "site"
        sources = Path(folder) / "sources"
        navigation = write_sources(sources)
        config = Path(folder) / "mkdocs.yml"
        # JSON is YAML
        config.write_text(json.dumps(settings(sources, navigation, site)), encoding="utf-8")
        command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--clean", "-f", str(config)]
        code = subprocess.run(command, check=False).returncode
        if code:
            raise SystemExit(code)
        shutil.copytree(site, options.out, dirs_exist_ok=True)
    print(f"the site is in {options.out}")


if __name__ == "__main__":
    main()
