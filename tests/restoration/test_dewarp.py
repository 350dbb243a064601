from functools import partial

import numpy as np
import pytest
import torch
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration import restore

dewarp = partial(restore, method="dewarp")
TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


@pytest.fixture(scope="module")
def short():
    motion = Motion()
    scene = draw_scene(336, 288, seed=14, blur=1.0)
    frames = torch.from_numpy(take_frames(scene, TIMING, motion, 2))
    return crop(scene), frames, motion


def test_distortion_is_removed(short):
    truth, frames, motion = short
    for frame, restored in zip(frames, dewarp(frames, TIMING, motion.vibration()), strict=True):
        assert decibel(restored, truth) > decibel(frame, truth) + 25
    half = dewarp(frames, TIMING, motion.scaled(0.5).vibration())
    assert decibel(half, truth) < decibel(frames, truth) + 12


def test_sinusoids_are_interpolated_exactly():
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=1, frame_rows=2048)
    motion = Motion(phase=(0.2, 2.0))
    rows, columns = np.arange(300.0)[:, None], np.arange(200.0)
    x, y = motion.displacement((rows[:, 0] + 0.5) * timing.row_time).T

    def scene(r, c):
        return np.sin(0.5 * r + 0.3 * c) + np.sin(0.9 * r - 0.7 * c)

    frame = torch.from_numpy(scene(rows - y[:, None], columns - x[:, None]))
    restored = dewarp(frame[None], timing, motion.vibration())[0].numpy()
    assert abs(restored - scene(rows, columns))[16:-16, 24:-24].max() < 2e-3
    assert abs(frame.numpy() - scene(rows, columns))[16:-16, 24:-24].max() > 1
