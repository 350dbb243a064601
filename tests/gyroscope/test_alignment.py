"""Restoration with a motion that another instrument recorded, of frames of an independent simulator."""

import numpy as np
import torch
from program import refused, rsvib
from truth import MARGIN, Curve, draw_scene, take_frames

import rsvib_torch as rsv

HEIGHT, WIDTH, FRAMES = 224, 160, 4
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=300)
FOCAL_LENGTH = 900.0  # px
CLOCK = 812.3456
CONFIG = "[sensor]\nrow_time = 6e-5\nexposure_rows = 20\nframe_rows = 300\n"


def angles(clock):
    """Camera shake of a hand: angles in rad on the clock of the gyroscope."""
    t = clock - 812.0
    x = 3e-3 * np.sin(2 * np.pi * 11.3 * t + 6 * np.sin(2.1 * t)) + 1e-3 * np.sin(2 * np.pi * 37.7 * t)
    y = 2e-3 * np.sin(2 * np.pi * 8.9 * t + 5 * np.sin(3.3 * t)) + 0.5e-3 * np.cos(2 * np.pi * 29.1 * t)
    return np.stack([x, y], axis=-1)


@Curve
def hand_shake(times):
    return FOCAL_LENGTH * np.tan(angles(times + CLOCK))


def log(path, clock, values, header="time,x,y"):
    rows = [f"{t:.9f},{x:.12g},{y:.12g}" for t, (x, y) in zip(clock, values, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_command_does_not_restore_with_a_motion_that_does_not_fit(tmp_path, capsys):
    scene = draw_scene(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, 7)
    frames = torch.from_numpy(take_frames(scene, TIMING, hand_shake, FRAMES, 0.005)).float()
    rsv.write_stack(tmp_path / "frames.tif", frames)
    clock = np.arange(811.9, 813.4, 1e-3)
    rates = (angles(clock + 1e-5) - angles(clock - 1e-5)) / 2e-5
    gyroscope, opposite = log(tmp_path / "rates.csv", clock, rates), log(tmp_path / "opposite.csv", clock, -rates)
    (tmp_path / "camera.toml").write_text(CONFIG)
    known = ("restore", tmp_path / "frames.tif", tmp_path / "out.tif", "--config", tmp_path / "camera.toml")
    arguments, focal = (*known, "--unit", "rad/s", "--motion"), ("--focal-length", 900)
    for command, message in (
        ((*arguments, gyroscope, *focal, "--offset", 813.35), "the frames need"),
        ((*arguments, gyroscope, *focal), "--unit rad/s needs --offset"),
        ((*arguments, gyroscope, *focal, "--offset", CLOCK, "--ignore", "60:"), "--ignore is for a gyroscope"),
        ((*arguments, gyroscope), "needs a focal_length"),
    ):
        assert message in refused(capsys, *command)
        assert not (tmp_path / "out.tif").exists()
    arguments = (*arguments, opposite, *focal, "--offset", CLOCK)
    assert rsvib(*arguments) == 0
    assert "4 frames in 1 window, 0 restored" in capsys.readouterr().out
    assert (rsv.read_stack(tmp_path / "out.tif") == frames).all()
    assert rsvib(*arguments, "--force", "--overwrite") == 0
    assert not (rsv.read_stack(tmp_path / "out.tif") == frames).all()
