"""Methods ``"dewarp"`` and ``"banded"``: what they undo, and their boundaries."""

from functools import partial

import numpy as np
import pytest
import torch
from truth import Motion, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv

TIMING = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
dewarp = partial(rsv.restore, method="dewarp")


@pytest.mark.parametrize(("method", "noise", "gain"), [("dewarp", 0.0, 25), ("banded", 0.003, 20)])
def test_distortion_is_removed(method, noise, gain):
    motion, scene = Motion(), draw_scene(336, 288, seed=14, blur=1.0)
    truth, frames = crop(scene), torch.from_numpy(take_frames(scene, TIMING, motion, 2, noise))
    good, half = (rsv.restore(frames, TIMING, one.vibration(), method=method) for one in (motion, motion.scaled(0.5)))
    for frame, restored, halfway in zip(frames, good, half, strict=True):
        assert decibel(restored, truth) > decibel(frame, truth) + gain
        assert decibel(halfway, truth) < decibel(frame, truth) + 12


def test_sinusoids_are_interpolated_exactly():
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=1, frame_rows=2048)
    motion = Motion(phase=(0.2, 2.0))
    rows, columns = np.arange(300.0)[:, None], np.arange(200.0)
    x, y = motion.displacement((rows[:, 0] + 0.5) * timing.row_time).T

    def scene(r, c):
        return np.sin(0.5 * r + 0.3 * c) + np.sin(0.9 * r - 0.7 * c)

    frame = torch.from_numpy(scene(rows - y[:, None], columns - x[:, None]))
    restored = dewarp(frame[None], timing, motion.vibration())[0].numpy()
    assert abs(restored - scene(rows, columns))[16:-16, 24:-24].max() < 2e-3
    assert abs(frame.numpy() - scene(rows, columns))[16:-16, 24:-24].max() > 1


def test_boundaries_are_not_periodic():
    frames = torch.full((1, 128, 96), 0.2)
    frames[:, :, :12] = 1.0
    frames[:, :12] = 1.0
    restored = rsv.restore(frames, TIMING, rsv.Vibration([3.1, 5.2], [50.0, 30.0], [0.5, 1.0]), method="banded")
    assert (restored[:, 40:, -16:] - 0.2).abs().max() < 1e-3
    assert (restored[:, -16:, 40:] - 0.2).abs().max() < 1e-3
    assert restored.amax() > 0.8
