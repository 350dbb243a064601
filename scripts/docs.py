#!/usr/bin/env python
"""Build the documentation as a site: README, the pages in docs/, and a reference of the public API from its docstrings.

Needs the extra ``docs``: ``.venv/bin/python -m pip install -c scripts/constraints.txt -e '.[docs]'``. Warnings are
errors: a link that leads nowhere, or a docstring that names a parameter which its function does not have, fails the
build. The site is left in out/site.
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
# the order to read them in; others follow
ROOMS = (
    "sensor",
    "vibration",
    "free_motion",
    "motion_file",
    "calibration",
    "imaging",
    "registration",
    "detection",
    "restoration",
    "evaluation",
    "augmentation",
    "stacks",
)
PAGES = (
    "method.md",
    "conventions.md",
    "accuracy.md",
    "bound.md",
    "measuring.md",
    "gallery.md",
    "your_own_camera.md",
    "stacks.md",
    "ml_pipeline.md",
)


def ordered(names: Iterable[str], order: Sequence[str]) -> list[str]:
    """Names in this order, and what it does not hold behind, sorted."""
    return sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))


def rooms() -> dict[str, list[str]]:
    """Public names with their full paths, by the part of the package they come from."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in rsv.__all__:
        thing = getattr(rsv, name)
        found[thing.__module__.split(".")[1]].append(f"{thing.__module__}.{name}")
    return {room: found[room] for room in ordered(found, ROOMS)}


def title(room: str) -> str:
    """Heading of a part of the package."""
    return room.replace("_", " ").capitalize()


def reference_page(room: str, paths: list[str]) -> str:
    """Markdown of one page of the reference."""
    package = sys.modules[f"rsvib_torch.{room}"]
    lines = [f"# {title(room)}", "", inspect.getdoc(package) or "", ""]
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
    for name, page in (("README.md", "index.md"), ("CHANGELOG.md", "CHANGELOG.md")):
        shutil.copy(ROOT / name, folder / page)
    for page in folder.glob("*.md"):
        text = page.read_text(encoding="utf-8").replace("](docs/", "](").replace("](../README.md", "](index.md")
        page.write_text(without_outer_links(text, folder), encoding="utf-8")
    (folder / "api").mkdir()
    reference = []
    for room, paths in rooms().items():
        (folder / "api" / f"{room}.md").write_text(reference_page(room, paths), encoding="utf-8")
        reference.append({title(room): f"api/{room}.md"})
    guide = ordered((page.name for page in (ROOT / "docs").glob("*.md")), PAGES)
    return [{"Home": "index.md"}, {"Guide": guide}, {"Reference": reference}, {"Changes": "CHANGELOG.md"}]


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
        "theme": {"name": "readthedocs"},
        "markdown_extensions": ["tables", "fenced_code"],
        "plugins": [{"mkdocstrings": {"handlers": {"python": {"paths": [str(ROOT)], "options": options}}}}],
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
