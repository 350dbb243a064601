"""Restoration of a window with a detection: results as from the public functions."""

import pytest
import torch
from truth import Motion, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.stacks import restore_trusted


@pytest.mark.parametrize("joint", [False, 3, True])
def test_motions_are_undone_and_unchanged_frames_have_the_shape_of_restored_ones(joint):
    """The frames as taken replace restored ones if nothing moves, or if these are worse; joint: the middle frame."""
    timing, motion = SensorTiming(2e-5, 20, 256), Motion(amplitude=(2.0, 3.0), frequency=(120.0, 90.0))
    frames = torch.from_numpy(take_frames(draw_scene(208, 208, 3), timing, motion, 3)).float()
    frames[:, 20, 30] = torch.nan
    vibration, options = motion.vibration(), {"joint": joint}
    opposite = Vibration(vibration.amplitude, vibration.frequency, vibration.phase + torch.pi)
    taken = frames[1:2] if joint is True else frames
    for given, force, restored, outcome in (
        (vibration, False, True, "helps"),
        (opposite, False, False, "worse"),
        (opposite, True, True, "worse"),
        (Vibration.still(), True, False, None),
    ):
        found = restore_trusted(frames, timing, given, options, force=force)
        assert found.restored == restored
        assert (None if found.verdict is None else found.verdict.overall) == outcome
        assert found.frames.shape == taken.shape
        assert torch.equal(found.frames.nan_to_num(), taken.nan_to_num()) != restored
    assert torch.isnan(found.frames).sum() == len(taken)
