"""Borders of restored video frames of an independent camera."""

import numpy as np
import pytest
import torch
from refusals import refuses
from truth import draw_scene, take_frames

import rsvib_torch as rsv

SIZE, RATE = 160, 30.0
TIMING = rsv.SensorTiming(row_time=150e-6, exposure_rows=4, frame_rows=1 / RATE / 150e-6)


class Shaken:
    """Vibration on a slow pan with shaking of 3 Hz."""

    def displacement(self, t):
        x = 2.1 * np.sin(2 * np.pi * 52 * t + 0.5) + 2.0 * np.sin(2 * np.pi * 3 * t) + 12.0 * t
        y = 1.6 * np.sin(2 * np.pi * 71 * t + 1.0)
        return np.stack([x, y], -1)


@pytest.fixture(scope="module", name="tracked")
def make_tracked():
    scene = draw_scene(SIZE + 80, SIZE + 80, seed=3)
    frames = torch.as_tensor(take_frames(scene, TIMING, Shaken(), 30, 0.005), dtype=torch.float32)
    tracker = rsv.VibrationTracker(TIMING, columns=None)
    return [tracker.update(frame) for frame in frames]


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


def test_wrong_borders_are_refused():
    refuses(lambda: rsv.VideoBorder("zoom"), "border must be 'mirror'")
    refuses(lambda: rsv.VideoBorder("crop"), "margins go with border='crop' and only with it")
    refuses(lambda: rsv.Margins(4, 4, 0, 0).cut(torch.zeros(8, 8)), "leave nothing of frames of 8 x 8 px")
