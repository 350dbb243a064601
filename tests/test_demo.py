"""The demonstration and the example at small sizes."""

import json
import re
import runpy
from pathlib import Path

import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.report.results import read_vibration

ROOT = Path(__file__).parents[1]


def test_both_scenes_meet_the_goals_and_have_the_files_of_the_command_line(tmp_path, monkeypatch):
    out, printed = tmp_path / "made" / "by itself", []
    namespace = runpy.run_path(str(ROOT / "scripts" / "demo.py"))
    monkeypatch.setattr(namespace["Console"], "print", lambda self, *things, **_: printed.extend(things))
    namespace["main"](["--quick", "--out", str(out), "--seed", "5"])
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
    for scene in ("chart", "city"):
        summary = json.loads((out / scene / "summary.json").read_text(encoding="utf-8"))
        goals = {"period": 1.0, "amplitude": 2.0, "phase": 0.05}
        assert [(line["axis"], line["quantity"]) for line in summary["vibration"]] == [
            (axis, quantity) for axis in "xy" for quantity in goals
        ]
        assert all(abs(line["error"]) < goals[line["quantity"]] for line in summary["vibration"])
        assert summary["reliable"] == [True, True]
        assert min(summary["psnr_after"]) > max(summary["psnr_before"]) + 12
        assert min(summary["ssim_after"]) > 0.95
        kept = read_vibration(out / scene / "vibration.json", timing)
        torch.testing.assert_close(kept.vibration.amplitude[:, 0], torch.tensor([3.1, 5.2]).double(), rtol=0.02, atol=0)
        # restoration from the files equals the restored frames up to rounding to 12-bit counts
        frames, restored = (rsv.read_stack(out / scene / name) for name in ("frames.tif", "restored.tif"))
        again = rsv.restore(frames, timing, kept.vibration)[:, 32:-32, 32:-32].clamp(0, 1)
        torch.testing.assert_close(again, restored[:, 32:-32, 32:-32], rtol=0, atol=0.6 / 4095)
        assert (out / scene / "before_after.png").exists()
        page = out / scene / "report" / "report.html"
        assert "restoration improves the frames." in page.read_text(encoding="utf-8")
        assert f"report with all figures: {page}" in "\n".join(line for line in printed if isinstance(line, str))


def test_third_line_makes_a_blind_frequency_measurable(capsys):
    runpy.run_path(str(ROOT / "scripts" / "examples" / "push_broom_jitter.py"))["main"](["--size", "448", "112"])
    printed = capsys.readouterr().out
    truth, two, three = (line for line in printed.splitlines() if "px at" in line)
    assert "refused" in two
    found, true = (float(re.search(r"(\S+) px at 13\d", line).group(1)) for line in (three, truth))
    assert found == pytest.approx(true, rel=0.02)
    taken, blind, seen = (float(re.search(r"(\S+) dB", line).group(1)) for line in (truth, two, three))
    assert seen > blind + 8
    assert blind > taken + 2
