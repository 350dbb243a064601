"""Three ways to find the offset of a band: gray projection, NCC and phase correlation."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.checks import check_choice, check_whole_number
from rsvib_torch.registration.band_windows import take_windows
from rsvib_torch.registration.correlation import correlate_bands, correlate_profiles
from rsvib_torch.registration.peak import integer_peak, subpixel_peak

__all__ = ["BAND_METHODS", "BandTask", "Registration", "RegistrationOptions"]

Registration = Literal["projection", "ncc", "phase"]

_BINNING = 4  # columns averaged for the search for whole pixels
_LAGS = 4  # px either side of the whole-pixel peak for the sub-pixel peak
_TALL = 8  # search ranges that a gray projection along the rows' axis is tall
_LEAST_PROFILE_QUALITY = 0.6  # profiles of a few dozen rows correlate up to this by chance
_PHASE_PASSES = 2  # the window moves with the scene, to a fraction of a pixel in the last pass


@dataclass(frozen=True, eq=False)
class BandTask:
    """Bands of frame pairs to be registered.

    Attributes:
        first: (L, H, W) earlier frames.
        second: (L, H, W) later frames.
        coarse: (L, 2) int64, whole-frame offsets (x, y).
        tops: (N,) int64, first row of each band.
        height: Rows of a band.
        search: Search range in px around the coarse offset.
    """

    first: Tensor
    second: Tensor
    coarse: Tensor
    tops: Tensor
    height: int
    search: int

    @property
    def margin(self) -> int:
        """Columns kept free on either side of a template, so that no lag leaves the frame."""
        return self.search + _LAGS + _BINNING

    @property
    def width(self) -> int:
        """Columns of the templates: what overlaps in every pair, less the search range."""
        return self.first.shape[-1] - int(self.coarse[:, 0].abs().amax()) - 2 * self.margin

    @property
    def left(self) -> Tensor:
        """First column of the templates of each pair, (L,)."""
        return (-self.coarse[:, 0]).clamp(min=0) + self.margin

    def places(self, tops: Tensor | None = None) -> Tensor:
        """Column and row of the first pixel of each template, (L, N, 2)."""
        tops = self.tops if tops is None else tops
        shape = (len(self.coarse), len(tops))
        return torch.stack([self.left[:, None].expand(shape), tops.expand(shape)], dim=-1)

    @property
    def start(self) -> Tensor:
        """Whole-pixel shifts (L, N, 2) to begin with: the whole-frame offset for every band."""
        return self.coarse[:, None].expand(-1, len(self.tops), -1)


def _at_edge(place: Tensor, surface: Tensor) -> Tensor:
    """(M,) bool: whether a peak lies at the edge of its search range (axes of one lag have no edge)."""
    edge = torch.zeros_like(place[:, 0], dtype=torch.bool)
    for axis in (0, 1):
        size = surface.shape[axis - 2]
        if size > 1:
            edge |= (place[:, axis] == 0) | (place[:, axis] == size - 1)
    return edge


def _cut_lags(surface: Tensor, place: Tensor, reach: tuple[int, int]) -> Tensor:
    """The part of each surface (M, A, B) around ``place`` (M, 2), 2 reach + 1 lags an axis; edges repeat."""
    rows = place[:, :1] + torch.arange(-reach[0], reach[0] + 1, device=surface.device)
    columns = place[:, 1:] + torch.arange(-reach[1], reach[1] + 1, device=surface.device)
    rows, columns = rows.clamp(0, surface.shape[-2] - 1), columns.clamp(0, surface.shape[-1] - 1)
    part = surface.gather(1, rows[..., None].expand(-1, -1, surface.shape[-1]))
    return part.gather(2, columns[:, None].expand(-1, rows.shape[1], -1))


def _search_peak(surface: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """Whole-pixel lags (L, N, 2) of the peaks of surfaces (L, N, A, B), and whether they are inside (L, N).

    Columns were binned by ``factor``: a parabola through three of them tells the whole pixel.
    """
    flat = surface.flatten(0, 1)
    place, value = integer_peak(flat)
    around = _cut_lags(flat, place, (0, 1))[:, 0]
    bend = around[:, 2] - 2 * around[:, 1] + around[:, 0]
    fraction = torch.where(bend < 0, 0.5 * (around[:, 0] - around[:, 2]) / bend.clamp(max=-1e-12), 0.0)
    x = ((place[:, 1] - flat.shape[-1] // 2 + fraction.clamp(-0.5, 0.5)) * factor).round().long()
    y = place[:, 0] - flat.shape[-2] // 2
    found = ~_at_edge(place, flat) & (value > 0)
    return torch.stack([x, y], -1).unflatten(0, surface.shape[:2]), found.unflatten(0, surface.shape[:2])


def _finish(task: BandTask, shift: Tensor, surface: Tensor, found: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets (L, N, 2) and quality (L, N) from whole-pixel shifts and the correlation at the lags around them."""
    flat = surface.flatten(0, 1)
    place, _ = integer_peak(flat)
    # the peak comes to the centre, so that it has neighbours on every side to interpolate from
    position, value = subpixel_peak(_cut_lags(flat, place, (_LAGS - 1, _LAGS - 1)))
    fine = (position + place - _LAGS).flip(-1).unflatten(0, found.shape)
    offsets = shift + fine
    ok = found & ~_at_edge(place, flat).unflatten(0, found.shape) & torch.isfinite(fine).all(-1)
    ok = ok & ((offsets - task.coarse[:, None]).abs() < task.search).all(-1)
    quality = torch.where(ok, value.unflatten(0, found.shape).clamp(0.0, 1.0), 0.0)
    return torch.where(ok[..., None], offsets, torch.nan), quality


