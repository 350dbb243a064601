"""The gallery: every picture is on the page, and those with short computations are drawn."""

import runpy
import sys
from pathlib import Path

import cv2

ROOT = Path(__file__).parents[1]


def test_pictures_are_drawn_and_on_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["gallery.py", "--out", str(tmp_path), "--only", "kernels", "training_data"])
    script = runpy.run_path(str(ROOT / "scripts" / "gallery.py"), run_name="gallery")
    script["main"]()
    for name in ("kernels", "training_data"):
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 10
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert sorted(path.stem for path in (ROOT / "docs" / "gallery").glob("*.png")) == sorted(script["PICTURES"])
    assert all(f"](gallery/{name}.png)" in page for name in script["PICTURES"])
