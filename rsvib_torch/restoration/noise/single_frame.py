"""Noise level and scene prior estimated from the frames themselves."""

import math

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs

__all__ = ["estimate_noise", "gradient_energy", "mostly_measured"]

_BLOCK = 16
_DIFFERENCES = 8
_QUANTILE = 0.15
_LOST = 0.1  # of the pixels of a block, at most, unless all others lost more
_FEW = 8  # blocks have no quiet part
_MANY = 2048  # blocks tell as much as all of a larger image
_VALUES = {"cpu": 1 << 16}  # at a time: they stay in the cache


def estimate_noise(frames: Tensor, ignore: Tensor | None = None) -> Tensor:
    """Standard deviation of white noise in each image.

    The outer product of two eighth differences leaves the corner of the spectrum, where optics pass least; of its
    energy in blocks of 16 x 16 px only the quietest part is taken, where there is no texture. A scene that has texture
    up to the corner everywhere counts as noise. Of large images, strips spread over all rows are asked.

    Args:
        frames: (..., H, W).
        ignore: Boolean mask of the same shape of pixels that hold no noise of their own: blocks with many of them do
            not count.

    Returns:
        Standard deviation, shape (...); NaN for an image none of whose blocks counts.

    Example:
        >>> import torch
        >>> noise = torch.randn(200, 300, generator=torch.Generator().manual_seed(0))
        >>> round(estimate_noise(0.1 * noise).item(), 2)
        0.1
    """
    shape = (frames.shape[-2], frames.shape[-1])
    orders = [min(_DIFFERENCES, (extent - 1) // 2 + 1, extent - 1) for extent in shape]
    inner = [extent - order for extent, order in zip(shape, orders, strict=True)]
    block = min(_BLOCK, *inner)
    height, width = (extent // block * block for extent in inner)
    every = max(1, height * width // (block**2 * _MANY))
    windows = [block + order for order in orders]

    def strips_of(images: Tensor) -> Tensor:
        inside = images[..., : height + orders[0], : width + orders[1]]
        return inside.unfold(-2, windows[0], every * block).movedim(-3, 0)  # (strips, ..., columns, rows)

    strips = strips_of(frames)
    across = torch.eye(windows[0], dtype=frames.dtype, device=frames.device).diff(orders[0], dim=0)
    one = frames[..., 0, :].numel() * block
    blocks = [
        _detail(strips[some], across, orders[1]).square().unflatten(-2, (-1, block)).mean((-2, -1))
        for some in runs(len(strips), max(1, _VALUES.get(frames.device.type, frames.numel()) // one))
    ]
    energy = torch.cat(blocks) / math.prod(math.comb(2 * order, order) for order in orders)
    if ignore is not None:
        lost = strips_of(ignore.to(frames.dtype)).mean(-1).unfold(-1, windows[1], block).mean(-1)
        energy = energy.masked_fill(~mostly_measured(lost, (0, -1)), math.nan)
    energy = energy.movedim(0, -1).flatten(-2)
    # means of pure noise scatter (neighbouring responses of the mask are correlated), so that their low quantile lies
    # below the true mean: by as much as a chi-squared variable's does (Wilson and Hilferty)
    share = min(2.0 * math.prod(_correlation_area(order) for order in orders) / (9.0 * block**2), 0.2)
    expected = (1.0 - share - 1.0364 * share**0.5) ** 3
    quiet = (energy.quantile if ignore is None else energy.nanquantile)(_QUANTILE, dim=-1) / expected
    few = (~energy.isnan()).sum(-1) < _FEW
    deviation: Tensor = torch.where(few, energy.nanmean(-1), quiet).sqrt()
    return deviation


def mostly_measured(lost: Tensor, dims: tuple[int, ...]) -> Tensor:
    """Which parts of images count, of whose pixels a share was ``lost``: those that lost few, or least of all."""
    return (lost <= lost.amin(dims, keepdim=True).clamp(min=_LOST)) & (lost < 1)


def _detail(strips: Tensor, across: Tensor, order: int) -> Tensor:
    """Differences of an order along rows, and of another, as a matrix, across rows, of strips (..., columns, rows)."""
    differences = strips @ across.T
    for _ in range(order):
        differences = differences.diff(dim=-2)
    return differences


def _correlation_area(order: int) -> float:
    """Sum of the squared correlations of white noise that was differenced."""
    total = math.comb(2 * order, order)
    return sum((math.comb(2 * order, order + lag) / total) ** 2 for lag in range(-order, order + 1))


def gradient_energy(frames: Tensor) -> Tensor:
    """Mean square difference of neighbouring pixels, per axis and image, shape (...).

    Args:
        frames: (..., H, W).
    """
    across, along = (frames.diff(dim=dim).square() for dim in (-2, -1))
    across, along = (values.sum((-2, -1)) / max(math.prod(values.shape[-2:]), 1) for values in (across, along))
    return 0.5 * (across + along)
