"""Noise told from texture by what two frames of one scene do not have in common."""

import torch
from torch import Tensor

from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.blurred_noise import noise_beside_blur
from rsvib_torch.restoration.motion import FrameMotion
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.prior import RowPrior
from rsvib_torch.restoration.row_system import row_kernels
from rsvib_torch.restoration.sampled_rows import sample_rows

__all__ = ["noise_levels"]

_ROWS = 256  # at most, from the middle of the frame
_SMALLEST = 64  # rows and columns that two frames have to share
_FREQUENCIES = 24  # spread over the upper half, where scenes are weakest
_WEAK = 1e-4  # of the prior that bridges what no frame saw, relative to the data


def noise_levels(frames: Tensor, motion: FrameMotion, stack: int) -> Tensor:
    """Standard deviation of the noise of each frame of a stack.

    Where the scene is blurred, noise is what is not. Elsewhere, what texture adds to the noise estimated from single
    frames is the same in all of them: the excess of that estimate over what the two middle frames disagree by, once the
    scene that explains them best is taken away.

    Args:
        frames: (T, C, H, W) in row order.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.

    Returns:
        (T,), in the dtype of the frames.
    """
    power = estimate_noise(frames).square().mean(-1)
    bare = noise_beside_blur(frames, motion, stack)
    if bare is not None:
        power = power.minimum(bare.to(power.dtype))
    elif len(frames) > 1:
        pair = _shared_part(frames, motion, stack)
        if pair is not None:
            images, rows, members = pair
            noise = _residual_power(images, motion, stack, rows, members)
            alone = estimate_noise(images).square().mean(-1)
            texture = (alone.mean() - noise).clamp(min=0.0)
            # neither of two frames has more noise than both; blur may leave one of them more texture than the other
            most = 2.0 * noise + (power - alone.amax()).clamp(min=0.0)
            power = torch.maximum(power - texture, 0.5 * torch.minimum(power, noise)).minimum(most)
    return power.sqrt()


def _shared_part(frames: Tensor, motion: FrameMotion, stack: int) -> tuple[Tensor, Tensor, list[int]] | None:
    """Columns and rows that the two middle frames share, (2, C, R, W'), and the first row of each."""
    height, width = frames.shape[-2:]
    members = [(len(frames) - 1) // 2, (len(frames) - 1) // 2 + 1]
    x, y = (int(step) for step in (motion.shift[stack, members[1]] - motion.shift[stack, members[0]]).tolist())
    columns, rows = width - abs(x), height - abs(y)
    if min(columns, rows) < min(_SMALLEST, height, width):
        return None
    count = min(rows, _ROWS)
    first = [max(-y, 0) + (rows - count) // 2, max(y, 0) + (rows - count) // 2]
    left = [max(-x, 0), max(x, 0)]
    images = torch.stack(
        [
            frames[member, :, top : top + count, begin : begin + columns]
            for member, top, begin in zip(members, first, left, strict=True)
        ]
    )
    return images, torch.tensor(first, device=frames.device), members


@torch.no_grad()
def _residual_power(images: Tensor, motion: FrameMotion, stack: int, first: Tensor, members: list[int]) -> Tensor:
    """Power of the noise that is left of two images when the scene that explains them best is taken away."""
    count, width = images.shape[-2:]
    rows = first[:, None] + torch.arange(count, device=images.device)
    starts = motion.frame_starts[members][:, None] + rows * motion.timing.row_time
    displacement, node_weights = exposure_trajectory(motion.vibration[stack], starts, motion.timing, "gauss")
    displacement = displacement - motion.shift[stack, members][:, None, None]
    kernels = row_kernels(displacement, node_weights, images.new_ones(2), count, 4 * _SMALLEST)
    chosen = torch.linspace(width // 4, width // 2, min(_FREQUENCIES, width // 4), device=images.device).long()
    sample = sample_rows(images, kernels, chosen)
    explained = sample.explain([RowPrior.smooth(sample.u).precision(sample.u.new_ones(()), _WEAK)])
    power: Tensor = explained.power.sum() / (explained.count * len(chosen) - explained.freedom.sum())
    return power.to(images.dtype)
