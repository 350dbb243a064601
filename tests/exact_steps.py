"""The steps of the exact restoration one by one, with quantities that tests choose."""

from dataclasses import replace

import numpy as np

from rsvib_torch.options import ExactOptions
from rsvib_torch.restoration.exact import model_frames, solve_scenes
from rsvib_torch.restoration.frame_motion import MovingFrames, frame_motion, joint_groups


def model_of(frames, timing, vibration, **options):
    """The model of a stack (T, H, W)."""
    motion = frame_motion(
        vibration.expanded(1), timing.in_row_order(), timing.frame_starts(len(frames)), frames.shape[-2]
    )
    return model_frames(MovingFrames(frames[None, :, None], motion), **options)


def solved(model, *, joint=False, regularisation=1.0, **changes):
    """Restored frames (T', H', W') of a stack, of whose model some quantities are replaced; strength of the prior 1."""
    model = replace(model, **changes)
    scenes = model.scenes(joint_groups(model.images.shape[1], joint))
    scenes = replace(scenes, strength=np.full(len(scenes.stack), regularisation))
    images, _ = solve_scenes(model, scenes, ExactOptions(regularisation=regularisation))
    return images[:, 0]
