"""What all band registration methods share: the task, windows of rows, and peaks of correlation surfaces.

Images have rows on axis -2 in readout order.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.numerics.tables import Array, table, tensor

BINNING = 4  # columns that are averaged in the search for whole pixels; a parabola recovers the single pixel
LAGS = 4  # px, reach of a fine correlation surface to either side: 9 samples fix the peak to 0.001 px (subpixel_peak)


def template_margin(search: int) -> int:
    """Columns kept free on either side of a template, so that no lag of a search range in px leaves the frame."""
    return search + LAGS + BINNING


@dataclass(frozen=True, eq=False)
class BandTask:
    """Bands of frame pairs to be registered."""

    first: Tensor  # (L, H, W) earlier frames, float32 or float64, of about zero mean
    second: Tensor  # (L, H, W) later frames
    coarse: Tensor  # (L, 2) int64 px, whole-frame offsets, axes (x, y)
    tops: Tensor  # (N,) int64, first row of each band in the earlier frame
    height: int  # rows of a band
    search: int  # search range in px around the coarse offset

    @property
    def width(self) -> int:
        """Columns of the templates: the overlap of every pair less the margins."""
        return self.first.shape[-1] - int(self.coarse[:, 0].abs().amax()) - 2 * template_margin(self.search)

    @property
    def left(self) -> Tensor:
        """First column of the templates of each pair, (L,)."""
        return (-self.coarse[:, 0]).clamp(min=0) + template_margin(self.search)

    @property
    def places(self) -> Tensor:
        """Column and row of the first pixel of each template, (L, N, 2)."""
        shape = (len(self.coarse), len(self.tops))
        return torch.stack([self.left[:, None].expand(shape), self.tops.expand(shape)], dim=-1)

    @property
    def start(self) -> Tensor:
        """Whole-pixel shifts (L, N, 2) at which the search starts: the whole-frame offset for every band."""
        return self.coarse[:, None].expand(-1, len(self.tops), -1)


def take_windows(images: Tensor, tops: Tensor, lefts: Tensor, height: int, width: int) -> Tensor:
    """Windows (L, N, height, width) of images (L, H, W) at rows and columns (L, N); beyond the edge, rows repeat."""
    batch, num_rows, num_columns = images.shape
    rows = (tops[..., None] + torch.arange(height, device=images.device)).clamp(0, num_rows - 1)
    lefts = lefts.clamp(0, num_columns - width)
    start = torch.arange(batch, device=images.device)[:, None, None] * num_rows + rows
    flat = images.reshape(-1).unfold(0, width, 1)  # a view: entry i holds pixels i to i + width - 1
    return flat[start * num_columns + lefts[..., None]]


def integer_peak(surface: Tensor) -> tuple[Tensor, Tensor]:
    """Indices (M, 2) as (row, column) of the largest entry of each surface (M, A, B), and its value (M,)."""
    value, flat = surface.flatten(-2).max(-1)
    return torch.stack([flat // surface.shape[-1], flat % surface.shape[-1]], dim=-1), value


def cut_lags(surface: Tensor, place: Tensor, reach: tuple[int, int]) -> Tensor:
    """The part of each surface (M, A, B) around ``place`` (M, 2), 2 reach + 1 lags per axis; edges repeat."""
    rows = place[:, :1] + torch.arange(-reach[0], reach[0] + 1, device=surface.device)
    columns = place[:, 1:] + torch.arange(-reach[1], reach[1] + 1, device=surface.device)
    rows, columns = rows.clamp(0, surface.shape[-2] - 1), columns.clamp(0, surface.shape[-1] - 1)
    part = surface.gather(1, rows[..., None].expand(-1, -1, surface.shape[-1]))
    return part.gather(2, columns[:, None].expand(-1, rows.shape[1], -1))


def _at_edge(place: Tensor, surface: Tensor) -> Tensor:
    """(M,) bool: whether a peak lies at the edge of its surface (M, A, B)."""
    last = torch.tensor(surface.shape[-2:], device=place.device) - 1
    return ((place == 0) | (place == last)).any(-1)


def whole_pixel_peak(surface: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """Whole-pixel lags (L, N, 2) in (x, y) of the peaks of surfaces (L, N, A, B), and whether they are inside (L, N).

    The columns count ``factor`` pixels each; a parabola through three columns gives the single pixel.
    """
    flat = surface.flatten(0, 1)
    place, value = integer_peak(flat)
    around = cut_lags(flat, place, (0, 1))[:, 0]
    bend = around[:, 2] - 2 * around[:, 1] + around[:, 0]
    fraction = torch.where(bend < 0, 0.5 * (around[:, 0] - around[:, 2]) / bend.clamp(max=-1e-12), 0.0)
    x = ((place[:, 1] - flat.shape[-1] // 2 + fraction.clamp(-0.5, 0.5)) * factor).round().long()
    y = place[:, 0] - flat.shape[-2] // 2
    inside = ~_at_edge(place, flat) & (value > 0)
    return torch.stack([x, y], -1).unflatten(0, surface.shape[:2]), inside.unflatten(0, surface.shape[:2])


def fine_offsets(task: BandTask, shift: Tensor, surface: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets (L, N, 2) and quality (L, N) of ``valid`` bands from surfaces of the lags within LAGS around shifts."""
    flat = surface.flatten(0, 1)
    place, _ = integer_peak(flat)
    # the peak comes to the centre, so that it has neighbours on every side to interpolate from
    position, value = subpixel_peak(cut_lags(flat, place, (LAGS - 1, LAGS - 1)))
    fine = (position + place - LAGS).flip(-1).unflatten(0, valid.shape)
    offsets = shift + fine
    good = valid & ~_at_edge(place, flat).unflatten(0, valid.shape) & torch.isfinite(fine).all(-1)
    good = good & ((offsets - task.start).abs() < task.search).all(-1)
    quality = torch.where(good, value.unflatten(0, valid.shape).clamp(0.0, 1.0), 0.0)
    return torch.where(good[..., None], offsets, torch.nan), quality


