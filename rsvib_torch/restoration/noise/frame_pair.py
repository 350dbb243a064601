"""Noise of a stack from two of its frames: the residual after the scene that explains both best is subtracted.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import torch
from torch import Tensor

from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.noise.high_pass import estimate_noise
from rsvib_torch.restoration.scene_model.observation import row_kernels
from rsvib_torch.restoration.scene_model.row_prior import RowPrior
from rsvib_torch.restoration.scene_model.sampled_rows import sample_rows

__all__ = ["noise_of_frame_pair"]

_MIN_SIDE = 64  # px that two frames must share along each axis, or the whole frame if it is smaller


def noise_of_frame_pair(
    frames: Tensor,
    motion: FrameMotion,
    stack: int,
    ignore: Tensor | None,
    high_pass: Tensor,
    *,
    max_missing: float = 0.1,
) -> Tensor:
    """Noise power of each frame from the two middle ones that have content.

    The least-squares scene of both frames leaves a residual without texture. What texture adds to ``high_pass`` is
    measured as the difference between that estimate and the residual, and assumed equal in all frames.

    Args:
        frames: As in ``ESTIMATORS``, and likewise the next four.
        motion: Motion of the batch.
        stack: Index in the batch.
        ignore: Pixels that were not measured.
        high_pass: (T,) noise power, texture included.
        max_missing: Share of the compared pixels that may be missing.

    Returns:
        (T,); NaN if fewer than two frames have content, or share too few pixels.
    """
    nothing = torch.full_like(high_pass, torch.nan)
    height, width = frames.shape[-2:]
    usable = (~high_pass.isnan()).nonzero().flatten().tolist()
    middle = (len(usable) - 1) // 2
    members = usable[middle : middle + 2]
    if len(members) < 2:
        return nothing
    x, y = (int(step) for step in (motion.shift[stack, members[1]] - motion.shift[stack, members[0]]).tolist())
    columns, rows = width - abs(x), height - abs(y)
    if min(columns, rows) < max(min(_MIN_SIDE, height, width), 8):
        return nothing
    num_rows = min(rows, 256)  # from the middle: more rows cost time and hardly lower the variance
    first_rows = [max(-y, 0) + (rows - num_rows) // 2, max(y, 0) + (rows - num_rows) // 2]
    first_columns = [max(-x, 0), max(x, 0)]

    def shared(values: Tensor) -> Tensor:
        places = zip(members, first_rows, first_columns, strict=True)
        return torch.stack([values[m, :, i : i + num_rows, j : j + columns] for m, i, j in places])

    images, missing = shared(frames), None if ignore is None else shared(ignore)
    measured_share = 1.0 if missing is None else 1.0 - float(missing.any(0).double().mean())
    if measured_share < 1.0 - max_missing:
        return nothing
    rows_of_both = torch.tensor(first_rows, device=frames.device)
    noise = _residual_power(images, motion, stack, rows_of_both, members) / measured_share
    alone = estimate_noise(images, missing).square().mean(-1)
    texture = (alone.mean() - noise).clamp(min=0.0)
    # neither frame has more noise than both together; blur may leave one of them more texture than the other
    upper = 2.0 * noise + (high_pass - alone.amax()).clamp(min=0.0)
    return torch.maximum(high_pass - texture, 0.5 * torch.minimum(high_pass, noise)).minimum(upper)


@torch.no_grad()
def _residual_power(
    images: Tensor,
    motion: FrameMotion,
    stack: int,
    first_rows: Tensor,
    members: list[int],
    *,
    num_frequencies: int = 24,
    prior_weight: float = 1e-4,
) -> Tensor:
    """Residual power per degree of freedom of two images (2, C, R, W) after their least-squares scene is subtracted.

    Only ``num_frequencies`` horizontal frequencies of the upper half are used, where scenes are weakest. A smoothness
    prior of ``prior_weight``, relative to the data, fills in rows of the scene that neither frame contains.
    """
    num_rows, width = images.shape[-2:]
    rows = first_rows[:, None] + torch.arange(num_rows, dtype=torch.float64, device=images.device)
    starts = motion.frame_starts[members][:, None] + rows * motion.timing.row_time
    displacement, node_weights = exposure_trajectory(motion.vibration[stack], starts, motion.timing, "gauss")
    displacement = displacement - motion.shift[stack, members][:, None, None]
    kernels = row_kernels(displacement, node_weights, images.new_ones(2), num_rows, 4 * _MIN_SIDE)
    count = min(num_frequencies, width // 4)
    chosen = torch.linspace(width // 4, width // 2, count, device=images.device, dtype=torch.float32).long()
    sample = sample_rows(images, kernels, chosen)
    explained = sample.explain([RowPrior.smooth(sample.u).precision(sample.u.new_ones(()), prior_weight)])
    power: Tensor = explained.power.sum() / (explained.count * len(chosen) - explained.freedom.sum())
    return power.to(images.dtype)
