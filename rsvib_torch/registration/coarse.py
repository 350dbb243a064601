"""The whole-frame offset to a few pixels, whatever its size: where registration of the bands starts."""

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.chunking import runs

__all__ = ["coarse_offset"]

_SIZE = 256  # px that the longer side is reduced to
_CANDIDATES = 4
_SMALLEST_OVERLAP = 0.3  # of the frame
_VALUES = 1 << 20  # of overlaps that are compared at a time


def _standardise(images: Tensor) -> Tensor:
    """Take out slow changes of brightness, which belong to the sensor or the light, not to the scene."""
    size = min(31, (min(images.shape[-2:]) - 1) // 2 * 2 + 1)
    mean = functional.pad(images[:, None], [size // 2] * 4, mode="reflect")
    for kernel in ((size, 1), (1, size)):
        mean = functional.avg_pool2d(mean, kernel, stride=1)
    detail = images - mean[:, 0]
    scale = detail.square().mean((-2, -1), keepdim=True).sqrt()
    return detail / scale.clamp(min=torch.finfo(scale.dtype).tiny)


def coarse_offset(first: Tensor, second: Tensor) -> Tensor:
    """Offset of whole frames, to about two reduced pixels (two hundredths of the longer side's 1/256).

    Both frames are reduced, their phase correlation gives candidates, and the candidate whose overlap correlates
    best is taken, so that shifts of up to 70 % of a side are told from their periodic images.

    Args:
        first: (L, H, W) earlier frames.
        second: (L, H, W) later frames.

    Returns:
        (L, 2) int64 px, axes (x, y): displacement in the second frame minus that in the first.
    """
    height, width = first.shape[-2:]
    factor = max(1, round(max(height, width) / _SIZE))
    reduced = []
    for frames in (first, second):
        crop = frames[:, : height // factor * factor, : width // factor * factor]
        reduced.append(_standardise(functional.avg_pool2d(crop[:, None], factor)[:, 0]))
    a, b = reduced
    rows, columns = a.shape[-2:]
    window = (
        torch.hann_window(rows, periodic=False, dtype=a.dtype, device=a.device)[:, None]
        * torch.hann_window(columns, periodic=False, dtype=a.dtype, device=a.device)
    ).sqrt()
    cross = torch.fft.rfft2(b * window) * torch.fft.rfft2(a * window).conj()
    magnitude = cross.abs()
    floor = magnitude.mean((-2, -1), keepdim=True).clamp(min=torch.finfo(magnitude.dtype).tiny)
    surface = torch.fft.irfft2(cross / (magnitude + 0.1 * floor), s=(rows, columns))
    # neighbours of one peak are one candidate
    blocks = functional.max_pool2d(surface[:, None], 5, stride=1, padding=2)[:, 0]
    peaks = torch.where(surface == blocks, surface, -torch.inf).flatten(1).topk(_CANDIDATES, dim=1).indices
    still = torch.zeros_like(peaks[:, :1])
    places = torch.cat([peaks, still], dim=1)
    candidates_y = torch.cat([places // columns, places // columns - rows], dim=1).repeat(1, 2)
    candidates_x = (places % columns).repeat(1, 2)
    candidates_x = torch.cat([candidates_x, candidates_x - columns], dim=1)
    at_a_time = max(1, _VALUES // a.numel())
    scores = torch.cat(
        [
            _overlap_correlation(a[:, None], b[:, None], candidates_x[:, some], candidates_y[:, some])
            for some in runs(candidates_x.shape[1], at_a_time)
        ],
        dim=1,
    )
    best = scores.argmax(1, keepdim=True)
    return factor * torch.cat([candidates_x.gather(1, best), candidates_y.gather(1, best)], dim=1)


def _overlap_correlation(a: Tensor, b: Tensor, shift_x: Tensor, shift_y: Tensor) -> Tensor:
    """Correlation of b displaced back by shifts (L, C) with a, over their overlap, (L, C); -1 where that is too small.

    Args:
        a: (L, 1, H, W).
        b: (L, 1, H, W).
        shift_x: (L, C) px.
        shift_y: (L, C) px.
    """
    rows, columns = a.shape[-2:]
    y = torch.arange(rows, device=a.device) + shift_y[..., None]
    x = torch.arange(columns, device=a.device) + shift_x[..., None]
    inside_y, inside_x = (y >= 0) & (y < rows), (x >= 0) & (x < columns)
    size = (*shift_x.shape, rows, columns)
    moved = b.expand(size).gather(2, y.clamp(0, rows - 1)[..., None].expand(size))
    moved = moved.gather(3, x.clamp(0, columns - 1)[..., None, :].expand(size))
    weight = (inside_y[..., None] & inside_x[..., None, :]).to(a.dtype)
    total = weight.sum((-2, -1)).clamp(min=1)
    centre_a = a - ((a * weight).sum((-2, -1)) / total)[..., None, None]
    centre_b = moved - ((moved * weight).sum((-2, -1)) / total)[..., None, None]
    energy = (weight * centre_a.square()).sum((-2, -1)) * (weight * centre_b.square()).sum((-2, -1))
    correlation = (weight * centre_a * centre_b).sum((-2, -1)) * energy.clamp(min=1e-30).rsqrt()
    enough = total >= _SMALLEST_OVERLAP * rows * columns
    # of two equally good overlaps the larger tells more
    return torch.where(enough, correlation * (total / (rows * columns)) ** 0.25, -torch.ones_like(correlation))
