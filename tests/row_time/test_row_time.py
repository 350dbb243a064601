"""Row time from motion, in frames of an independent camera and in displacements computed from the definition."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from program import refused, rsvib
from simulated_gpu import SIMULATED_GPU, simulated_gpu
from truth import Motion, recorded

import rsvib_torch as rsv
from rsvib_torch.config import read_config
from rsvib_torch.io.stack_info import StackInfo

HEIGHT, WIDTH, FRAMES = 192, 144, 5
ROW_TIME, FRAME_ROWS = 6e-5, 240
TIMING = rsv.SensorTiming(row_time=ROW_TIME, exposure_rows=8, frame_rows=FRAME_ROWS)
RATE = 1 / (FRAME_ROWS * ROW_TIME)
TONES = Motion((3.1, 2.2), (131.0, 97.0), (0.4, 2.0))


@pytest.fixture(scope="module", name="two_tones")
def make_two_tones():
    return recorded((HEIGHT, WIDTH), TIMING, TONES, FRAMES, 0.005, seed=5)


@pytest.fixture(scope="module", name="one_tone")
def make_one_tone():
    return recorded((HEIGHT, WIDTH), TIMING, replace(TONES, amplitude=(3.1, 0.0)), FRAMES, 0.005, seed=5)


def test_row_time_of_two_tones(two_tones):
    found = rsv.calibrate_row_time_by_motion(two_tones, frame_rate=RATE)
    assert found.reliable
    assert found.readout_direction == "forward"
    assert found.row_time_std < 5e-4 * ROW_TIME
    assert abs(found.row_time - ROW_TIME) < 4 * found.row_time_std
    assert found.candidates == (found.row_time,)
    assert abs(found.frame_rows - FRAME_ROWS) < 4 * FRAME_ROWS * found.row_time_std / ROW_TIME


def test_row_time_outside_the_limits_is_not_replaced_by_another(two_tones):
    found = rsv.calibrate_row_time_by_motion(two_tones, frame_rate=RATE, row_time=(3e-5, 5.5e-5))
    assert not found.reliable


def test_frames_on_another_device(two_tones):
    limits = {"frame_rate": RATE, "row_time": (5e-5, 7e-5)}
    here = rsv.calibrate_row_time_by_motion(two_tones, **limits)
    with simulated_gpu():
        there = rsv.calibrate_row_time_by_motion(two_tones.to(SIMULATED_GPU), **limits)
    assert there.reliable
    assert abs(here.row_time - there.row_time) < 0.05 * here.row_time_std


def test_reverse_readout_along_x(two_tones):
    turned, limits = two_tones.transpose(-2, -1).flip(-1), (2e-5, 7e-5)
    found = rsv.calibrate_row_time_by_motion(turned, frame_rate=RATE, scan_axis="x", row_time=limits)
    assert found.reliable
    assert found.readout_direction == "reverse"
    assert abs(found.row_time - ROW_TIME) < 4 * found.row_time_std < 2e-3 * ROW_TIME


def test_one_tone_has_a_row_time_for_every_number_of_turns(one_tone):
    """f P = k + phi: row times nu P / (k + phi), of which the camera has k = 1."""
    found = rsv.calibrate_row_time_by_motion(one_tone, frame_rate=RATE, row_time=(2e-5, 7.2e-5))
    assert not found.reliable
    assert [reason.code for reason in found.findings] == ["row_times_ambiguous"]
    assert found.findings[0].value == len(found.candidates)
    turns = 131.0 / RATE
    expected = sorted(
        ROW_TIME * turns / (turns + k) for k in range(-20, 20) if 2e-5 <= abs(ROW_TIME * turns / (turns + k)) <= 7.2e-5
    )
    assert len(expected) > 4
    np.testing.assert_allclose(found.candidates, expected, rtol=5e-3)


def test_limits_select_one_of_them(one_tone):
    found = rsv.calibrate_row_time_by_motion(
        one_tone, frame_rate=RATE, row_time=(4.5e-5, 7e-5), readout_direction="forward", exposure_time=4.8e-4
    )
    assert found.reliable
    assert abs(found.row_time - ROW_TIME) < 4 * found.row_time_std < 4e-3 * ROW_TIME


@pytest.mark.parametrize(
    ("frames", "code"),
    [
        (lambda moving: moving[:2], "too_few_frames_for_row_time"),
        (lambda moving: moving[:1] + 0.005 * torch.randn(4, HEIGHT, WIDTH), "no_motion_for_row_time"),
    ],
)
def test_what_is_not_identifiable_is_refused(two_tones, tmp_path, frames, code):
    torch.manual_seed(0)
    found = rsv.calibrate_row_time_by_motion(frames(two_tones), frame_rate=RATE)
    assert not found.reliable
    assert found.row_time is None
    assert [reason.code for reason in found.findings] == [code]
    assert "not reliable" in found.summary()
    found.save(tmp_path / "row_time.json")
    loaded = rsv.RowTimeCalibration.load(tmp_path / "row_time.json")
    assert loaded.row_time is None
    assert loaded.findings == found.findings


def test_command(two_tones, one_tone, tmp_path, capsys):
    moving, ambiguous, out = tmp_path / "moving.tif", tmp_path / "one_tone.tif", tmp_path / "sensor.toml"
    rsv.write_stack(moving, two_tones, dtype="float32")
    rsv.write_stack(ambiguous, one_tone, dtype="float32")
    options = ("--by-motion", "--frame-rate", RATE, "--exposure", "480us")
    assert rsvib("calibrate", moving, *options, "--out", out) == 0
    sensor = read_config(out)
    assert abs(sensor.timing.row_time / ROW_TIME - 1) < 2e-3
    assert sensor.timing.exposure_time == pytest.approx(4.8e-4)
    error = refused(capsys, "calibrate", ambiguous, *options, "--out", tmp_path / "none.toml")
    assert re.search(r"error: the row time is not certain: \d+ row times explain", error)
    assert not (tmp_path / "none.toml").exists()
    assert "--frame-rate" in refused(capsys, "calibrate", moving, "--by-motion")
    clip = tmp_path / "clip.mkv"  # states its frame rate
    info = StackInfo(tuple(two_tones.shape), "uint8", 255.0, frame_rate=RATE)
    rsv.write_stack(clip, two_tones, dtype="uint8", like=info)
    limits = ("--row-time", "40us", "--row-time", "70us")
    assert rsvib("calibrate", clip, "--by-motion", *limits, "--exposure", "480us", "--overwrite", "--out", out) == 0
    assert abs(read_config(out).timing.row_time / ROW_TIME - 1) < 1e-3
    assert "--by-motion" in refused(capsys, "calibrate", moving, "--frequency", 100, "--row-time", "1us")
