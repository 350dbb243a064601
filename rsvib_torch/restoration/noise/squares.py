"""Parts of images that estimators of noise use: squares for power spectra, and which parts count."""

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["SIDE", "cut_squares", "mostly_measured", "spread_squares", "tapered"]

SIDE = 64  # px; side of the squares whose power spectra are computed


def spread_squares(shape: Sequence[int], counts: Sequence[int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Rows (n, SIDE) and columns (m, SIDE) of n x m squares spread evenly over an image of that shape."""
    inside = torch.arange(SIDE, device=device)
    rows, columns = (
        torch.linspace(0, extent - SIDE, count, device=device, dtype=torch.float32).round().to(torch.int64)[:, None]
        + inside
        for extent, count in zip(shape, counts, strict=True)
    )
    return rows, columns


def cut_squares(images: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """The squares (..., n, m, SIDE, SIDE) of images (..., H, W)."""
    return images[..., rows[:, None, :, None], columns[None, :, None, :]]


def tapered(squares: Tensor) -> Tensor:
    """Squares minus their means, times a Hann window under which the power of white noise is its variance."""
    window = torch.hann_window(SIDE + 2, periodic=False, dtype=squares.dtype, device=squares.device)[1:-1]
    window = window / window.square().sum().sqrt()
    return (squares - squares.mean((-2, -1), keepdim=True)) * window * window[:, None]


def mostly_measured(missing: Tensor, dims: tuple[int, ...], *, max_missing: float = 0.1) -> Tensor:
    """Parts of images that count, by the share of their pixels that is missing.

    A part counts up to ``max_missing``; if all parts of an image along ``dims`` miss more, those that miss least count.
    """
    return (missing <= missing.amin(dims, keepdim=True).clamp(min=max_missing)) & (missing < 1)
