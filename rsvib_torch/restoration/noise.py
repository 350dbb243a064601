"""Noise level of every frame of a stack.

``noise_levels`` (at the end of the file) is the entry. ``estimate_noise`` measures single images and counts fine
texture as noise; a second frame separates noise from texture.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from statistics import NormalDist

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.frames.pixels import cut_parts
from rsvib_torch.numerics.tables import (
    Array,
    constant,
    median,
    quantile,
    table,
    tables,
    take_stacks,
    valid_mean,
    without_nan,
)
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.frame_pairs import common_parts
from rsvib_torch.restoration.observation import RowKernels
from rsvib_torch.restoration.scene_prior import unexplained

# Single images: the quietest blocks of a high-pass residual


def estimate_noise(frames: Tensor, ignore: Tensor | None = None) -> Tensor:
    """Standard deviation of white noise in each image.

    The outer product of two differences of eighth order passes the corner of the spectrum, where optics pass least.
    The 15 % quantile of its energy in blocks of 16 x 16 px excludes blocks with texture. A scene that has texture up to
    the corner everywhere counts as noise. Of large images, strips spread over all rows are used.

    Args:
        frames: (..., H, W).
        ignore: Boolean mask of the same shape of pixels without noise of their own. Blocks with many of them do not
            count.

    Returns:
        Standard deviation, shape (...), in the unit of the frames; NaN for an image without a usable block.

    Example:
        >>> import torch
        >>> noise = torch.randn(200, 300, generator=torch.Generator().manual_seed(0))
        >>> round(estimate_noise(0.1 * noise).item(), 2)
        0.1
    """
    return torch.as_tensor(noise_deviation(frames, ignore), dtype=frames.dtype, device=frames.device)


def noise_deviation(frames: Tensor, ignore: Tensor | None) -> Array:
    """``estimate_noise`` as an array."""
    shape = (frames.shape[-2], frames.shape[-1])
    orders = [min(8, (extent - 1) // 2 + 1, extent - 1) for extent in shape]
    inner = [extent - order for extent, order in zip(shape, orders, strict=True)]
    block = min(16, *inner)
    height, width = (extent // block * block for extent in inner)
    stride = max(1, height * width // (block**2 * 2048))  # 2048 blocks determine the quantile well enough

    def blocks_of(images: Tensor) -> Tensor:
        """Blocks (..., n, m, rows, columns), with the neighbours that differences need."""
        inside = images[..., : height + orders[0], : width + orders[1]]
        return inside.unfold(-2, block + orders[0], stride * block).unfold(-2, block + orders[1], block)

    # energy of the differences along both axes, relative to that of white noise of variance 1
    down, along = (constant(_differences, block, order, dtype=frames.dtype, device=frames.device) for order in orders)
    images = frames.reshape(-1, *shape)
    pixels = height * width // stride
    parts = []
    for part in runs(len(images), at_once(16 * pixels, frames.device, cpu_bytes=2**26)):
        blocks = blocks_of(images[part])
        differences = (blocks.reshape(-1, blocks.shape[-1]) @ along.T).view(-1, blocks.shape[-2], block)
        energy = torch.bmm(down.expand(len(differences), -1, -1), differences).square_().mean((-2, -1))
        parts.append(energy.view(len(blocks), -1))
    energy = torch.cat(parts)
    if ignore is not None:
        # blocks count up to a tenth of missing pixels; if all of an image miss more, those that miss least
        missing = blocks_of(ignore.to(frames.dtype)).mean((-2, -1))
        counts = (missing <= missing.amin((-2, -1), keepdim=True).clamp(min=0.1)) & (missing < 1)
        energy = energy.masked_fill(~counts.view(energy.shape), math.nan)
    powers = table(energy).reshape(*frames.shape[:-2], -1)
    powers = powers / math.prod(math.comb(2 * order, order) for order in orders)
    # Means of squares of pure noise scatter, so that their low quantile lies below the true mean, by as much as that of
    # a chi-squared variable (Wilson and Hilferty 1931).
    share = 0.15
    variance = min(2.0 * math.prod(_correlation_area(difference) for difference in orders) / (9.0 * block**2), 0.2)
    expected = (1.0 - variance + NormalDist().inv_cdf(share) * variance**0.5) ** 3
    few = (~np.isnan(powers)).sum(-1) < 8  # too few blocks for a quantile
    return np.sqrt(np.where(few, valid_mean(powers, -1), quantile(powers, share, -1) / expected))


def _differences(count: int, order: int) -> Array:
    """Matrix (count, count + order) of differences of neighbours."""
    return np.diff(np.eye(count + order), order, axis=0)


def _correlation_area(order: int) -> float:
    """Sum of the squared autocorrelation of differenced white noise over all lags."""
    total = math.comb(2 * order, order)
    return sum((math.comb(2 * order, order + lag) / total) ** 2 for lag in range(-order, order + 1))


# Two frames: the residual after the scene that explains both best is subtracted

_MIN_SIDE = 64  # px that two frames must share along each axis, or the whole frame if it is smaller
_MAX_MISSING = 0.1  # share of the compared pixels


@torch.no_grad()
def noise_of_frame_pair(frames: Tensor, motion: FrameMotion, ignore: Tensor | None, high_pass: Tensor) -> Tensor:
    """Noise power (B, T) of each frame, from the two middle ones of its stack that have content.

    The least-squares scene of both frames leaves a residual without texture. What texture adds to ``high_pass`` is the
    difference between that estimate and the residual, and assumed equal in all frames. NaN for stacks in which fewer
    than two frames have content, or too many of the compared pixels are missing. Frames (B, T, C, H, W) have local
    means at pixels to ``ignore``, and ``high_pass`` is NaN for frames without content.
    """
    result = torch.full_like(high_pass, math.nan)
    size = frames.shape[-2:]
    # 1. The two frames of each stack, and the part of the scene that both contain: of one size, at most 256 rows from
    # its middle, as more rows hardly lower the variance.
    usable = [np.flatnonzero(row) for row in table(~high_pass.isnan())]
    pairs = [(stack, *some[(len(some) - 1) // 2 :][:2]) for stack, some in enumerate(usable) if len(some) > 1]
    common = common_parts(motion, np.array(pairs, np.int64).reshape(-1, 3), size)
    common = take_stacks([common], common.size.min(1) >= max(min(_MIN_SIDE, *size), 8))
    if not len(common.stack):
        return result
    height, width = common.size.min(0)
    num_rows = min(height, 256)
    tops, lefts = common.firsts[..., 0] + (common.size[:, :1] - num_rows) // 2, common.firsts[..., 1]

    def shared(values: Tensor) -> Tensor:
        parts = [
            cut_parts(values, (common.stack, common.frames[:, one]), tops[:, one], lefts[:, one], (num_rows, width))
            for one in (0, 1)
        ]
        return torch.stack(parts, 1)

    # 2. Noise of both frames, relative to the high-pass estimate, which counts texture as noise.
    images, ignored = shared(frames), None if ignore is None else shared(ignore)
    measured_share = torch.ones_like(high_pass[common.stack, 0])
    if ignored is not None:
        measured_share = 1.0 - ignored.any(1).to(images.dtype).mean((1, 2, 3))
    stack, members = common.stack[:, None], common.frames
    displacement, node_weights = motion.exposures
    displacements = displacement[stack[..., None], members[..., None], tops[..., None] + np.arange(num_rows)]
    displacements = displacements - motion.shift[stack, members][:, :, None, None]
    noise = _residual_power(images, displacements, node_weights) / measured_share
    texture = (estimate_noise(images, ignored).square().mean((1, 2)) - noise).clamp(min=0.0)
    noise, known = noise[:, None], high_pass[common.stack]
    power = torch.maximum(known - texture[:, None], 0.5 * torch.minimum(known, noise))
    result[common.stack] = power.masked_fill((measured_share < 1.0 - _MAX_MISSING)[:, None], math.nan)
    return result


def _residual_power(images: Tensor, displacement: Tensor, node_weights: Tensor) -> Tensor:
    """Residual power (S,) per degree of freedom of pairs of images (S, 2, C, R, W) minus their least-squares scene.

    Only 24 horizontal frequencies of the upper half are used, where scenes are weakest. A weak smoothness prior fills
    in rows of the scene that neither frame contains. ``displacement`` (S, 2, R, N, 2) is that of the rows during their
    exposures, in the coordinates of the scene.
    """
    num_rows, width = images.shape[-2:]
    paths = displacement.flatten(0, 1)
    kernels = RowKernels.of_rows(paths, node_weights, paths.new_ones(len(paths)), num_rows, margin=4 * _MIN_SIDE)
    count = min(24, width // 4)
    cycles = np.linspace(width // 4, width // 2, count, dtype=np.float32).astype(np.int64)
    # correlation 0.9 of neighbouring rows of the scene, of weight 1e-4 beside the data
    products = torch.tensor([[1.0, 0.9**2], [-0.9, 0.0]], dtype=torch.float64, device=images.device)
    precision = 1e-4 * products[:, :, None, None].expand(-1, -1, len(images), count)
    power, freedom = unexplained(images, kernels, cycles, precision)
    return torch.as_tensor(power[0].sum(-1) / freedom[0].sum(-1), dtype=images.dtype, device=images.device)


# Choice of the estimator


@torch.no_grad()
def noise_levels(frames: Tensor, motion: FrameMotion, ignore: Tensor | None = None) -> Tensor:
    """Standard deviation (B, T) of the noise of each frame of B stacks, in its unit; 0 without any content.

    ``estimate_noise`` counts fine texture as noise, which makes it an upper bound; two frames of a stack lower it. A
    frame without content, or with too few measured pixels, has the median noise power of the others. The frames (B, T,
    C, H, W) are in row order, with local means at pixels to ``ignore``.
    """
    of_frames = valid_mean(np.square(noise_deviation(frames, ignore)), -1)
    low, high = tables(*frames[..., ::8, :].flatten(2).aminmax(dim=-1))
    of_frames[high - low <= 1e-6 * np.maximum(-low, high)] = math.nan  # equal to within rounding: not even noise
    high_pass = torch.as_tensor(of_frames, dtype=frames.dtype, device=frames.device)
    estimated = table(noise_of_frame_pair(frames, motion, ignore, high_pass))
    power = np.minimum(of_frames, without_nan(estimated, math.inf))
    power = without_nan(np.where(np.isnan(power), median(power, 1, keepdims=True), power), 0.0)
    return torch.as_tensor(np.sqrt(power), dtype=frames.dtype, device=frames.device)
