"""Borders of restored video frames of an independent camera."""

import numpy as np
import pytest
import torch
from truth import Curve, recorded

import rsvib_torch as rsv

SIZE, RATE = 160, 30.0
TIMING = rsv.SensorTiming(row_time=150e-6, exposure_rows=4, frame_rows=1 / RATE / 150e-6)


@Curve
def shaken(t):
    """Vibration on a slow pan with shaking of 3 Hz."""
    x = 2.1 * np.sin(2 * np.pi * 52 * t + 0.5) + 2.0 * np.sin(2 * np.pi * 3 * t) + 12.0 * t
    return np.stack([x, 1.6 * np.sin(2 * np.pi * 71 * t + 1.0)], -1)


@pytest.fixture(scope="module", name="tracked")
def make_tracked():
    tracker = rsv.VibrationTracker(TIMING, columns=None)
    return [tracker.update(frame) for frame in recorded((SIZE, SIZE), TIMING, shaken, 30, 0.005, seed=3)]


def test_held_pixels_keep_their_value_and_others_are_restored(tracked):
    border = rsv.VideoBorder("hold")
    before = border(tracked[10])
    after = border(tracked[11])
    hidden = ~tracked[11].visible
    assert 0 < hidden.sum() < 0.1 * hidden.numel()
    assert torch.equal(after[hidden], before[hidden])
    assert torch.equal(after[~hidden], tracked[11].restored[~hidden])
    assert not torch.equal(tracked[11].restored[hidden], before[hidden])


def test_cropped_frames_contain_recorded_pixels_only(tracked):
    margins = rsv.Margins()
    for one in tracked:
        margins = margins.widest(rsv.Margins.of(one.visible))
    assert max(margins.left, margins.right, margins.top, margins.bottom) <= 6
    border = rsv.VideoBorder("crop", margins)
    for one in tracked:
        frame = border(one)
        assert torch.equal(frame, margins.cut(one.restored))
        assert margins.cut(one.visible).all()
    assert [side % 2 for side in frame.shape] == [0, 0]
    narrower = rsv.Margins(margins.top, margins.bottom, max(margins.left - 1, 0), max(margins.right - 1, 0))
    assert not all(narrower.cut(one.visible).all() for one in tracked)
