"""Windows of rows: where the bands lie and how they are cut out, all in one batch."""

import torch
from torch import Tensor

__all__ = ["band_tops", "take_windows"]


def band_tops(num_rows: int, band_rows: int, band_step: int, device: torch.device | None = None) -> Tensor:
    """First row of every band of ``band_rows`` rows, ``band_step`` rows apart (window size and interval), (N,)."""
    return torch.arange(0, num_rows - band_rows + 1, band_step, device=device)


def take_windows(images: Tensor, tops: Tensor, lefts: Tensor, height: int, width: int) -> Tensor:
    """Cut windows out of images; rows and columns beyond the edge repeat what lies inside.

    Args:
        images: (L, H, W).
        tops: (L, N) int64, first row of each window.
        lefts: (L, N) int64, first column of each window, clamped to the image.
        height: Rows of a window.
        width: Columns of a window, at most W.

    Returns:
        (L, N, height, width).
    """
    batch, num_rows, num_columns = images.shape
    rows = (tops[..., None] + torch.arange(height, device=images.device)).clamp(0, num_rows - 1)
    lefts = lefts.clamp(0, num_columns - width)
    start = torch.arange(batch, device=images.device)[:, None, None] * num_rows + rows
    flat = images.reshape(-1).unfold(0, width, 1)  # a view: entry i is the run of `width` pixels from i on
    return flat[start * num_columns + lefts[..., None]]
