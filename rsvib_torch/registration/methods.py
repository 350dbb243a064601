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
    cut_lags,
    fine_offsets,
    integer_peak,
    subpixel_peak,
    take_windows,
    whole_pixel_peak,
)

# Zero-mean normalised cross-correlation (NCC)


def register_ncc(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands: a search for whole pixels in binned columns, then the peak at full resolution."""
    factor = next((factor for factor in (BINNING, BINNING // 2) if task.width // factor >= 64), 1)
    reach, width, height = -(-task.search // factor), task.width // factor, task.first.shape[-2]

    def binned(image: Tensor, left: Tensor, columns: int) -> Tensor:
        whole = take_windows(image, torch.zeros_like(left), left, height, columns * factor)[:, 0]
        return whole.unflatten(-1, (columns, factor)).mean(-1)

    first = binned(task.first, task.left[:, None], width)
    left = (task.left + task.coarse[:, 0])[:, None] - reach * factor
    second = binned(task.second, left, width + 2 * reach)
    places, rows = task.places, task.places[..., 1]
    of_first = torch.stack([torch.zeros_like(rows), rows], -1)
    of_second = torch.stack([torch.full_like(rows, reach), rows + task.coarse[:, None, 1]], -1)
    surface = _correlate_bands(first, second, of_first, of_second, (task.height, width), (task.search, reach))
    lag, inside = whole_pixel_peak(surface, factor)
    shift = task.start + lag
    moved = places + shift
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
    places = task.places
    num_rows = task.first.shape[-2]
    # search for whole pixels: these windows contain the band's content at every lag of the search range
    tall, factor = task.height + 2 * task.search, BINNING
    width = task.width // factor * factor
    up = torch.tensor([0, task.search], device=places.device)
    pair = [
        take_windows(image, place[..., 1], place[..., 0], tall, width).unflatten(-1, (-1, factor)).mean(-1)
        for image, place in ((task.first, places - up), (task.second, places + task.start - up))
    ]
    still = torch.zeros_like(task.start, dtype=task.first.dtype)
    surface = _phase_surface(pair[0], pair[1], still, (task.search, -(-task.search // factor) + 1), (1.0, 1.0 * factor))
    lag, valid = whole_pixel_peak(surface, factor)
    shift, fraction = task.start + lag, still
    template = take_windows(task.first, places[..., 1], places[..., 0], task.height, task.width)
    for _ in range(2):  # the window follows the content: to a whole pixel, then to a fraction
        moved = places + shift
        inside = (moved[..., 1] >= 0) & (moved[..., 1] + task.height <= num_rows)
        window = take_windows(task.second, moved[..., 1], moved[..., 0], task.height, task.width)
        surface = _phase_surface(template, window, fraction, (LAGS, LAGS), (1.0, 1.0))
        offsets, quality = fine_offsets(task, shift, surface, valid & inside)
        best = torch.where(torch.isfinite(offsets), offsets, shift.to(offsets.dtype))
        shift = best.round().long()
        fraction = (best - shift).to(task.first.dtype)
    return offsets, quality


def _hann(size: int, shift: Tensor) -> Tensor:
    """Hann windows (M, size) over ``size`` pixels, displaced by ``shift`` (M,) px."""
    places = torch.arange(1, size + 1, dtype=shift.dtype, device=shift.device) - shift[:, None]
    return torch.sin(torch.pi * places.clamp(0, size + 1) / (size + 1)).square()


def _phase_surface(
    first: Tensor, second: Tensor, fraction: Tensor, reach: tuple[int, int], pixel: tuple[float, float]
) -> Tensor:
    """Phase correlation of windows (L, N, h, w) at the lags -reach ... reach: (L, N, lags_y, lags_x).

    ``fraction`` (L, N, 2) is the shift of the Hann window of the second, ``pixel`` the size (y, x) of pixels, in px.
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
    low_pass = torch.exp(-((v[:, None] / pixel[0]).square() + (u / pixel[1]).square()) / (2 * 0.15**2))
    twice = torch.full_like(u, 2.0)  # rfft stores one half of the spectrum
    twice[0] = 1.0
    if width % 2 == 0:
        twice[-1] = 1.0
    weight = low_pass * twice / (magnitude + 10.0 * noise + torch.finfo(first.dtype).tiny)
    full = (magnitude * weight).sum((-2, -1))
    transforms = []
    for size, frequency in zip(reach, (v, u), strict=True):
        lags = torch.arange(-size, size + 1, dtype=frequency.dtype, device=first.device)
        angle = 2 * torch.pi * lags[:, None] * frequency
        transforms.append(torch.polar(torch.ones_like(angle), angle))
    surface = (transforms[0] @ ((cross * weight) @ transforms[1].T)).real
    return (surface / full.clamp(min=torch.finfo(first.dtype).tiny)[:, None, None]).unflatten(0, shape)


# Gray projection (Sec. 2.2 of Liu et al. 2023)


def register_projection(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by correlation of profiles, the means of rows and of columns.

    Across the rows, the profile of a band is too short for the search range. Windows that are eight search ranges tall
    therefore give a smooth course of the offset first. With that shift, the bands give the offset along
    the rows, and with both shifts the remaining offset across the rows.
    """
    places = task.places
    course = _smooth_course(_search_rows(task)).round().long()
    shift = task.start + torch.stack([torch.zeros_like(course), course], dim=-1)
    # peaks near the edge of the search range are interpolated from lags beyond it
    x, quality_x = _band_profiles(task, places, shift, (0, task.search + LAGS - 1))
    shift[..., 0] += torch.nan_to_num(x).round().long()
    y, quality_y = _band_profiles(task, places, shift, (2 * LAGS, 0))
    offsets = torch.stack([task.start[..., 0] + x, shift[..., 1] + y], dim=-1)
    good = torch.isfinite(offsets).all(-1) & ((offsets - task.start).abs() < task.search).all(-1)
    return torch.where(good[..., None], offsets, torch.nan), torch.where(good, torch.minimum(quality_x, quality_y), 0.0)


def _search_rows(task: BandTask) -> Tensor:
    """Offsets across the rows (L, N) beyond the coarse one, from tall windows; NaN where there is no peak."""
    num_rows = task.first.shape[-2]
    tall = min(max(task.height, 8 * task.search), num_rows // 2)
    tops = (task.tops + (task.height - tall) // 2).clamp(0, num_rows - tall)
    reach = task.search + LAGS - 1
    lefts = task.left[:, None], (task.left + task.coarse[:, 0])[:, None]
    windows = [
        take_windows(image, torch.zeros_like(left), left, num_rows, task.width)[:, 0]
        for image, left in zip((task.first, task.second), lefts, strict=True)
    ]
    row_means = [functional.pad(_differences(window.mean(-1)), (1, 1)) for window in windows]
    begin = tops + task.coarse[:, 1:] - reach
    later = take_windows(row_means[1][..., None], begin, torch.zeros_like(begin), tall + 2 * reach, 1)[..., 0]
    template = row_means[0][:, tops[:, None] + torch.arange(tall, device=begin.device)]
    surface = _correlate_profiles(template, later)
    lag_begin = begin[..., None] + torch.arange(2 * reach + 1, device=begin.device)
    return _profile_peak(torch.where((lag_begin >= 0) & (lag_begin + tall <= num_rows), surface, -torch.inf))[0]


def _smooth_course(course: Tensor) -> Tensor:
    """Course (L, N) with gaps filled from the nearest band and outliers removed by a median over 5 bands."""
    count = course.shape[-1]
    order = torch.arange(count, device=course.device)
    valid = torch.isfinite(course)
    before = torch.where(valid, order, -1).cummax(-1).values
    after = torch.where(valid, order, count).flip(-1).cummin(-1).values.flip(-1)
    nearest = torch.where((before < 0) | ((after < count) & (after - order < order - before)), after, before)
    filled = torch.nan_to_num(course.gather(-1, nearest.clamp(0, count - 1)))
    padded = functional.pad(filled[:, None], (2, 2), mode="replicate")[:, 0]
    return padded.unfold(-1, 5, 1).median(-1).values


def _band_profiles(task: BandTask, places: Tensor, shift: Tensor, reach: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Offset of bands beyond ``shift`` along the axis whose ``reach`` (rows, columns) is not 0, (L, N), and quality."""
    summed, moved, height, width = (-1 if reach[0] else -2), places + shift, task.height, task.width
    first = take_windows(task.first, places[..., 1], places[..., 0], height, width)
    top, left = moved[..., 1] - reach[0], moved[..., 0] - reach[1]
    second = take_windows(task.second, top, left, height + 2 * reach[0], width + 2 * reach[1])
    surface = _correlate_profiles(_differences(first.mean(summed)), _differences(second.mean(summed)))
    lags = torch.arange(-reach[0], reach[0] + 1, device=surface.device)
    begin = moved[..., 1, None] + lags
    inside = (begin >= 0) & (begin + task.height <= task.second.shape[-2])
    offset, quality = _profile_peak(torch.where(inside, surface, -torch.inf))
    significant = quality > 0.6  # profiles of a few dozen rows reach 0.6 by chance
    return torch.where(significant, offset, torch.nan), torch.where(significant, quality, 0.0)


def _differences(profile: Tensor) -> Tensor:
    """Central differences without the ends, which suppress slow changes of brightness."""
    return profile[..., 2:] - profile[..., :-2]


def _profile_peak(surface: Tensor) -> tuple[Tensor, Tensor]:
    """Sub-pixel lag of the peaks of correlations (L, N, 2 reach + 1), NaN where there is none, and quality.

    -infinity marks lags that leave the frame. A peak next to one, or at the edge of the search range of ``reach - LAGS
    + 1``, is none.
    """
    flat = surface.flatten(0, 1)[..., None]
    place, _ = integer_peak(flat)
    around = cut_lags(flat, place, (LAGS - 1, 0))
    whole = torch.isfinite(around).all(1)[:, 0]
    position, value = subpixel_peak(torch.where(whole[:, None, None], around, 0.0))
    lag = (place + position)[:, 0] - flat.shape[1] // 2
    search = flat.shape[1] // 2 - LAGS + 1
    good = whole & (lag.abs() < search) & torch.isfinite(lag)
    lag, value = torch.where(good, lag, torch.nan), torch.where(good, value.clamp(0.0, 1.0), 0.0)
    return lag.unflatten(0, surface.shape[:2]), value.unflatten(0, surface.shape[:2])


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