def register_ncc(task: BandTask) -> tuple[Tensor, Tensor]:
    """Zero-mean normalised cross-correlation: a search for whole pixels, then its peak at full resolution."""
    width = task.width // _BINNING
    factor = _BINNING if width >= 64 else 1
    reach = -(-task.search // factor)
    width = task.width // factor
    binned = [
        take_windows(image, torch.zeros_like(left), left, image.shape[-2], columns * factor)[:, 0]
        .unflatten(-1, (columns, factor))
        .mean(-1)
        for image, left, columns in (
            (task.first, task.left[:, None], width),
            (task.second, (task.left + task.coarse[:, 0])[:, None] - reach * factor, width + 2 * reach),
        )
    ]
    places = task.places()
    rows = places[..., 1]
    surface = correlate_bands(
        binned[0],
        binned[1],
        torch.stack([torch.zeros_like(rows), rows], -1),
        torch.stack([torch.full_like(rows, reach), rows + task.coarse[:, None, 1]], -1),
        size=(task.height, width),
        reach=(task.search, reach),
    )
    lag, found = _search_peak(surface, factor)
    shift = task.start + lag
    moved = places + shift
    surface = correlate_bands(
        task.first, task.second, places, moved, size=(task.height, task.width), reach=(_LAGS, _LAGS)
    )
    inside = (moved[..., 1] >= _LAGS) & (moved[..., 1] + task.height + _LAGS <= task.first.shape[-2])
    return _finish(task, shift, surface, found & inside)


def register_phase(task: BandTask) -> tuple[Tensor, Tensor]:
    """Phase correlation under a Hann window that moves with the scene.

    The cross-power spectrum is whitened where it stands above the noise, and low-passed, so that its peak is a smooth
    bump whose samples at whole pixels determine it.
    """
    places = task.places()
    num_rows = task.first.shape[-2]
    # whole pixels: windows tall enough to keep the band in sight at the end of the search range
    tall = task.height + 2 * task.search
    factor = _BINNING
    width = task.width // factor * factor
    up = torch.tensor([0, task.search], device=places.device)
    pair = [
        take_windows(image, place[..., 1], place[..., 0], tall, width).unflatten(-1, (-1, factor)).mean(-1)
        for image, place in ((task.first, places - up), (task.second, places + task.start - up))
    ]
    still = torch.zeros_like(task.start, dtype=task.first.dtype)
    surface = _phase_surface(pair[0], pair[1], still, (task.search, -(-task.search // factor) + 1), (1.0, 1.0 * factor))
    lag, found = _search_peak(surface, factor)
    shift, fraction = task.start + lag, still
    template = take_windows(task.first, places[..., 1], places[..., 0], task.height, task.width)
    for _ in range(_PHASE_PASSES):
        moved = places + shift
        inside = (moved[..., 1] >= 0) & (moved[..., 1] + task.height <= num_rows)
        window = take_windows(task.second, moved[..., 1], moved[..., 0], task.height, task.width)
        surface = _phase_surface(template, window, fraction, (_LAGS, _LAGS), (1.0, 1.0))
        offsets, quality = _finish(task, shift, surface, found & inside)
        best = torch.where(torch.isfinite(offsets), offsets, shift.to(offsets.dtype))
        shift = best.round().long()
        fraction = (best - shift).to(task.first.dtype)
    return offsets, quality


def _hann(size: int, shift: Tensor) -> Tensor:
    """Hann windows (M, size) over ``size`` pixels, moved by ``shift`` (M,) px."""
    places = torch.arange(1, size + 1, dtype=shift.dtype, device=shift.device) - shift[:, None]
    return torch.sin(torch.pi * places.clamp(0, size + 1) / (size + 1)).square()


def _phase_surface(
    first: Tensor, second: Tensor, fraction: Tensor, reach: tuple[int, int], pixel: tuple[float, float]
) -> Tensor:
    """Phase correlation of windows (L, N, h, w) at the lags -reach ... reach: (L, N, lags_y, lags_x).

    Args:
        first: Windows of the earlier frames.
        second: Windows of the later frames.
        fraction: (L, N, 2), how far the Hann window of the second moves (x, y).
        reach: Lags along the rows' axis and the columns.
        pixel: Size of the windows' pixels along the rows' axis and the columns, in px.
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
    high = (u > 0.4)[None] & (v.abs() > 0.25)[:, None]
    noise = (magnitude * high).sum((-2, -1), keepdim=True) / high.sum()
    low_pass = torch.exp(-((v[:, None] / pixel[0]).square() + (u / pixel[1]).square()) / (2 * 0.15**2))
    twice = torch.full_like(u, 2.0)  # for the half of the spectrum that is not stored
    twice[0] = 1.0
    if width % 2 == 0:
        twice[-1] = 1.0
    weight = low_pass * twice / (magnitude + 10.0 * noise + torch.finfo(first.dtype).tiny)
    full = (magnitude * weight).sum((-2, -1))
    turns = []
    for size, frequency in ((reach[0], v), (reach[1], u)):
        angle = 2 * torch.pi * torch.arange(-size, size + 1, device=first.device)[:, None] * frequency
        turns.append(torch.polar(torch.ones_like(angle), angle))
    surface: Tensor = (turns[0] @ ((cross * weight) @ turns[1].T)).real
    surface = surface / full.clamp(min=torch.finfo(first.dtype).tiny)[:, None, None]
    lags: Tensor = surface.unflatten(0, shape)
    return lags


def register_projection(task: BandTask) -> tuple[Tensor, Tensor]:
    """Gray projection: rows or columns summed to profiles, and the profiles correlated.

    Along the scan axis a band of few rows gives too short a profile for the search range: windows eight search ranges
    tall find the course of the offset first. Moved by it, the bands themselves give the offset along the rows, and,
    moved by that too, what remains along the scan axis.
    """
    places = task.places()
    course = _smooth_course(_search_rows(task)).round().long()
    shift = task.start + torch.stack([torch.zeros_like(course), course], dim=-1)
    # lags beyond the search range give the peaks near its edge the neighbours to interpolate from
    x, quality_x = _band_profiles(task, places, shift, (0, task.search + _LAGS - 1))
    shift[..., 0] += torch.nan_to_num(x).round().long()
    y, quality_y = _band_profiles(task, places, shift, (2 * _LAGS, 0))
    offsets = torch.stack([task.start[..., 0] + x, shift[..., 1] + y], dim=-1)
    ok = torch.isfinite(offsets).all(-1) & ((offsets - task.start).abs() < task.search).all(-1)
    return torch.where(ok[..., None], offsets, torch.nan), torch.where(ok, torch.minimum(quality_x, quality_y), 0.0)


def _search_rows(task: BandTask) -> Tensor:
    """Offsets along the scan axis (L, N) beyond the coarse one, from tall windows; NaN where there is no peak."""
    num_rows = task.first.shape[-2]
    tall = min(max(task.height, _TALL * task.search), num_rows // 2)
    tops = (task.tops + (task.height - tall) // 2).clamp(0, num_rows - tall)
    reach = task.search + _LAGS - 1
    row_means = [
        functional.pad(
            _differences(take_windows(image, torch.zeros_like(left), left, num_rows, task.width).mean(-1)), (1, 1)
        )[:, 0]
        for image, left in (
            (task.first, task.left[:, None]),
            (task.second, (task.left + task.coarse[:, 0])[:, None]),
        )
    ]
    begin = tops + task.coarse[:, 1:] - reach
    later = take_windows(row_means[1][..., None], begin, torch.zeros_like(begin), tall + 2 * reach, 1)[..., 0]
    template = row_means[0][:, tops[:, None] + torch.arange(tall, device=begin.device)]
    surface = correlate_profiles(template, later)
    lag_begin = begin[..., None] + torch.arange(2 * reach + 1, device=begin.device)
    return _profile_peak(torch.where((lag_begin >= 0) & (lag_begin + tall <= num_rows), surface, -torch.inf))[0]


def _smooth_course(course: Tensor) -> Tensor:
    """Course (L, N) without gaps, which take the value of the nearest band, and without single wrong peaks."""
    count = course.shape[-1]
    order = torch.arange(count, device=course.device)
    known = torch.isfinite(course)
    before = torch.where(known, order, -1).cummax(-1).values
    after = torch.where(known, order, count).flip(-1).cummin(-1).values.flip(-1)
    nearest = torch.where((before < 0) | ((after < count) & (after - order < order - before)), after, before)
    filled = torch.nan_to_num(course.gather(-1, nearest.clamp(0, count - 1)))
    padded = functional.pad(filled[:, None], (2, 2), mode="replicate")[:, 0]
    return padded.unfold(-1, 5, 1).median(-1).values


def _band_profiles(task: BandTask, places: Tensor, shift: Tensor, reach: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Offset of bands beyond ``shift`` along the axis whose ``reach`` (rows, columns) is not 0, (L, N), and quality."""
    summed = -1 if reach[0] else -2
    moved = places + shift
    width = task.width
    first = take_windows(task.first, places[..., 1], places[..., 0], task.height, width)
    second = take_windows(
        task.second,
        moved[..., 1] - reach[0],
        moved[..., 0] - reach[1],
        task.height + 2 * reach[0],
        width + 2 * reach[1],
    )
    surface = correlate_profiles(_differences(first.mean(summed)), _differences(second.mean(summed)))
    lags = torch.arange(-reach[0], reach[0] + 1, device=surface.device)
    begin = moved[..., 1, None] + lags
    inside = (begin >= 0) & (begin + task.height <= task.second.shape[-2])
    offset, quality = _profile_peak(torch.where(inside, surface, -torch.inf))
    sure = quality > _LEAST_PROFILE_QUALITY
    return torch.where(sure, offset, torch.nan), torch.where(sure, quality, 0.0)


def _differences(profile: Tensor) -> Tensor:
    """Central differences, without the ends: they weigh detail against slow changes of brightness."""
    return profile[..., 2:] - profile[..., :-2]


def _profile_peak(surface: Tensor) -> tuple[Tensor, Tensor]:
    """Sub-pixel lag of the peaks of correlations, NaN where there is none, and quality.

    Args:
        surface: (L, N, 2 reach + 1) where the search range is ``reach - _LAGS + 1``; -infinity at lags that leave the
            frame. A peak at the edge of the search range, or with such a lag beside it, has failed.
    """
    flat = surface.flatten(0, 1)[..., None]
    place, _ = integer_peak(flat)
    around = _cut_lags(flat, place, (_LAGS - 1, 0))
    whole = torch.isfinite(around).all(1)[:, 0]
    position, value = subpixel_peak(torch.where(whole[:, None, None], around, 0.0))
    lag = (place + position)[:, 0] - flat.shape[1] // 2
    search = flat.shape[1] // 2 - _LAGS + 1
    ok = whole & (lag.abs() < search) & torch.isfinite(lag)
    lag, value = torch.where(ok, lag, torch.nan), torch.where(ok, value.clamp(0.0, 1.0), 0.0)
    return lag.unflatten(0, surface.shape[:2]), value.unflatten(0, surface.shape[:2])


BAND_METHODS: dict[str, Callable[[BandTask], tuple[Tensor, Tensor]]] = {
    "projection": register_projection,
    "ncc": register_ncc,
    "phase": register_phase,
}


@dataclass(frozen=True)
class RegistrationOptions:
    """How the offsets of row bands between frames are measured.

    Args:
        method: ``"projection"`` (gray projection), ``"ncc"`` or ``"phase"``: a name of ``BAND_METHODS``.
        band_rows: Rows of a band, at least 4.
        band_step: Rows from one band to the next, at least 1.
        search: Search range in px around the whole-frame offset, at least 2.

    Raises:
        TypeError: If a number is not a whole number.
        ValueError: If the method is unknown or a number is too small.
    """

    method: Registration = "ncc"
    band_rows: int = 32
    band_step: int = 16
    search: int = 16

    def __post_init__(self) -> None:
        check_choice("registration", self.method, tuple(BAND_METHODS))
        for name, least in (("band_rows", 4), ("band_step", 1), ("search", 2)):
            check_whole_number(name, getattr(self, name), at_least=least)
