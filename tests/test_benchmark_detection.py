"""The benchmark of detection: its camera compared with analytic waves, and one complete run at small size."""

import argparse

import numpy as np
import pytest
import torch
from benchmarks import detection
from benchmarks.detection import errors_of
from benchmarks.independent_camera import Shake, take_frames
from harness import defaults

import rsvib_torch as rsv


@pytest.mark.parametrize("exposure", [4.0, 55.0])
@pytest.mark.parametrize("wave", [(7, 0), (0, 9), (-11, 20)])
def test_frames_of_the_camera_equal_the_integral_of_a_wave(wave, exposure):
    height, width, size = 96, 80, (48, 40)
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    turn = 2 * np.pi * np.array([wave[0] / width, wave[1] / height])
    scene = 0.5 + 0.3 * np.cos(turn[0] * x + turn[1] * y)
    tones = ([[1.3, 0.4], [2.1, 0.0]], [[50.0, 120.0], [30.0, 0.0]], [[0.4, 1.0], [1.3, 0.0]])
    shake = Shake(*(np.array(values) for values in tones), np.array([40.0, -30.0]))
    frames = take_frames(scene, shake, rsv.SensorTiming(2e-4, exposure, 60), 2, size)
    rows, columns = np.arange(size[0]), np.arange(size[1])
    for p in range(2):
        times = (p * 60 + rows[:, None] + (np.arange(2000) + 0.5) / 2000 * exposure) * 2e-4
        moved = [v * times for v in (40.0, -30.0)]
        for axis in range(2):
            for a, f, phase in zip(*(values[axis] for values in tones), strict=True):
                moved[axis] = moved[axis] + a * np.sin(2 * np.pi * f * times + phase)
        angle = (turn[1] * (rows[:, None] + 24 - moved[1]) - turn[0] * moved[0])[:, None, :]
        angle = angle + (turn[0] * (columns + 20))[None, :, None]
        expected = 0.5 + 0.3 * np.cos(angle).mean(-1)
        np.testing.assert_allclose(frames[p], expected, rtol=0, atol=3e-6)


def test_errors_refer_to_the_corresponding_tone():
    shake = Shake(
        np.array([[1.0, 0.5], [0.8, 0.0]]),
        np.array([[40.0, 90.0], [60.0, 0.0]]),
        np.array([[3.1, 0.2], [1.0, 0.0]]),
        np.zeros(2),
    )
    found = rsv.Vibration([[0.9, 0.6], [0.7, 0.0]], [[90.1, 40.2], [75.0, 0.0]], [[0.3, -3.1], [1.0, 0.0]])
    result = argparse.Namespace(vibration=found, std=rsv.Vibration([[0.1, 0.2], [0.3, 0.0]], 1.0, 1.0))
    errors, _ = errors_of(result, shake)
    np.testing.assert_allclose(errors["amplitude"][0], [-0.4, 0.4])
    np.testing.assert_allclose(errors["frequency"][0], [0.2, 0.1])
    np.testing.assert_allclose(errors["phase"][0], [2 * np.pi - 6.2, 0.1])
    assert np.isnan(errors["amplitude"][1]).all()  # error too large: not detected


@pytest.mark.slow
def test_a_small_run():
    options = defaults(detection)
    results = detection.rows(options)
    assert [r["trials"] for r in results] == [2, 2]
    for result in results:
        assert result["lost"] == 0
        assert 0.1 < result["over_bound"] < 4
    text = detection.lines(results, options)
    assert sum(line.startswith("| 0.01 |") for line in text) == 2
    assert torch.get_default_dtype() == torch.float32
