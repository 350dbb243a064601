"""The figures of the documentation: every figure is on a page, and those with short computations are drawn."""

from pathlib import Path

import cv2
import figures

DOCS = Path(__file__).parents[1] / "docs"


def test_figures_are_drawn_and_on_a_page(tmp_path):
    short = ("gallery/kernels", "gallery/training_data")
    figures.main(["--out", str(tmp_path), "--only", *short])
    for name in short:
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 10
    assert {path.stem for path in (DOCS / "gallery").glob("*.png")} == {
        name.removeprefix("gallery/") for name in figures.PICTURES if "/" in name
    }
    pages = "".join(page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))
    assert all(f"]({name}.png)" in pages for name in figures.PICTURES)
