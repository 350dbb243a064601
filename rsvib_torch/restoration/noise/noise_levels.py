"""Noise told from texture by what two frames of one scene do not have in common."""

import math

import torch
from torch import Tensor

from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.noise.blurred_noise import noise_beside_blur
from rsvib_torch.restoration.noise.noise_floor import noise_floor
from rsvib_torch.restoration.noise.single_frame import estimate_noise
from rsvib_torch.restoration.scene_model.observation import row_kernels
from rsvib_torch.restoration.scene_model.row_prior import RowPrior
from rsvib_torch.restoration.scene_model.sampled_rows import sample_rows

__all__ = ["noise_levels"]

_ROWS = 256  # at most, from the middle of the frame
_SMALLEST = 64  # rows and columns that two frames have to share
_NARROWEST = 8  # rows and columns of frames that are compared at all
_FREQUENCIES = 24  # spread over the upper half, where scenes are weakest
_WEAK = 1e-4  # of the prior that bridges what no frame saw, relative to the data
_ALIKE = 0.8  # of the noise estimated from one frame: a floor that is not lower says nothing else
_TEXTURE = 1 / 9  # of the noise estimated from one frame is noise at least: more may be lost than can be gained
_MISSING = 0.1  # of the pixels of two frames that are compared, at most
_EVERY = 8  # rows of which one tells whether a frame shows anything
_FLAT = 1e-6  # of the largest value: frames that vary by less show nothing, not even noise


def noise_levels(frames: Tensor, motion: FrameMotion, stack: int, ignore: Tensor | None = None) -> Tensor:
    """Standard deviation of the noise of each frame of a stack.

    Where the scene is blurred, noise is what is not. Elsewhere, what texture adds to the noise estimated from single
    frames is the same in all of them: the excess of that estimate over what the two middle frames disagree by, once the
    scene that explains them best is taken away. A frame by itself has as much noise as its spectrum flattens to,
    within bounds. A frame that shows nothing, or too little, is taken to have as much noise as the others.

    Args:
        frames: (T, C, H, W) in row order, what is to be ignored filled.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.
        ignore: Boolean mask shaped like the frames of pixels that were not measured.

    Returns:
        (T,), in the dtype of the frames; 0 where no frame tells.
    """
    power = estimate_noise(frames, ignore).square().nanmean(-1).masked_fill(_flat(frames), math.nan)
    bare = noise_beside_blur(frames, motion, stack, ignore)
    if bare is not None:
        power = torch.fmin(power, torch.where(power.isnan(), math.nan, bare.to(power.dtype)))
    else:
        pair = _shared_part(frames, motion, stack, power.isnan(), ignore) if len(frames) > 1 else None
        if pair is None:
            floor = noise_floor(frames, ignore).mean(-1).to(power.dtype)
            power = torch.where(floor < _ALIKE * power, torch.maximum(floor, _TEXTURE * power), power)
        else:
            images, hidden, rows, members = pair
            measured = 1.0 if hidden is None else 1.0 - hidden.any(0).to(power.dtype).mean()
            noise = _residual_power(images, motion, stack, rows, members) / measured
            alone = estimate_noise(images, hidden).square().mean(-1)
            texture = (alone.mean() - noise).clamp(min=0.0)
            # neither of two frames has more noise than both; blur may leave one of them more texture than the other
            most = 2.0 * noise + (power - alone.amax()).clamp(min=0.0)
            power = torch.maximum(power - texture, 0.5 * torch.minimum(power, noise)).minimum(most)
    return torch.where(power.isnan(), power.nanmedian(), power).nan_to_num(nan=0.0).sqrt()


def _flat(frames: Tensor) -> Tensor:
    """Which frames (T,) show nothing."""
    rows = frames[..., ::_EVERY, :].flatten(1)
    low, high = rows.aminmax(dim=-1)
    return high - low <= _FLAT * torch.maximum(-low, high)


def _shared_part(
    frames: Tensor, motion: FrameMotion, stack: int, silent: Tensor, ignore: Tensor | None
) -> tuple[Tensor, Tensor | None, Tensor, list[int]] | None:
    """Columns and rows (2, C, R, W') that the two middle frames share, of those that are not ``silent`` (T,).

    Moreover the mask of what is to be ignored, the first row of each, and which frames these are.
    """
    height, width = frames.shape[-2:]
    speaking = (~silent).nonzero().flatten().tolist()
    middle = (len(speaking) - 1) // 2
    members = speaking[middle : middle + 2]
    if len(members) < 2:
        return None
    x, y = (int(step) for step in (motion.shift[stack, members[1]] - motion.shift[stack, members[0]]).tolist())
    columns, rows = width - abs(x), height - abs(y)
    if min(columns, rows) < max(min(_SMALLEST, height, width), _NARROWEST):
        return None
    count = min(rows, _ROWS)
    first = [max(-y, 0) + (rows - count) // 2, max(y, 0) + (rows - count) // 2]
    left = [max(-x, 0), max(x, 0)]

    def shared(values: Tensor) -> Tensor:
        return torch.stack(
            [
                values[member, :, top : top + count, begin : begin + columns]
                for member, top, begin in zip(members, first, left, strict=True)
            ]
        )

    hidden = None if ignore is None else shared(ignore)
    if hidden is not None and float(hidden.any(0).double().mean()) > _MISSING:
        return None
    return shared(frames), hidden, torch.tensor(first, device=frames.device), members


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
