"""Long stacks restored in windows with a recorded motion, against an independent simulator."""

import json

import numpy as np
import pytest
from program import rsvib
from truth import MARGIN, Curve, draw_scene, take_frames

import rsvib_torch as rsv

HEIGHT, WIDTH, COUNT = 160, 128, 60
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=300)
CLOCK = 812.3456
CAMERA = ("--row-time", "60us", "--exposure", "1.2ms", "--frame-rate", str(1 / TIMING.frame_period))


def recorded_path(clock):
    """Displacement (N, 2) in px on the clock of the recording."""
    t = clock - 812.0
    x = 2.5 * np.sin(2 * np.pi * 11.3 * t + 6 * np.sin(2.1 * t)) + np.sin(2 * np.pi * 37.7 * t)
    y = 2.0 * np.sin(2 * np.pi * 8.9 * t + 5 * np.sin(3.3 * t)) + 0.5 * np.cos(2 * np.pi * 29.1 * t)
    return np.stack([x, y], axis=-1)


@Curve
def shaken(times):
    return recorded_path(times + CLOCK)


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


def test_a_long_stack_is_restored_in_windows_with_a_recording(place, tmp_path, capsys):
    arguments = ("restore", place / "frames.npy", tmp_path / "out.npy", *CAMERA, "--unit", "px", "--offset", CLOCK)
    assert rsvib(*arguments, "--device", "cpu", "--motion", place / "motion.csv", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["restoration"]["windows"], answer["restoration"]["restored"]) == (9, 9)
    raw, restored = (np.load(path) for path in (place / "frames.npy", tmp_path / "out.npy"))
    before, after = (np.square(one[1:] - one[:-1])[:, 8:-8, 8:-8].mean((1, 2)) for one in (raw, restored))
    assert after.max() < 0.03 * before.mean()  # also across the borders of windows
