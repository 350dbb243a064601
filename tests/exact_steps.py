"""The steps of the exact restoration one by one, with quantities that tests choose."""

from dataclasses import replace

from rsvib_torch.restoration.exact.exact import model_stacks, solve_scenes
from rsvib_torch.restoration.exact.priors import PRIORS
from rsvib_torch.restoration.exact.scene_solver import Partition
from rsvib_torch.restoration.frame_motion import frame_motion, joint_groups


def stack_of(frames, timing, vibration, **options):
    """The model of a stack (T, H, W)."""
    motion = frame_motion(vibration.expanded(1), timing.in_row_order(), len(frames), frames.shape[-2])
    return model_stacks(frames[None, :, None], motion, **options)[0]


def solved(stack, *, joint=False, regularisation=1.0, **changes):
    """Restored frames (T', H', W') of a stack, of whose model some quantities are replaced."""
    stack = replace(stack, **changes)
    tasks = stack.tasks(joint_groups(len(stack.frames), joint), regularisation)
    images, _ = solve_scenes(tasks, PRIORS["gaussian"], regularisation, Partition())
    return images[:, 0]


class FixedStrength:
    """The strength of the prior that follows from the noise level."""

    def of(self, noise, choose):
        return 1.0
