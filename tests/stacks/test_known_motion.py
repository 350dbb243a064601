"""Long stacks restored with a recorded motion: clock, memory and windows, against an independent simulator."""

import json

import numpy as np
import pytest
import torch
from program import rsvib
from truth import MARGIN, Curve, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.stacks import align_stack

HEIGHT, WIDTH, COUNT = 160, 128, 60
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=300)
CLOCK, SPEED = 812.3456, 1.0004
CAMERA = ("--row-time", "60us", "--exposure", "1.2ms", "--frame-rate", str(1 / TIMING.frame_period))


def recorded_path(clock):
    """Displacement (N, 2) in px on the clock of the recording."""
    t = clock - 812.0
    x = 2.5 * np.sin(2 * np.pi * 11.3 * t + 6 * np.sin(2.1 * t)) + np.sin(2 * np.pi * 37.7 * t)
    y = 2.0 * np.sin(2 * np.pi * 8.9 * t + 5 * np.sin(3.3 * t)) + 0.5 * np.cos(2 * np.pi * 29.1 * t)
    return np.stack([x, y], axis=-1)


@Curve
def shaken(times):
    return recorded_path(SPEED * times + CLOCK)


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    """A stack of 60 frames, and the recording, which is longer."""
    place = tmp_path_factory.mktemp("place")
    scene = draw_scene(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, 7)
    np.save(place / "frames.npy", take_frames(scene, TIMING, shaken, COUNT, 0.005).astype(np.float32))
    clock = np.arange(811.9, 814.0, 1e-3)
    rows = [f"{t:.9f},{x:.9g},{y:.9g}" for t, (x, y) in zip(clock, recorded_path(clock), strict=True)]
    (place / "motion.csv").write_text("\n".join(["time,x,y", *rows]))
    return place


def test_the_clock_over_a_long_stack_is_found_by_parts_of_it(place):
    recorded = rsv.read_motion(place / "motion.csv", unit="px")
    info = rsv.read_stack_info(place / "frames.npy")
    found = align_stack(place / "frames.npy", info, TIMING, recorded)
    assert found.reliable, found.reasons
    assert found.offset == pytest.approx(CLOCK, abs=3e-5)
    assert abs(found.offset - CLOCK) < 4 * found.offset_std
    assert abs(found.scale - SPEED) < min(4 * found.scale_std, 1e-4)


def test_parts_that_are_fixed_to_the_camera_do_not_count(place, tmp_path):
    frames = np.load(place / "frames.npy")
    frames[:, 100:] = draw_scene(HEIGHT - 100, WIDTH, 9)
    np.save(tmp_path / "frames.npy", frames.astype(np.float32))
    recorded, info = rsv.read_motion(place / "motion.csv", unit="px"), rsv.read_stack_info(tmp_path / "frames.npy")
    ignore = torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH) >= 100
    found = align_stack(tmp_path / "frames.npy", info, TIMING, recorded, ignore=ignore)
    assert found.reliable, found.reasons
    assert found.offset == pytest.approx(CLOCK, abs=1e-4)


def test_a_long_stack_is_restored_in_windows_with_a_recording(place, tmp_path, capsys):
    arguments = ("restore", place / "frames.npy", tmp_path / "out.npy", *CAMERA, "--unit", "px", "--device", "cpu")
    assert rsvib(*arguments, "--motion", place / "motion.csv", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["restoration"]["windows"], answer["restoration"]["restored"]) == (9, 9)
    assert answer["alignment"]["offset"] == pytest.approx(CLOCK, abs=3e-5)
    raw, restored = (np.load(path) for path in (place / "frames.npy", tmp_path / "out.npy"))
    before, after = (np.square(one[1:] - one[:-1])[:, 8:-8, 8:-8].mean((1, 2)) for one in (raw, restored))
    assert after.max() < 0.03 * before.mean()  # also across the borders of windows
