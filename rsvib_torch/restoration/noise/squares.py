"""Squares spread over images, of which spectra are made."""

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["SIDE", "cut_squares", "spread_squares", "tapered"]

SIDE = 64  # px


def spread_squares(shape: Sequence[int], counts: Sequence[int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Rows (n, SIDE) and columns (m, SIDE) of n x m squares spread evenly over an image of that shape."""
    inside = torch.arange(SIDE, device=device)
    rows, columns = (
        torch.linspace(0, extent - SIDE, count, device=device).round().to(torch.int64)[:, None] + inside
        for extent, count in zip(shape, counts, strict=True)
    )
    return rows, columns


def cut_squares(images: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """The squares (..., n, m, SIDE, SIDE) of images (..., H, W)."""
    return images[..., rows[:, None, :, None], columns[None, :, None, :]]


def tapered(squares: Tensor) -> Tensor:
    """Squares without their means, under a taper that leaves white noise its variance in every frequency."""
    taper = torch.hann_window(SIDE + 2, periodic=False, dtype=squares.dtype, device=squares.device)[1:-1]
    taper = taper / taper.square().sum().sqrt()
    return (squares - squares.mean((-2, -1), keepdim=True)) * taper * taper[:, None]
