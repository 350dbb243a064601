"""Band registration by gray projection (Sec. 2.2 of Liu et al. 2023)."""

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.registration.bands import LAGS, BandTask, cut_lags, integer_peak, subpixel_peak, take_windows
from rsvib_torch.registration.ncc import normalise

__all__ = ["register_projection"]


def register_projection(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by correlation of profiles, the means of rows and of columns.

    Across the rows, the profile of a band is too short for the search range. Windows that are eight search ranges tall
    therefore give a smooth course of the offset across the rows first. With that shift, the bands give the offset
    along the rows, and with both shifts the remaining offset across the rows. The contract is that of
    ``BAND_METHODS``.
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
    significant = quality > 0.6  # profiles of a few dozen rows reach 0.6 by chance
    return torch.where(significant, offset, torch.nan), torch.where(significant, quality, 0.0)


def _differences(profile: Tensor) -> Tensor:
    """Central differences without the ends, which suppress slow changes of brightness."""
    return profile[..., 2:] - profile[..., :-2]


def _profile_peak(surface: Tensor) -> tuple[Tensor, Tensor]:
    """Sub-pixel lag of the peaks of correlations, NaN where there is none, and quality.

    Args:
        surface: (L, N, 2 reach + 1) where the search range is ``reach - LAGS + 1``; -infinity at lags that leave the
            frame. A peak at the edge of the search range, or next to a lag of -infinity, gives NaN and quality 0.
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


def correlate_profiles(template: Tensor, search: Tensor) -> Tensor:
    """Zero-mean normalised cross-correlation of profiles at all lags.

    Args:
        template: (..., w).
        search: (..., w + b).

    Returns:
        (..., b + 1) in -1 ... 1; 0 where a window is constant.
    """
    template = template.to(torch.float64)
    template = template - template.mean(-1, keepdim=True)
    windows = search.to(torch.float64).unfold(-1, template.shape[-1], 1)
    cross = (windows @ template[..., None])[..., 0]
    energy = windows.square().sum(-1) - windows.sum(-1).square() / template.shape[-1]
    typical = search.square().mean(-1, keepdim=True) * template.shape[-1]
    return normalise(cross, energy, template.square().sum(-1, keepdim=True), typical)
