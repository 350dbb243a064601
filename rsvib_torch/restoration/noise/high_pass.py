"""Noise of single images from the quietest blocks of a high-pass residual."""

import math
from statistics import NormalDist

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.restoration.noise.squares import mostly_measured

__all__ = ["estimate_noise"]

_ELEMENTS = {"cpu": 1 << 16}  # values filtered at a time; they fit into the cache (speed only)


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
    shape = (frames.shape[-2], frames.shape[-1])
    orders = [min(8, (extent - 1) // 2 + 1, extent - 1) for extent in shape]
    inner = [extent - difference for extent, difference in zip(shape, orders, strict=True)]
    block = min(16, *inner)
    height, width = (extent // block * block for extent in inner)
    stride = max(1, height * width // (block**2 * 2048))  # 2048 blocks determine the quantile well enough
    windows = [block + difference for difference in orders]

    def strips_of(images: Tensor) -> Tensor:
        inside = images[..., : height + orders[0], : width + orders[1]]
        return inside.unfold(-2, windows[0], stride * block).movedim(-3, 0)  # (strips, ..., columns, rows)

    strips = strips_of(frames)
    across = torch.eye(windows[0], dtype=frames.dtype, device=frames.device).diff(orders[0], dim=0)

    def residual(part: Tensor) -> Tensor:
        differences = part @ across.T
        for _ in range(orders[1]):
            differences = differences.diff(dim=-2)
        return differences

    strip_size = frames[..., 0, :].numel() * block
    blocks = [
        residual(strips[part]).square().unflatten(-2, (-1, block)).mean((-2, -1))
        for part in runs(len(strips), max(1, _ELEMENTS.get(frames.device.type, frames.numel()) // strip_size))
    ]
    energy = torch.cat(blocks) / math.prod(math.comb(2 * difference, difference) for difference in orders)
    if ignore is not None:
        missing = strips_of(ignore.to(frames.dtype)).mean(-1).unfold(-1, windows[1], block).mean(-1)
        energy = energy.masked_fill(~mostly_measured(missing, (0, -1)), math.nan)
    energy = energy.movedim(0, -1).flatten(-2)
    # Means of squares of pure noise scatter, so that their low quantile lies below the true mean, by as much as that of
    # a chi-squared variable (Wilson and Hilferty 1931).
    quantile = 0.15
    variance = min(2.0 * math.prod(_correlation_area(difference) for difference in orders) / (9.0 * block**2), 0.2)
    expected = (1.0 - variance + NormalDist().inv_cdf(quantile) * variance**0.5) ** 3
    quiet = (energy.quantile if ignore is None else energy.nanquantile)(quantile, dim=-1) / expected
    few = (~energy.isnan()).sum(-1) < 8  # too few blocks for a quantile
    deviation: Tensor = torch.where(few, energy.nanmean(-1), quiet).sqrt()
    return deviation


def _correlation_area(order: int) -> float:
    """Sum of the squared autocorrelation of differenced white noise over all lags."""
    total = math.comb(2 * order, order)
    return sum((math.comb(2 * order, order + lag) / total) ** 2 for lag in range(-order, order + 1))
