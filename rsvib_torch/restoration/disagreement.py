"""Noise told from texture by what two frames of one scene do not have in common."""

import math

import torch
from torch import Tensor

from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.banded_solver import BandedFactor, factor_skewed
from rsvib_torch.restoration.motion import FrameMotion
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.prior import ORDER, RowPrior
from rsvib_torch.restoration.row_system import row_kernels, smooth_band, smooth_kernels

__all__ = ["noise_levels"]

_ROWS = 512  # at most, from the middle of the frame
_SMALLEST = 64  # rows and columns that two frames have to share
_FREQUENCIES = 24  # spread over the upper half, where scenes are weakest
_STEP = 1.2  # in the strength of the prior, for a derivative
_WEAK = 1e-4  # of the prior that bridges what no frame saw, relative to the data


def noise_levels(frames: Tensor, motion: FrameMotion, stack: int) -> Tensor:
    """Standard deviation of the noise of each frame of a stack.

    What texture adds to the noise estimated from single frames is the same in all of them. It is the excess of that
    estimate over what the two middle frames disagree by, once the scene that explains them best is taken away.

    Args:
        frames: (T, C, H, W) in row order.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.

    Returns:
        (T,), in the dtype of the frames.
    """
    power = estimate_noise(frames).square().mean(-1)
    if len(frames) > 1:
        pair = _shared_part(frames, motion, stack)
        if pair is not None:
            images, rows, members = pair
            noise = _residual_power(images, motion, stack, rows, members)
            texture = (estimate_noise(images).square().mean() - noise).clamp(min=0.0)
            power = torch.maximum(power - texture, 0.5 * torch.minimum(power, noise))
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
    channels, count, width = images.shape[1:]
    taper = torch.hann_window(width + 2, periodic=False, dtype=images.dtype, device=images.device)[1:-1]
    rows = first[:, None] + torch.arange(count, device=images.device)
    starts = motion.frame_starts[members][:, None] + rows * motion.timing.row_time
    displacement, node_weights = exposure_trajectory(motion.vibration[stack], starts, motion.timing, "gauss")
    displacement = displacement - motion.shift[stack, members][:, None, None]
    kernels = row_kernels(displacement, node_weights, images.new_ones(2), count, 4 * _SMALLEST)
    scene = kernels.scene_rows(count)
    chosen = torch.linspace(width // 4, width // 2, min(_FREQUENCIES, width // 4), device=images.device).long()
    u = chosen / width

    angle = (-2 * torch.pi) * (torch.arange(width, device=u.device)[:, None] * chosen % width) / width
    waves = torch.polar(torch.ones_like(angle, dtype=torch.float64), angle.to(torch.float64)).to(
        images.dtype.to_complex()
    )
    mean = images.mean((-2, -1), keepdim=True)
    spectra = (((images - mean) * taper).to(waves.dtype) @ waves).transpose(1, 2)  # (2, R, C, U)
    turns = kernels.middle[..., None] * u
    spectra = spectra * torch.polar(torch.ones_like(turns), 2 * torch.pi * turns).to(spectra.dtype)[:, :, None]

    used = kernels.weight.to(images.dtype).flatten()[:, None, None]
    spectra = (spectra * used.unflatten(0, (2, count))).flatten(0, 1)
    taps = [tap[:, None] for tap in smooth_kernels(kernels, images.dtype).taps(u)]
    base = (kernels.first - scene.top).flatten()
    right = spectra.new_zeros(scene.count, channels, len(u))
    for i, tap in enumerate(taps):
        right.index_add_(0, base + i, tap.conj() * spectra)
    normal = smooth_band(kernels, scene, max(len(taps) - 1, ORDER), ORDER, images.dtype)
    factors = [
        factor_skewed(normal.at(u, RowPrior.smooth(u).precision(u.new_ones(()), strength)))
        for strength in (_WEAK, _STEP * _WEAK)
    ]
    fitted = factors[0].solve(right)
    residual = (spectra - sum(tap * fitted[base + i] for i, tap in enumerate(taps))) * used
    free = used.sum() * len(u) - _degrees_of_freedom(factors)
    power: Tensor = residual.abs().square().sum() / (channels * free * taper.square().sum())
    return power


def _degrees_of_freedom(factors: list[BandedFactor]) -> Tensor:
    """How many values the fit follows, from the determinants for a prior and one that is _STEP times as strong."""
    growth = factors[1].pivots.log().to(torch.float64).sum() - factors[0].pivots.log().to(torch.float64).sum()
    return factors[0].pivots.numel() - growth / math.log(_STEP)