@cache
def _polynomials(size: int) -> Array:
    """Matrices (3, size, size) from samples around 0 to a polynomial and its first and second derivatives."""
    matrices = [np.linalg.inv(np.vander(np.arange(size) - size // 2.0, increasing=True))]
    for _ in range(2):
        matrices.append(np.roll(np.arange(size)[:, None] * matrices[-1], -1, 0))
    return np.stack(matrices)


@np.errstate(divide="ignore", invalid="ignore")
def subpixel_peak(surface: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum of the polynomial through all samples of surfaces (M, A, B), by Newton's method from the centre.

    The correlation of band-limited images is band limited, so that its samples at whole pixels determine it. For images
    smoothed by a Gaussian of 1 px, the polynomial through 9 samples per axis errs by less than 0.001 px, a three-point
    parabola by 0.05 px. A and B are odd, the integer peak is at the centre. The
    result is the position (M, 2) as (row, column) relative to the centre, NaN where no maximum lies within one pixel of
    it, and the value there (M,); float64.
    """
    samples = table(surface).astype(np.float64)
    count, rows, columns = samples.shape
    position, converging = np.zeros((count, 2)), np.ones(count, dtype=bool)
    for _ in range(5):  # Newton's method doubles the digits: 5 steps from within half a pixel reach 1e-9 px
        # 1. The value, and its derivatives by the row (down) and by the column (right) up to the second order.
        across, along = (
            (np.vander(place, size, increasing=True) @ _polynomials(size)).swapaxes(0, 1)
            for place, size in zip(position.T, (rows, columns), strict=True)
        )
        derivatives = (across @ samples @ along.mT).reshape(count, 9).T
        value, right, by_columns, down, mixed, _, by_rows = derivatives[:7]
        # 2. A step to the maximum, where there is one.
        determinant = by_rows * by_columns - np.square(mixed)
        converging = converging & (determinant > 0) & (by_rows < 0)
        move = np.stack([mixed * right - by_columns * down, mixed * down - by_rows * right], -1)
        step = np.clip(move / determinant[:, None], -0.5, 0.5)
        position = np.where(converging[:, None], position + step, position)
    converging = converging & (np.abs(position) <= 1.0).all(-1)
    position[~converging] = np.nan
    peaks = tensor(np.column_stack([position, value])).to(surface.device)
    return peaks[:, :2], peaks[:, 2]
