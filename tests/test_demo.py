"""The demonstration with narrow frames: its output, files and figures, which must meet the goals."""

import json
import runpy
from pathlib import Path

import cv2
import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.report.results import read_vibration

DEMO = Path(__file__).parents[1] / "scripts" / "demo.py"


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Folder and standard output of one run."""
    out = tmp_path_factory.mktemp("demo") / "made" / "by itself"
    with pytest.MonkeyPatch.context() as patch:
        printed = []
        namespace = runpy.run_path(str(DEMO))
        console = namespace["Console"]
        patch.setattr(console, "print", lambda self, *things, **_: printed.extend(things))
        namespace["main"](["--quick", "--out", str(out), "--seed", "5"])
    return out, printed


@pytest.mark.parametrize("scene", ["chart", "city"])
def test_detection_and_restoration_meet_the_goals(demo, scene):
    summary = json.loads((demo[0] / scene / "summary.json").read_text(encoding="utf-8"))
    goals = {"period": 1.0, "amplitude": 2.0, "phase": 0.05}
    assert [(line["axis"], line["quantity"]) for line in summary["vibration"]] == [
        (axis, quantity) for axis in "xy" for quantity in goals
    ]
    for line in summary["vibration"]:
        error = line["detected"] - line["true"] if line["quantity"] == "phase" else line["detected"] / line["true"] - 1
        assert abs(line["error"]) < goals[line["quantity"]], line
        assert line["error"] == pytest.approx(error if line["quantity"] == "phase" else 100 * error, abs=1e-3)
    assert summary["reliable"] == [True, True]
    for before, after in zip(summary["psnr_before"], summary["psnr_after"], strict=True):
        assert before < 25
        assert after > before + 12
    for before, after in zip(summary["ssim_before"], summary["ssim_after"], strict=True):
        assert before < 0.7
        assert after > 0.95


@pytest.mark.parametrize("scene", ["chart", "city"])
def test_files_are_those_of_the_command_line(demo, scene):
    folder = demo[0] / scene
    frames, restored = (rsv.read_stack(folder / name) for name in ("frames.tif", "restored.tif"))
    assert frames.shape == restored.shape == (2, 2048, 320)
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
    kept = read_vibration(folder / "vibration.json", timing)
    torch.testing.assert_close(kept.vibration.amplitude[:, 0], torch.tensor([3.1, 5.2]).double(), rtol=0.02, atol=0)
    # restoration from the files equals the restored frames up to rounding to 12-bit counts
    again = rsv.restore(frames, timing, kept.vibration)[:, 32:-32, 32:-32].clamp(0, 1)
    torch.testing.assert_close(again, restored[:, 32:-32, 32:-32], rtol=0, atol=0.6 / 4095)
    for picture in ("offsets.png", "before_after.png"):
        assert min(cv2.imread(str(folder / picture)).shape[:2]) > 400
    assert (folder / "before_after.png").stat().st_size < 400_000


@pytest.mark.parametrize("scene", ["chart", "city"])
def test_report_is_written_and_named(demo, scene):
    path = demo[0] / scene / "report" / "report.html"
    text = path.read_text(encoding="utf-8")
    assert "The vibration of the camera was measured and removed; restoration improves the frames." in text
    assert "python scripts/demo.py --quick --out" in text
    assert f"report with all figures: {path}" in "\n".join(line for line in demo[1] if isinstance(line, str))
