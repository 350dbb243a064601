"""The Python code on the pages of the documentation runs from top to bottom and gives correct results."""

import math
import re
from pathlib import Path

import pytest
import torch
from benchmarks.resolution_chart import resolution_chart

import rsvib_torch as rsv
from rsvib_torch.registration.methods import BAND_METHODS
from rsvib_torch.restoration.priors import PRIORS
from rsvib_torch.results.reason import REASONS

DOCS = Path(__file__).parents[1] / "docs"


def run_page(name, least_blocks):
    """Execute all Python blocks of a page; returns the names that they define."""
    page = DOCS / name
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    assert len(blocks) >= least_blocks
    torch.manual_seed(0)
    names = {"__name__": "page"}
    exec(compile("\n".join(blocks), str(page), "exec"), names)
    return names


def test_machine_learning_page():
    """Its detector measures the vibration, and its restorer recovers the scene."""
    pipeline = run_page("ml_pipeline.md", 8)
    assert pipeline["features"].shape == (2, 8, *pipeline["frames"].shape[-2:])
    assert pipeline["vibration"].amplitude.shape == (4, 2, 1)
    assert pipeline["moved_points"].shape == (4, 2, 2)
    assert not torch.equal(pipeline["moved_boxes"], pipeline["boxes"])
    assert pipeline["taken"].shape == (4, 2, 3, 96, 64)
    frames, truth = pipeline["frames"], pipeline["truth"]
    found = pipeline["model"].detector(frames).vibration[0]
    torch.testing.assert_close(found.amplitude, truth.amplitude, rtol=0, atol=0.2)
    height, width = frames.shape[-2:]
    top, left = (320 - height) // 2, (200 - width) // 2
    still = pipeline["scene"][top : top + height, left : left + width]
    restored = pipeline["model"].restorer(frames, found)[0, :, 0]
    assert (rsv.psnr(restored, still, 1.0, rim=16) > rsv.psnr(frames[0, :, 0], still, 1.0, rim=16) + 5).all()


def test_quick_start_page(tmp_path, monkeypatch, capsys):
    """The frames of the demonstration are replaced by smaller ones with the same camera and vibration."""
    monkeypatch.chdir(tmp_path)
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
    motion = rsv.Vibration(amplitude=[3.1, 5.2], frequency=[50.0, 30.0], phase=[0.7, -1.9])
    frames = rsv.simulate_frames(resolution_chart(1100, 300), timing, motion, num_frames=2)
    (tmp_path / "out" / "demo" / "chart").mkdir(parents=True)
    rsv.write_stack("out/demo/chart/frames.tif", frames, full_scale=4095, dtype="uint16")
    names = run_page("quickstart.md", 3)
    assert re.search(r"^x     3\.1.* (49\.99|50\.00)", capsys.readouterr().out, flags=re.MULTILINE)
    assert rsv.read_stack("out/restored.tif").shape == frames.shape
    assert names["measured"].reliable.all()
    torch.testing.assert_close(names["measured"].vibration.amplitude, names["vibration"].amplitude, rtol=0, atol=0.02)


def test_recipes_of_the_architecture_page(tmp_path, monkeypatch):
    """The recipes add a minimal registration method, prior and reason, which are used and removed."""
    monkeypatch.chdir(tmp_path)
    tables = [(table, dict(table)) for table in (BAND_METHODS, PRIORS, REASONS)]
    try:
        names = run_page("architecture.md", 4)
    finally:
        for table, entries in tables:
            table.clear()
            table.update(entries)
    offsets = names["rounded"].offsets
    assert torch.equal(offsets.nan_to_num(), offsets.round().nan_to_num())
    assert offsets.nan_to_num().abs().max() >= 2
    found = names["detection"].vibration.amplitude[:, :1]
    torch.testing.assert_close(found, names["vibration"].amplitude, rtol=0, atol=0.02)  # refined on the rows
    frames, vibration, timing = (names[name] for name in ("frames", "vibration", "timing"))
    default, smooth = (
        image.diff(dim=-2).square().mean() for image in (rsv.restore(frames, timing, vibration), names["smoothed"])
    )
    assert smooth < default  # ten times the precision of the prior
    for call, name in (
        (lambda: rsv.register_bands(frames, timing, method="whole-pixels"), "whole-pixels"),
        (lambda: rsv.restore(frames, timing, vibration, prior="smooth"), "smooth"),
    ):
        with pytest.raises(ValueError, match=name):
            call()


@pytest.mark.slow
def test_page_on_roll_and_zoom():
    page = run_page("roll_and_zoom.md", 1)
    detection, truth = page["detection"], page["truth"]
    assert detection.reliable.tolist() == [True, True, True]
    torch.testing.assert_close(detection.vibration.amplitude[2], truth.amplitude[2], rtol=0.03, atol=0)
    assert page["restored"].shape == page["frames"].shape


def test_page_on_the_finer_grid():
    page = run_page("finer_grid.md", 3)
    height, width = page["frames"].shape[-2:]
    assert page["sharp"].std() > page["restored"].std()
    assert page["colours"].shape == (1, 3, 64, 64)
    assert page["restored"].shape == (1, 2 * height, 2 * width)
    assert page["pixels"].shape == (1, height, width)


def test_page_on_export():
    page = run_page("export.md", 1)
    rates = rsv.read_gyroscope(page["folder"] / "clip.gcsv")
    assert rates.rates.abs().max() == pytest.approx(2 * math.pi * 61 * 5.2 / 1800, rel=0.01)


def test_page_on_live():
    page = run_page("live.md", 1)
    torch.testing.assert_close(
        page["detection"].vibration.frequency[:, 0], page["truth"].frequency[:, 0], rtol=1e-3, atol=0
    )
    assert page["tracked"].state == "tracking"
    assert page["restored"].shape == page["camera"][0].shape
