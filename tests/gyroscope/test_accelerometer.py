"""Comparison of a detected vibration with an accelerometer, whose record is computed from the true motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

TONES = {0: [(1.2, 137.0, 0.3), (0.4, 411.0, -1.0)], 1: [(0.7, 90.5, 2.0)]}  # px, Hz, rad
PIXEL, OFFSET, RATE = 12.5e-6, 100.73456, 3200.0  # m, s, samples per second


@pytest.fixture(scope="module", name="detection")
def make_detection():
    timing = rsv.SensorTiming(row_time=4e-5, exposure_rows=20, frame_rows=416.6667)
    tones = np.zeros((3, 2, 2))
    for axis, of_axis in TONES.items():
        tones[:, axis, : len(of_axis)] = np.transpose(of_axis)
    options = {
        "num_frames": 16,
        "noise": rsv.SensorNoise(read_noise=0.005),
        "generator": torch.Generator().manual_seed(0),
    }
    frames = rsv.simulate_frames(city_and_fields(160, 160, seed=3), timing, rsv.Vibration(*tones), **options)
    return rsv.detect_vibration(frames, timing)


def accelerometer(duration=2.0, rate=RATE, speed=1.0, start=100.0):
    """Times in s and acceleration in m/s^2; its clock runs at ``speed``."""
    times = np.arange(0.0, duration, 1 / rate) + start
    values = np.random.default_rng(1).normal([0.0, 9.81], 0.3, (len(times), 2))
    for axis, of_axis in TONES.items():
        for amplitude, frequency, phase in of_axis:
            angular = 2 * np.pi * frequency * speed
            values[:, axis] -= amplitude * PIXEL * angular**2 * np.sin(angular * (times - OFFSET) + phase)
    return times, values


def test_clock_scale_and_tones_are_those_of_the_motion(detection):
    found = rsv.compare_accelerometer(detection, *accelerometer())
    assert found.offset == pytest.approx(OFFSET, abs=5 * found.offset_std)
    assert found.offset_std < 1e-5
    assert found.scale == pytest.approx(PIXEL, abs=4 * found.scale_std)
    assert found.scale_std < 0.005 * PIXEL
    assert found.axis == ("x", "x", "y")
    assert found.agree.all()
    assert found.coherence.min() > 0.9
    assert ((found.ratio - PIXEL).abs() < 4 * found.ratio_std).all()
    assert len(found.plot().axes) == 2
    assert rsv.AccelerometerComparison(**vars(found)).to_dict() == found.to_dict()


@pytest.mark.parametrize(
    ("options", "speed", "value"),
    [
        ({"pixel_size": 1.1 * PIXEL}, 1.0, "ratio"),
        ({"offset": OFFSET + 1e-4}, 1.0, "phase"),
        ({"offset": OFFSET}, 1.002, "difference"),
    ],
)
def test_a_wrong_scale_clock_or_frequency_disagrees(detection, options, speed, value):
    found = rsv.compare_accelerometer(detection, *accelerometer(speed=speed), **options)
    expected = found.scale if value == "ratio" else 0.0
    far = (getattr(found, value) - expected).abs() > 3 * getattr(found, f"{value}_std")
    assert far.all()
    assert not found.agree.any()


def test_the_clock_is_unknown_if_no_phases_agree(detection):
    """The record begins after the frames."""
    assert np.isnan(rsv.compare_accelerometer(detection, *accelerometer(start=100.8)).offset_std)


def test_clocks_that_differ_by_periods_are_stated(detection):
    """Tones of 137 and 411 Hz, the third multiple, agree at 1 / 137 s later as well."""
    alone = replace(detection, reliable=torch.tensor([True, False]))
    found = rsv.compare_accelerometer(alone, *accelerometer())
    shifts = (np.array([found.offset, *found.other_offsets]) - OFFSET) * 137.0
    np.testing.assert_allclose(shifts, shifts.round(), atol=0.01)
    assert len(shifts) > 50


def test_records_that_cannot_be_compared_are_refused(detection):
    for record, options, message in (
        (accelerometer(rate=500.0), {}, "500 samples per second are too few for a tone of 411"),
        (accelerometer(duration=0.1), {}, "shorter than the frames"),
        (accelerometer(), {"offsets": (3.0, 4.0)}, "offsets 3 to 4 s: the recording covers the frames from"),
    ):
        with pytest.raises(ValueError, match=message):
            rsv.compare_accelerometer(detection, *record, **options)
