"""Alignment of motion recorded on another clock with frames of an independent simulator."""

import numpy as np
import pytest
import torch
from program import refused, rsvib
from refusals import refuses
from truth import MARGIN, Curve, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv

HEIGHT, WIDTH, FRAMES = 224, 160, 4
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=300)
FOCAL_LENGTH = 900.0  # px
CLOCK, SPEED, DRIFT = 812.3456, 1.0004, (9.0, -4.0)
CONFIG = "[sensor]\nrow_time = 6e-5\nexposure_rows = 20\nframe_rows = 300\n"


def angles(clock):
    """Camera shake of a hand: angles in rad on the clock of the gyroscope."""
    t = clock - 812.0
    x = 3e-3 * np.sin(2 * np.pi * 11.3 * t + 6 * np.sin(2.1 * t)) + 1e-3 * np.sin(2 * np.pi * 37.7 * t)
    y = 2e-3 * np.sin(2 * np.pi * 8.9 * t + 5 * np.sin(3.3 * t)) + 0.5e-3 * np.cos(2 * np.pi * 29.1 * t)
    return np.stack([x, y], axis=-1)


@Curve
def hand_shake(times):
    return FOCAL_LENGTH * np.tan(angles(SPEED * times + CLOCK)) + np.asarray(DRIFT) * times[..., None]


@pytest.fixture(scope="module", name="scene")
def make_scene():
    return draw_scene(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, 7)


@pytest.fixture(scope="module", name="frames")
def make_frames(scene):
    return torch.from_numpy(take_frames(scene, TIMING, hand_shake, FRAMES, 0.005)).float()


def log(path, clock, values, header="time,x,y"):
    rows = [f"{t:.9f},{x:.12g},{y:.12g}" for t, (x, y) in zip(clock, values, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.fixture(scope="module", name="gyroscope")
def make_gyroscope(tmp_path_factory):
    """Angular rates sampled at 1 kHz during 1.5 s, computed as differences of the angles."""
    clock = np.arange(811.9, 813.4, 1e-3)
    rates = (angles(clock + 1e-5) - angles(clock - 1e-5)) / 2e-5
    return log(tmp_path_factory.mktemp("gyroscope") / "rates.csv", clock, rates)


def test_clock_offset_and_drift_are_estimated_and_frames_restored(scene, frames, gyroscope):
    recorded = rsv.read_motion(gyroscope, unit="rad/s", focal_length=FOCAL_LENGTH)
    found = rsv.align_motion(frames, TIMING, recorded)
    assert found.reliable
    assert found.offset == pytest.approx(CLOCK, abs=5e-5)
    assert abs(found.offset - CLOCK) < 4 * found.offset_std
    assert found.scale == pytest.approx(SPEED, abs=1e-3)
    assert abs(found.scale - SPEED) < 4 * found.scale_std
    assert found.drift.tolist() == pytest.approx(DRIFT, abs=0.5)
    times = TIMING.row_starts(FRAMES, HEIGHT) + 0.5 * TIMING.exposure_time
    error = found.motion.displacement(times).numpy() - hand_shake.displacement(times.numpy())
    assert np.abs(error - error.mean((0, 1))).max() < 0.05
    shift = torch.from_numpy(error.mean((0, 1)))[:, None]
    placed = rsv.FreeMotion(
        found.motion.coefficients - shift, found.motion.start, found.motion.spacing, found.motion.tones
    )
    truth = rsv.FreeMotion.from_samples(
        times.flatten(), torch.from_numpy(hand_shake.displacement(times.flatten().numpy()))
    )
    best, here = (decibel(rsv.restore(frames, TIMING, m).numpy(), crop(scene)) for m in (truth, placed))
    assert here > best - 0.3
    assert decibel(frames.numpy(), crop(scene)) < best - 12


def test_unrelated_recording_is_not_reliable(frames, tmp_path):
    clock = np.arange(0.0, 1.0, 1e-3)
    path = log(tmp_path / "other.csv", clock, 3 * np.stack([np.sin(170 * clock), np.cos(230 * clock**1.3)], -1))
    found = rsv.align_motion(frames, TIMING, rsv.read_motion(path, unit="px"))
    assert not found.reliable
    unexplained = [reason for reason in found.findings if reason.code == "recording_incomplete"]
    assert unexplained
    assert all(reason.value > reason.limit for reason in unexplained)


def test_periodic_motion_has_ambiguous_clock_offsets(tmp_path, scene):
    sine = Curve(lambda t: np.stack([3 * np.sin(2 * np.pi * 31 * t), 2 * np.cos(2 * np.pi * 31 * t)], -1))
    clock = np.arange(0.0, 0.4, 1e-3)
    path = log(tmp_path / "sine.csv", clock, sine.displacement(clock))
    frames = torch.from_numpy(take_frames(scene, TIMING, sine, 3, 0.005)).float()
    found = rsv.align_motion(frames, TIMING, rsv.read_motion(path, unit="px"))
    assert "motion_repeats" in {reason.code for reason in found.findings}
    near = rsv.align_motion(frames, TIMING, rsv.read_motion(path, unit="px"), offsets=(0.0, 0.015))
    assert near.reliable
    assert near.offset == pytest.approx(0.0, abs=1e-4)


def test_clock_offsets_beyond_the_recording_are_reported(frames, tmp_path):
    clock = np.arange(5.0, 6.0, 1e-3)
    recorded = rsv.read_motion(log(tmp_path / "a.csv", clock, angles(clock)), unit="rad", focal_length=900)
    refuses(lambda: rsv.align_motion(frames, TIMING, recorded, offsets=(7.0, 8.0)), "covers the frames from 5")
    short = rsv.read_motion(log(tmp_path / "b.csv", clock[:20], angles(clock[:20])), unit="rad", focal_length=900)
    refuses(lambda: rsv.align_motion(frames, TIMING, short), "shorter than the frames")


def test_command_does_not_restore_with_a_motion_that_does_not_fit(frames, gyroscope, tmp_path, capsys):
    (tmp_path / "camera.toml").write_text(CONFIG)
    rsv.write_stack(tmp_path / "frames.tif", frames)
    known = ("restore", tmp_path / "frames.tif", tmp_path / "out.tif", "--config", tmp_path / "camera.toml")
    arguments, focal = (*known, "--unit", "rad/s", "--motion"), ("--focal-length", 900)
    header, *lines = gyroscope.read_text().splitlines()
    signs = [f"{time},{-float(x)},{-float(y)}" for time, x, y in (line.split(",") for line in lines)]
    (tmp_path / "opposite.csv").write_text("\n".join([header, *signs]))
    opposite = (*arguments, tmp_path / "opposite.csv", *focal)
    for command, message in (
        ((*arguments, gyroscope, *focal, "--offset", 813.35), "the frames need"),
        (opposite, "does not explain"),
        ((*arguments, gyroscope), "needs a focal_length"),
    ):
        assert message in refused(capsys, *command)
        assert not (tmp_path / "out.tif").exists()
    assert rsvib(*opposite, "--offset", CLOCK) == 0
    assert "4 frames unchanged" in capsys.readouterr().out
    assert (rsv.read_stack(tmp_path / "out.tif") == frames).all()
    assert rsvib(*opposite, "--offset", CLOCK, "--force", "--overwrite") == 0
    assert not (rsv.read_stack(tmp_path / "out.tif") == frames).all()
