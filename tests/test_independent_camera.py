"""The camera of the benchmarks and of the reproduction, compared with the integral of analytic waves."""

import numpy as np
import pytest
from benchmarks.independent_camera import Shake, take_frames
from benchmarks.reproduction import GlobalShutter

TONES = ([[1.3, 0.4], [2.1, 0.0]], [[50.0, 120.0], [30.0, 0.0]], [[0.4, 1.0], [1.3, 0.0]])
IMAGE_MOTION = (40.0, -30.0)
PERIOD, MARGIN = 0.012, (24, 20)


@pytest.mark.parametrize(
    ("wave", "points", "options", "row_time", "exposure"),
    [
        ((7, 0), 1, {}, 2e-4, 11e-3),
        ((0, 9), 2, {"between": 4}, 2e-4, 8e-4),
        ((-11, 20), 1, {}, 2e-4, 8e-4),
        ((-11, 20), 2, {"between": 4}, 0.0, 11e-3),
    ],
)
def test_frames_equal_the_integral_of_a_wave(wave, points, options, row_time, exposure):
    size = (48, 40)
    whole = [points * (s + 2 * m) for s, m in zip(size, MARGIN, strict=True)]
    y, x = np.meshgrid(*(np.arange(n) for n in whole), indexing="ij")
    turn = 2 * np.pi * np.array([wave[0] / whole[1], wave[1] / whole[0]])
    scene = 0.5 + 0.3 * np.cos(turn[0] * x + turn[1] * y)
    shake = Shake(*(np.array(values) for values in TONES), np.array(IMAGE_MOTION))
    frames = take_frames(scene, shake, GlobalShutter(row_time, exposure, PERIOD), 2, size, points=points, **options)
    assert frames.shape == (2, *size)
    rows, columns = np.arange(size[0]), np.arange(size[1])
    for p, frame in enumerate(frames):
        times = p * PERIOD + rows[:, None] * row_time + (np.arange(2000) + 0.5) / 2000 * exposure
        moved = [v * times for v in IMAGE_MOTION]
        for axis in range(2):
            for a, f, phase in zip(*(values[axis] for values in TONES), strict=True):
                moved[axis] = moved[axis] + a * np.sin(2 * np.pi * f * times + phase)
        angle = turn[1] * (rows[:, None] + MARGIN[0] - moved[1]) - turn[0] * moved[0]
        angle = points * (angle[:, None, :] + (turn[0] * (columns + MARGIN[1]))[None, :, None])
        np.testing.assert_allclose(frame, 0.5 + 0.3 * np.cos(angle).mean(-1), rtol=0, atol=3e-5)
