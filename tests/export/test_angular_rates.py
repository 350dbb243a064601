"""Gyroscope logs: their rates, integrated with a parser of their own, are the attitude of the motion."""

from itertools import accumulate

import numpy as np
import pytest
import torch
from refusals import refuses
from scipy.spatial.transform import Rotation

import rsvib_torch as rsv

CAMERA = rsv.Camera(focal_length=800.0)
TIMING = rsv.SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=1500)
SIZE = (1080, 1440)
VIBRATION = rsv.Vibration(
    [[3.0, 0.5], [5.0, 0.2], [2e-3, 0.0]],
    [[90.0, 310.0], [61.0, 240.0], [90.0, 0.0]],
    [[0.3, 2.0], [1.1, 0.0], [2.0, 0.0]],
    image_motion=[40.0, -25.0, 0.01],
    camera=CAMERA,
)


def parsed(path):
    """Header, times in s, and rates in rad/s, by the description of the format."""
    lines = path.read_text().splitlines()
    assert lines[0] == "GYROFLOW IMU LOG"
    end = lines.index("t,gx,gy,gz")
    header = dict(line.split(",") for line in lines[1:end])
    table = np.array([[int(value) for value in line.split(",")] for line in lines[end + 1 :]])
    return header, table[:, 0] * float(header["tscale"]), table[:, 1:] * float(header["gscale"])


def largest_error(times, rates, attitude):
    """Largest angle in rad between the integrated rates and the attitude (N, 3) at the same times."""
    true = Rotation.from_rotvec(attitude)
    steps = Rotation.from_rotvec(0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None])
    turned = list(accumulate([true[0], *steps], lambda before, step: before * step))
    return (true.inv() * Rotation.concatenate(turned)).magnitude().max()


def tones(times, motion=VIBRATION, focal_length=800.0):
    """Attitude (N, 3): pitch Y/f, yaw -X/f, roll -theta, from the tones."""
    angle = 2 * np.pi * motion.frequency.numpy()[:, :, None] * times + motion.phase.numpy()[:, :, None]
    x, y, roll = (motion.amplitude.numpy()[:, :, None] * np.sin(angle)).sum(1) + motion.image_motion.numpy()[
        :, None
    ] * times
    return np.stack([y / focal_length, -x / focal_length, -roll], -1)


def test_round_trip(tmp_path):
    path = tmp_path / "clip.gcsv"
    rsv.write_gcsv(path, VIBRATION, TIMING, SIZE, num_frames=4)
    header, times, rates = parsed(path)
    assert times[0] <= 0.0
    assert times[-1] >= 3 * TIMING.frame_period + 1080 * TIMING.row_time + TIMING.exposure_time
    np.testing.assert_allclose(np.diff(times), times[1] - times[0], rtol=1e-9)
    assert largest_error(times, rates, tones(times)) < 1e-6
    assert largest_error(times, 0 * rates, tones(times)) > 5e-3
    assert largest_error(times, rates[:, [1, 0, 2]], tones(times)) > 1e-3
    # without the terms of the Jacobian, the roll of the coning motion is missing
    slopes = np.gradient(tones(times), times, axis=0)
    assert largest_error(times, slopes, tones(times)) > 1e-5
    assert header["version"] == "1.3"
    assert header["orientation"] == "yxz"
    assert float(header["frame_readout_time"]) == pytest.approx(21.6)
    assert header["frame_readout_direction"] == "0"
    assert len("\n".join(path.read_text().splitlines()[:10])) < 500  # Gyroflow reads the header from 500 bytes


def test_clock_and_sample_rate(tmp_path):
    """Start times of a clock in seconds since 1970, and a stated sample rate."""
    starts = [1.7e9, 1.7e9 + 0.03]
    timing = rsv.SensorTiming(2e-5, 20, 1500, "x", "reverse", frame_start_times=starts)
    samples = torch.linspace(0, 1, 600, dtype=torch.float64)
    motion = rsv.FreeMotion(
        torch.stack([(4 * samples).sin(), (9 * samples).cos()]), start=1.7e9 - 0.01, spacing=2e-4, camera=CAMERA
    )
    path = tmp_path / "clip.gcsv"
    rsv.write_gcsv(path, motion, timing, (1000, 1400), num_frames=2, sample_rate=4000.0)
    header, times, rates = parsed(path)
    assert header["frame_readout_direction"] == "3"
    assert times[0] <= 1.7e9 < times[1] + 1e-6
    assert times[-1] >= starts[-1] + 1400 * 2e-5
    attitude = motion.attitude(torch.from_numpy(times)).numpy()
    assert largest_error(times, rates, attitude) < 1e-6


def test_errors(tmp_path):
    path = tmp_path / "clip.gcsv"
    still = rsv.Vibration((1.0, 1.0), (10.0, 10.0))
    with pytest.raises(ValueError, match=r"require the focal length in px: motion\.with_camera"):
        rsv.write_gcsv(path, still, TIMING, SIZE, 2)
    refuses(lambda: rsv.write_gcsv(path, VIBRATION.expanded(2), TIMING, SIZE, 2), "is a batch")
    zoom = rsv.Vibration((1.0, 1.0, 1e-3, 1e-3), (10.0, 10.0, 10.0, 10.0), camera=CAMERA)
    refuses(lambda: rsv.write_gcsv(path, zoom, TIMING, SIZE, 2), "zoom, which angular rates do not contain")
    with pytest.raises(ValueError, match=r"samples at 1e\+08 Hz.*lower sample_rate"):
        rsv.write_gcsv(path, VIBRATION, TIMING, SIZE, 2, sample_rate=1e8)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        rsv.write_gcsv(tmp_path / "no" / "clip.gcsv", VIBRATION, TIMING, SIZE, 2)
    assert not path.exists()
