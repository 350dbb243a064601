"""The methods of band registration: cross-correlation, phase correlation and gray projection."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.execution.chunking import chunks
from rsvib_torch.execution.parallel import in_parallel
from rsvib_torch.numerics.fourier import fast_length
from rsvib_torch.registration.bands import (
    BINNING,
    LAGS,
    BandTask,
    fine_offsets,
    take_windows,
    whole_pixel_peak,
)


def _whole_pixels(task: BandTask) -> tuple[Tensor, Tensor]:
    """Whole-pixel shifts (L, N, 2) of bands by cross-correlation of binned columns, and whether they are known (L, N).

    All methods begin with it: the profiles of a band are too short for the search range across the rows.
    """
    factor = next((factor for factor in (BINNING, BINNING // 2) if task.width // factor >= 64), 1)
    reach, width, height = -(-task.search // factor), task.width // factor, task.first.shape[-2]

    def binned(image: Tensor, left: Tensor, columns: int) -> Tensor:
        whole = take_windows(image, torch.zeros_like(left), left, height, columns * factor)[:, 0]
        return whole.unflatten(-1, (columns, factor)).mean(-1)

    first = binned(task.first, task.left[:, None], width)
    left = (task.left + task.coarse[:, 0])[:, None] - reach * factor
    second = binned(task.second, left, width + 2 * reach)
    rows = task.places[..., 1]
    of_first = torch.stack([torch.zeros_like(rows), rows], -1)
    of_second = torch.stack([torch.full_like(rows, reach), rows + task.coarse[:, None, 1]], -1)
    surface = _correlate_bands(first, second, of_first, of_second, (task.height, width), (task.search, reach))
    lag, inside = whole_pixel_peak(surface, factor)
    return task.start + lag, inside


# Zero-mean normalised cross-correlation (NCC)


def register_ncc(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by the peak of their cross-correlation."""
    shift, inside = _whole_pixels(task)
    places, moved = task.places, task.places + shift
    surface = _correlate_bands(task.first, task.second, places, moved, (task.height, task.width), (LAGS, LAGS))
    inside &= (moved[..., 1] >= LAGS) & (moved[..., 1] + task.height + LAGS <= task.first.shape[-2])
    return fine_offsets(task, shift, surface, inside)


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
    table = functional.pad(runs.cumsum(2), (0, 0, 1, 0)).flatten(2)
    step = extra + 1
    index = (rows * step)[..., :, None] + columns[..., None, :]  # (L, N, lags_y, lags_x)
    flat = index.flatten(1)[:, None].expand(-1, 2, -1)
    sums = (table.gather(2, flat + height * step) - table.gather(2, flat)).unflatten(2, index.shape[1:])
    total, energy = torch.where(inside[:, None], sums, torch.nan).unbind(1)
    return total, energy


# Phase correlation


def register_phase(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by phase correlation under a Hann window that moves with the scene.

    The cross-power spectrum is whitened where it exceeds the noise, and low-passed, so that samples at whole pixels
    determine its peak.
    """
    places, num_rows = task.places, task.first.shape[-2]
    shift, valid = _whole_pixels(task)
    fraction = torch.zeros_like(shift, dtype=task.first.dtype)
    template = take_windows(task.first, places[..., 1], places[..., 0], task.height, task.width)
    for _ in range(2):  # the window follows the content: to a whole pixel, then to a fraction
        moved = places + shift
        inside = (moved[..., 1] >= 0) & (moved[..., 1] + task.height <= num_rows)
        window = take_windows(task.second, moved[..., 1], moved[..., 0], task.height, task.width)
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
    twice = torch.full_like(u, 2.0)  # rfft stores one half of the spectrum
    twice[0] = 1.0
    if width % 2 == 0:
        twice[-1] = 1.0
    weight = low_pass * twice / (magnitude + 10.0 * noise + torch.finfo(first.dtype).tiny)
    full = (magnitude * weight).sum((-2, -1))
    lags = torch.arange(-LAGS, LAGS + 1, dtype=first.dtype, device=first.device)
    transforms = [torch.exp(2j * torch.pi * lags[:, None] * frequency) for frequency in (v, u)]
    surface = (transforms[0] @ ((cross * weight) @ transforms[1].T)).real
    return (surface / full.clamp(min=torch.finfo(first.dtype).tiny)[:, None, None]).unflatten(0, shape)


# Gray projection (Sec. 2.2 of Liu et al. 2023)


def register_projection(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by correlation of profiles, the means of rows and of columns.

    The sum of the correlations along both axes has its peak where each of them has its own.
    """
    shift, valid = _whole_pixels(task)
    down, along = (_profile_correlation(task, shift, reach) for reach in ((LAGS, 0), (0, LAGS)))
    top = task.places[..., 1] + shift[..., 1]
    valid &= (top >= LAGS) & (top + task.height + LAGS <= task.first.shape[-2])
    valid &= torch.minimum(down.amax(-1), along.amax(-1)) > 0.6  # profiles of a few dozen rows reach 0.6 by chance
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
