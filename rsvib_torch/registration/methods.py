"""Band registration: the task, windows of rows, peaks of correlation surfaces, and the methods.

The methods are cross-correlation, phase correlation and gray projection. Images have rows on axis -2 in readout order.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.execution.parallel import chunks, in_parallel
from rsvib_torch.numerics.interpolation import fast_length
from rsvib_torch.numerics.tables import Array, table, tensor

LAGS = 4  # px, reach of a fine correlation surface to either side: 9 samples fix the peak to 0.001 px (subpixel_peak)


def template_margin(search: int) -> int:
    """Columns kept free on either side of a template: no lag of a search range in px leaves the frame."""
    return search + 2 * LAGS


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


def fine_offsets(task: BandTask, shift: Tensor, surface: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets (L, N, 2) and quality (L, N) of ``valid`` bands from surfaces of lags around whole-pixel shifts."""
    flat = surface.flatten(0, 1)
    place, _ = integer_peak(flat)
    # the peak comes to the centre, so that it has neighbours on every side to interpolate from
    position, value = subpixel_peak(cut_lags(flat, place, (LAGS - 1, LAGS - 1)))
    fine = (position + place - surface.shape[-1] // 2).flip(-1).unflatten(0, valid.shape)
    offsets = shift + fine
    measured = valid & ~_at_edge(place, flat).unflatten(0, valid.shape) & torch.isfinite(fine).all(-1)
    measured = measured & ((offsets - task.start).abs() < task.search).all(-1)
    quality = torch.where(measured, value.unflatten(0, valid.shape).clamp(0.0, 1.0), 0.0)
    return torch.where(measured[..., None], offsets, torch.nan), quality


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
        value, by_column, by_column2, by_row, mixed, _, by_row2 = derivatives[:7]
        # 2. A step to the maximum, where there is one.
        determinant = by_row2 * by_column2 - np.square(mixed)
        converging = converging & (determinant > 0) & (by_row2 < 0)
        move = np.stack([mixed * by_column - by_column2 * by_row, mixed * by_row - by_row2 * by_column], -1)
        position = np.where(converging[:, None], position + np.clip(move / determinant[:, None], -0.5, 0.5), position)
    converging = converging & (np.abs(position) <= 1.0).all(-1)
    position[~converging] = np.nan
    peaks = tensor(np.column_stack([position, value])).to(surface.device)
    return peaks[:, :2], peaks[:, 2]


def _search(task: BandTask) -> tuple[Tensor, Tensor, Tensor]:
    """Cross-correlation of bands over the search range (L, N, A, B), and the whole pixels of its peaks.

    All methods begin with it: the profiles of a band are too short for the search range across the rows. The shifts (L,
    N, 2) include the whole-frame offset, and (L, N) bool states which peaks are inside the range.
    """
    places, reach = task.places, task.search
    surface = _correlate_bands(
        task.first, task.second, places, places + task.start, (task.height, task.width), (reach, reach)
    )
    flat, shape = surface.flatten(0, 1), surface.shape[:2]
    place, value = integer_peak(flat)
    inside = (~_at_edge(place, flat) & (value > 0)).unflatten(0, shape)
    return surface, task.start + (place.flip(-1) - reach).unflatten(0, shape), inside


# Zero-mean normalised cross-correlation (NCC)


def register_ncc(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by the peak of their cross-correlation."""
    surface, shift, inside = _search(task)
    return fine_offsets(task, task.start, surface, inside & _inside(task, shift))


def _inside(task: BandTask, shift: Tensor) -> Tensor:
    """(L, N) bool: whether the later frame contains all lags around whole-pixel shifts (L, N, 2)."""
    top = task.tops + shift[..., 1]
    return (top >= LAGS) & (top + task.height + LAGS <= task.first.shape[-2])


def _correlate_bands(
    first: Tensor, second: Tensor, places: Tensor, later_places: Tensor, size: tuple[int, int], reach: tuple[int, int]
) -> Tensor:
    """Zero-mean normalised cross-correlation of windows of one image (L, H, W) with windows of another (L, H, V).

    Products come from Fourier transforms, means and energies of the search windows from running sums. Templates of
    ``size`` (rows, columns) begin at ``places`` (L, N, 2) int64 (column, row), the window at lag zero at
    ``later_places``. Lags are -reach ... reach across the rows and along the columns. The result (L, N, 2 reach[0] + 1,
    2 reach[1] + 1) is in -1 ... 1; 0 where a window is constant or leaves the image.
    """
    height, width = size
    pixels = height * width
    search_size = height + 2 * reach[0], width + 2 * reach[1]
    lengths = fast_length(search_size[0]), fast_length(search_size[1])

    def products(bands: slice) -> tuple[Tensor, Tensor, Tensor]:
        """Sums of the products of templates and windows, of the templates, and of their squares."""
        begin, later_begin = places[:, bands], later_places[:, bands] - torch.tensor(reach[::-1], device=places.device)
        template = take_windows(first, begin[..., 1], begin[..., 0], height, width)
        search = take_windows(second, later_begin[..., 1], later_begin[..., 0], *search_size)
        spectrum = torch.fft.rfft2(search, s=lengths) * torch.fft.rfft2(template, s=lengths).conj()
        cross = torch.fft.irfft2(spectrum, s=lengths)[..., : 2 * reach[0] + 1, : 2 * reach[1] + 1]
        flat = template.flatten(2)
        sums = flat.sum(-1).double(), torch.linalg.vecdot(flat, flat).double()
        return cross, sums[0][..., None, None], sums[1][..., None, None]

    bytes_of_band = 4 * len(first) * lengths[0] * lengths[1] * first.element_size()
    parts = in_parallel(products, chunks(places.shape[1], bytes_of_band, first.device), first.device)
    cross, template_total, template_energy = (torch.cat(values, 1) for values in zip(*parts, strict=True))
    total, energy = _window_sums(second, later_places, size, reach)
    cross = cross - template_total * total / pixels
    energy = energy - total.square() / pixels
    template_energy = template_energy - template_total.square() / pixels
    return _normalise(cross, energy, template_energy, pixels * second.square().mean((-2, -1))[:, None, None, None])


def _normalise(cross: Tensor, energy: Tensor, template_energy: Tensor, typical: Tensor) -> Tensor:
    """Correlation coefficient; 0 where an energy is NaN or below 1e-7 of the typical one (rounding of float32)."""
    floor = 1e-7 * typical
    textured = (energy > floor) & (template_energy > floor)
    scale = torch.where(textured, energy * template_energy, 1.0).rsqrt()
    return torch.where(textured, cross * scale, 0.0).clamp(-1.0, 1.0)


def _window_sums(
    images: Tensor, places: Tensor, size: tuple[int, int], reach: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Sums of values and squares over windows at all lags, float64 (L, N, lags_y, lags_x); NaN beyond the image."""
    height, width = size
    num_rows, num_columns = images.shape[-2:]
    device = images.device
    columns = places[..., 0, None] + torch.arange(-reach[1], reach[1] + 1, device=device)
    rows = places[..., 1, None] + torch.arange(-reach[0], reach[0] + 1, device=device)
    inside = ((rows >= 0) & (rows + height <= num_rows))[..., :, None] & (
        (columns >= 0) & (columns + width <= num_columns)
    )[..., None, :]
    rows, columns = rows.clamp(0, num_rows - height), columns.clamp(0, num_columns - width)
    low = int(columns.amin())
    extra = int(columns.amax()) - low
    columns = columns - low
    inner, left, right = (
        images[..., begin : begin + count] for begin, count in ((low, width), (low, extra), (low + width, extra))
    )
    first = torch.stack([inner.sum(-1), torch.linalg.vecdot(inner, inner)], 1).double()[..., None]
    change = torch.stack([right - left, right.square() - left.square()], 1)
    runs = torch.cat([first, first + change.cumsum(-1, dtype=torch.float64)], -1)  # (L, 2, H, extra + 1)
    sums_table = functional.pad(runs.cumsum(2), (0, 0, 1, 0)).flatten(2)
    step = extra + 1
    index = (rows * step)[..., :, None] + columns[..., None, :]  # (L, N, lags_y, lags_x)
    flat = index.flatten(1)[:, None].expand(-1, 2, -1)
    sums = (sums_table.gather(2, flat + height * step) - sums_table.gather(2, flat)).unflatten(2, index.shape[1:])
    total, energy = torch.where(inside[:, None], sums, torch.nan).unbind(1)
    return total, energy


# Phase correlation


def register_phase(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by phase correlation under a Hann window that moves with the scene.

    The cross-power spectrum is whitened where it exceeds the noise, and low-passed, so that samples at whole pixels
    determine its peak.
    """
    places, num_rows = task.places, task.first.shape[-2]
    _, shift, valid = _search(task)
    fraction = torch.zeros_like(shift, dtype=task.first.dtype)
    template = take_windows(task.first, places[..., 1], places[..., 0], task.height, task.width)
    for _ in range(2):  # the window follows the content: to a whole pixel, then to a fraction
        later_places = places + shift
        inside = (later_places[..., 1] >= 0) & (later_places[..., 1] + task.height <= num_rows)
        window = take_windows(task.second, later_places[..., 1], later_places[..., 0], task.height, task.width)
        surface = _phase_surface(template, window, fraction)
        offsets, quality = fine_offsets(task, shift, surface, valid & inside)
        best = torch.where(torch.isfinite(offsets), offsets, shift.to(offsets.dtype))
        shift = best.round().long()
        fraction = (best - shift).to(task.first.dtype)
    return offsets, quality


def _hann(size: int, shift: Tensor) -> Tensor:
    """Hann windows (M, size) over ``size`` pixels, displaced by ``shift`` (M,) px."""
    places = torch.arange(1, size + 1, dtype=shift.dtype, device=shift.device) - shift[:, None]
    return torch.sin(torch.pi * places.clamp(0, size + 1) / (size + 1)).square()


def _phase_surface(first: Tensor, second: Tensor, fraction: Tensor) -> Tensor:
    """Phase correlation of windows (L, N, h, w) at the lags -LAGS ... LAGS: (L, N, lags_y, lags_x).

    ``fraction`` (L, N, 2) is the shift of the Hann window of the second in px.
    """
    shape = first.shape[:2]
    first, second, fraction = first.flatten(0, 1), second.flatten(0, 1), fraction.flatten(0, 1)
    height, width = first.shape[-2:]
    spectra = []
    for image, shift in ((first, torch.zeros_like(fraction)), (second, fraction)):
        window = _hann(height, shift[:, 1])[:, :, None] * _hann(width, shift[:, 0])[:, None]
        level = (image * window).sum((-2, -1), keepdim=True) / window.sum((-2, -1), keepdim=True)
        spectra.append(torch.fft.rfft2((image - level) * window))
    cross = spectra[1] * spectra[0].conj()
    magnitude = cross.abs()
    v = torch.fft.fftfreq(height, dtype=first.dtype, device=first.device)
    u = torch.fft.rfftfreq(width, dtype=first.dtype, device=first.device)
    high = (u > 0.4)[None] & (v.abs() > 0.25)[:, None]  # cycles/px: noise only, after the Gaussian of 1 px
    noise = (magnitude * high).sum((-2, -1), keepdim=True) / high.sum()
    low_pass = torch.exp(-(v[:, None].square() + u.square()) / (2 * 0.15**2))
    weight = low_pass / (magnitude + 10.0 * noise + torch.finfo(first.dtype).tiny)
    surface, aligned = (torch.fft.irfft2(values * weight, s=(height, width)) for values in (cross, magnitude))
    lags = torch.arange(-LAGS, LAGS + 1, device=first.device)
    largest = aligned[:, :1, :1].clamp(min=torch.finfo(first.dtype).tiny)
    return (surface[:, lags[:, None], lags] / largest).unflatten(0, shape)


# Gray projection (Sec. 2.2 of Liu et al. 2023)


def register_projection(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by correlation of profiles, the means of rows and of columns.

    The sum of the correlations along both axes has its peak where both correlations have theirs.
    """
    _, shift, valid = _search(task)
    down, along = (_profile_correlation(task, shift, reach) for reach in ((LAGS, 0), (0, LAGS)))
    # profiles of a few dozen rows reach 0.6 by chance
    valid &= _inside(task, shift) & (torch.minimum(down.amax(-1), along.amax(-1)) > 0.6)
    return fine_offsets(task, shift, 0.5 * (down[..., :, None] + along[..., None, :]), valid)


def _profile_correlation(task: BandTask, shift: Tensor, reach: tuple[int, int]) -> Tensor:
    """Correlation (L, N, 2 LAGS + 1) of profiles at lags around ``shift`` along the axis whose ``reach`` is not 0."""
    summed, places, height, width = (-1 if reach[0] else -2), task.places, task.height, task.width
    left, top = (places + shift).unbind(-1)
    first = take_windows(task.first, places[..., 1], places[..., 0], height, width)
    second = take_windows(task.second, top - reach[0], left - reach[1], height + 2 * reach[0], width + 2 * reach[1])
    return _correlate_profiles(_differences(first.mean(summed)), _differences(second.mean(summed)))


def _differences(profile: Tensor) -> Tensor:
    """Central differences without the ends, which suppress slow changes of brightness."""
    return profile[..., 2:] - profile[..., :-2]


def _correlate_profiles(template: Tensor, search: Tensor) -> Tensor:
    """Zero-mean normalised cross-correlation (..., b + 1) of (..., w) with (..., w + b); 0 where one is constant."""
    template = template.to(torch.float64)
    template = template - template.mean(-1, keepdim=True)
    windows = search.to(torch.float64).unfold(-1, template.shape[-1], 1)
    cross = (windows @ template[..., None])[..., 0]
    energy = windows.square().sum(-1) - windows.sum(-1).square() / template.shape[-1]
    typical = search.square().mean(-1, keepdim=True) * template.shape[-1]
    return _normalise(cross, energy, template.square().sum(-1, keepdim=True), typical)


# Table


# Contract of a band registration method. To add one, write ``register_<name>``, here or in a file of its own, add it to
# this table, and its name to ``Registration`` in options.py, from which configuration files take the names.
#
#   register(task: BandTask) -> (offsets, quality)
#
# task.first, task.second  (L, H, W) grey images of L frame pairs in row order, smoothed by a Gaussian of 1 px, without
#                          the slow course of the row means. Band n consists of the rows task.tops[n] to
#                          task.tops[n] + task.height - 1 of ``first``.
# offsets                  (L, N, 2) px, axes (x, y): position of the band's content in ``second`` less that in
#                          ``first``, the whole-frame offset ``task.coarse`` included; within ``task.search`` px of it.
# quality                  (L, N) in 0 ... 1: correlation of the matched bands. Detection weights a band by about
#                          1 / (1 - quality); ``register.py`` discards bands of quality 0.1 or less.
# A band without detail, or whose match lies at the edge of the search range or outside the frame, has offset NaN and
# quality 0; a method does not raise for it. Pairs share only the width of the templates (``BandTask.width``).
BAND_METHODS: dict[str, Callable[[BandTask], tuple[Tensor, Tensor]]] = {
    "projection": register_projection,
    "ncc": register_ncc,
    "phase": register_phase,
}
