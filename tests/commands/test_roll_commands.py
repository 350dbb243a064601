"""Roll on the command line: configuration, results, restored axes and the report page."""

import json

import numpy as np
import pytest
import torch
from field_truth import FieldMotion, take_field_frames
from program import rsvib
from truth import draw_scene

import rsvib_torch as rsv

TIMING = rsv.SensorTiming(row_time=8e-5, exposure_rows=12, frame_rows=280)
CONFIG = """
[sensor]
row_time = 8e-5
exposure_rows = 12
frame_rows = 280
full_scale = 4095

[detection]
roll = true
tones = 1

[restoration]
method = "dewarp"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("roll")
    truth = FieldMotion((1.4, 1.9, 2.5e-3, 0.0), (38.0, 31.0, 26.0, 0.0), (0.3, 1.1, 2.0, 0.0))
    frames = take_field_frames(draw_scene(256, 304, 11, blur=1.2), TIMING, truth, (192, 240), 4)
    frames += 0.004 * np.random.default_rng(5).standard_normal(frames.shape)
    rsv.write_stack(folder / "frames.tif", torch.from_numpy(frames).clamp(0, 1), dtype="uint16", full_scale=4095)
    (folder / "camera.toml").write_text(CONFIG)
    return folder


def test_report_of_a_rolling_camera(folder, capsys):
    config = ("--config", folder / "camera.toml")
    assert rsvib("report", folder / "frames.tif", folder / "page", *config, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["detection"]["reliable"] == [True, True, True]
    assert answer["detection"]["vibration"]["amplitude"][2][0] == pytest.approx(2.5e-3, rel=0.03)
    assert answer["restoration"]["axes"] == ["x", "y", "roll"]
    assert (folder / "page" / "offsets_roll.png").exists()
    assert "Roll vibrates by" in (folder / "page" / "report.html").read_text()


def test_windows_of_a_rolling_camera(folder, capsys):
    out = folder / "windows"
    config = ("--config", folder / "camera.toml")
    assert rsvib("detect", folder / "frames.tif", "--out", out, *config, "--window", 3) == 0
    assert "roll" in capsys.readouterr().out
    head, *lines = (out / "tones.csv").read_text().splitlines()
    rows = [dict(zip(head.split(","), line.split(","), strict=True)) for line in lines]
    reliable = [float(row["amplitude_rad"]) for row in rows if (row["axis"], row["reliable"]) == ("roll", "True")]
    assert reliable == pytest.approx([2.5e-3] * 2, rel=0.05)
