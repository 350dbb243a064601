"""The tutorials and notebooks run from top to bottom, print what they show, and teach correct results."""

import importlib.util
import json
import re
import runpy
from pathlib import Path

import nbformat
import pytest
import torch
from shown_output import differing_lines, notebook_text

import rsvib_torch as rsv

ROOT = Path(__file__).parents[1]
TUTORIALS = ROOT / "docs" / "tutorials"
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def pages():
    return runpy.run_path(str(ROOT / "scripts" / "run_pages.py"))


def run(pages, name, folder):
    """Run a tutorial; fails if its output is not that of the page. Returns its variables."""
    page = TUTORIALS / name
    expected = page.read_text(encoding="utf-8")
    text, names = pages["run_page"](page, folder)
    # fits of a wrong model, and of a vibration that frames do not show, are not reproducible to the last tone
    block = r"(--out (?:wrong|blind)\n```\n\n```text\n).*?```"
    # how far a frame moves as a whole depends on the corners that are followed, if its rows move by 5 px
    moved = r"(from frame to frame: )[\d.]+"
    shown = [re.sub(moved, r"\1", re.sub(block, r"\1```", t, flags=re.DOTALL)) for t in (expected, text)]
    assert not differing_lines(*shown), "out of date: make pages"
    assert all((folder / picture).exists() and (TUTORIALS / picture).exists() for picture in pages["pictures"](text))
    return names


def test_satellite(pages, tmp_path):
    names = run(pages, "satellite.md", tmp_path)
    for detection in (names["detections"][0], names["detections"][1]):
        torch.testing.assert_close(detection.vibration.amplitude, names["vibration"].amplitude, rtol=0, atol=0.01)
        torch.testing.assert_close(detection.vibration.frequency, names["vibration"].frequency, rtol=0, atol=0.05)
        motion = torch.tensor([30.0, -150.0], dtype=torch.float64)
        torch.testing.assert_close(detection.vibration.image_motion, motion, rtol=0, atol=0.5)
    assert rsv.psnr(names["restored"][0], names["still"], 1.0, rim=24) > 40


@pytest.mark.slow
def test_video(pages, tmp_path):
    names = run(pages, "video.md", tmp_path)
    assert not rsv.read_vibration(tmp_path / "blind" / "vibration.json", names["timing"]).reliable[1]
    manifest = rsv.read_manifest(tmp_path / "results" / "manifest.json")
    assert all(after < 0.1 * before for before, after in manifest.shaking.values())
    found = manifest.detections()[0]
    torch.testing.assert_close(found.vibration.amplitude[:, 0], torch.tensor([2.4, 1.7]).double(), rtol=0, atol=0.1)
    torch.testing.assert_close(found.vibration.frequency[:, 0], torch.tensor([47.0, 73.0]).double(), rtol=0, atol=0.1)
    for name, reliable in (("wrong", [False, False]), ("blind", [True, False])):
        assert json.loads((tmp_path / name / "vibration.json").read_text())["reliable"] == reliable
    assert re.search(r"^row_time = 0\.0001000\d*$", (tmp_path / "led.toml").read_text(), flags=re.MULTILINE)


@pytest.mark.slow
def test_training(pages, tmp_path):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # with two, the training of the small networks ends elsewhere
    try:
        names = run(pages, "training.md", tmp_path)
    finally:
        torch.set_num_threads(threads)
    true = names["camera"].drawn_vibration()
    assert true.frequency.shape[0] == 4  # section 5 has drawn new vibrations
    error, still, taken, restored = (names[name] for name in ("error", "still_network", "taken", "restored"))
    assert error(still, names["clips"]) < error(still, restored) < 0.5 * error(still, taken)
    assert error(names["robust_network"], taken) < error(still, taken)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(pages, notebook):
    """Its stored text is that of a run; two figures are the offset plot, and the images before and after."""
    stored = nbformat.read(notebook, as_version=4)
    assert not differing_lines(notebook_text(stored), notebook_text(pages["run_notebook"](notebook)))
    outputs = str([cell.get("outputs") for cell in stored.cells])
    assert outputs.count("image/png") + outputs.count("data:image/png") >= 3
    assert "Error" not in outputs


def test_a_wrong_output_and_a_failing_command_are_found(pages, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```python\nprint(6 * 7)\n```\n\n```text\n99\n```\n\n```bash\nls missing  # exit code 2\n```\n")
    text, _ = pages["run_page"](page, tmp_path)
    assert differing_lines(page.read_text(), text) == ["99\n42"]
    page.write_text("```bash\nls missing\n```\n")
    with pytest.raises(RuntimeError, match=r"ls missing.*exit code 2"):
        pages["run_page"](page, tmp_path)


@pytest.mark.skipif(importlib.util.find_spec("latex2mathml") is None, reason="latex2mathml is missing (extra docs)")
def test_formulas_become_mathml(monkeypatch):
    markdown = pytest.importorskip("markdown")
    monkeypatch.syspath_prepend(ROOT / "scripts" / "documentation")
    text = "A $x_1$ costs 5 $ or 7 $, `$x$`.\n\n```math\nx = \\frac{1}{2}\n```\n"
    page = markdown.markdown(text, extensions=["formulas", "fenced_code"])
    assert page.count("<math") == 2
    assert "<msub><mi>x</mi><mn>1</mn></msub>" in page
    assert "5 $ or 7 $, <code>$x$</code>" in page
    assert 'display="block"' in page
    assert "<mfrac><mrow><mn>1</mn></mrow><mrow><mn>2</mn></mrow></mfrac>" in page
