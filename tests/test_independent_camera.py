"""The camera of the tests, benchmarks and the reproduction, compared with the integral of analytic waves."""

from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.independent_camera import Shake, take_frames

TONES = ([[1.3, 0.4], [2.1, 0.0]], [[50.0, 120.0], [30.0, 0.0]], [[0.4, 1.0], [1.3, 0.0]])
IMAGE_MOTION = (40.0, -30.0)
PERIOD, MARGIN = 0.012, (24, 20)


@pytest.mark.parametrize(
    ("wave", "options", "row_time", "exposure"),
    [
        ((7, 0), {}, 2e-4, 11e-3),
        ((0, 9), {"points": 2}, 2e-4, 8e-4),
        ((11, 41), {}, 2e-4, 8e-4),
        ((11, 41), {"points": 2}, 0.0, 11e-3),
        ((3, 9), {"between": 1}, 2e-4, 11e-3),
    ],
)
def test_frames_equal_the_integral_of_a_wave(wave, options, row_time, exposure):
    """Whole cycles along rows, half cycles across them."""
    size, points = (48, 40), options.get("points", 1)
    whole = [points * (s + 2 * m) for s, m in zip(size, MARGIN, strict=True)]
    turn = 2 * np.pi * wave[0] / whole[1], np.pi * wave[1] / whole[0]
    along, across = np.cos(turn[0] * np.arange(whole[1])), np.cos(turn[1] * (np.arange(whole[0]) + 0.5))
    scene = 0.5 + 0.3 * across[:, None] * along
    shake = Shake(*(np.array(values) for values in TONES), np.array(IMAGE_MOTION))
    timing = SimpleNamespace(row_time=row_time, exposure_time=exposure, frame_period=PERIOD)
    frames = take_frames(scene, shake, timing, 2, size, **options)
    assert frames.shape == (2, *size)
    rows, columns = np.arange(size[0]), np.arange(size[1])
    for p, frame in enumerate(frames):
        times = p * PERIOD + rows[:, None] * row_time + (np.arange(2000) + 0.5) / 2000 * exposure
        moved = [v * times for v in IMAGE_MOTION]
        for axis in range(2):
            for a, f, phase in zip(*(values[axis] for values in TONES), strict=True):
                moved[axis] = moved[axis] + a * np.sin(2 * np.pi * f * times + phase)
        down = points * (rows[:, None] + MARGIN[0] - moved[1]) + 0.5
        right = points * (columns[:, None] + MARGIN[1] - moved[0][:, None])
        wave_of = np.cos(turn[1] * down)[:, None] * np.cos(turn[0] * right)
        np.testing.assert_allclose(frame, 0.5 + 0.3 * wave_of.mean(-1), rtol=0, atol=3e-5)
