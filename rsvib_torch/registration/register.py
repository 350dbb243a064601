"""Offsets of all bands of all frame pairs of a stack."""

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn import functional

from rsvib_torch.frames.orientation import offsets_from_row_order
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.registration.band_windows import band_tops
from rsvib_torch.registration.coarse import coarse_offset
from rsvib_torch.registration.methods import BAND_METHODS, BandTask, Registration, RegistrationOptions
from rsvib_torch.registration.offset_curve import OffsetCurve

__all__ = ["register_bands", "register_rows"]

_LOWEST_QUALITY = 0.1  # correlation below this is chance
_SMOOTHING = 1.0  # px, sigma: lets the peak between pixels be found from whole-pixel lags, and damps noise
_MEMORY = 2**28  # bytes of windows at a time


def register_bands(
    frames: Tensor,
    timing: SensorTiming,
    *,
    method: Registration = "ncc",
    band_rows: int = 32,
    band_step: int = 16,
    search: int = 16,
    full_scale: float | None = None,
) -> OffsetCurve:
    """Measure the offset of every row band between consecutive frames (Sec. 2.2 of Liu et al. 2023).

    A whole-frame offset is found first, so that image motion of hundreds of px is no obstacle; the search range
    counts from there.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) with T >= 2.
        timing: The sensor.
        method: ``"projection"`` (gray projection, the paper), ``"ncc"`` or ``"phase"``.
        band_rows: Rows of a band (the paper's window size).
        band_step: Rows from one band to the next (the paper's window interval).
        search: Search range in px; a peak at its edge counts as failed.
        full_scale: Count that means 1.0, for integer frames.

    Returns:
        The offset curve, axes (x, y) of the image, rows in read order.

    Raises:
        ValueError: If there are fewer than two frames, or the frames are too small for the bands and search range.
    """
    options = RegistrationOptions(method, band_rows, band_step, search)
    prepared = prepare_frames(frames, timing, full_scale=full_scale, minimum_frames=2, allow_missing=False)
    batch = register_rows(prepared.images.mean(2), prepared.timing, options)
    curve = batch if prepared.batched else batch[0]
    offsets = offsets_from_row_order(curve.offsets, timing)
    heights = (curve.heights[1], curve.heights[0]) if timing.scan_axis == -1 else curve.heights
    return OffsetCurve(curve.pairs, curve.rows, curve.times, curve.later_times, offsets, curve.quality, heights)


def register_rows(grey: Tensor, timing: RowTiming, options: RegistrationOptions) -> OffsetCurve:
    """``register_bands`` of prepared frames.

    Args:
        grey: (B, T, H, W) float32 or float64 in row order.
        timing: The sensor.
        options: How bands are registered.

    Returns:
        A batch of B offset curves, axes (x, y) in row order.
    """
    band_rows, search = options.band_rows, options.search
    batch, num_frames, num_rows, width = grey.shape
    timing.check_rows(num_rows)
    needed = (band_rows + 2 * search, 4 * (search + 8))
    if num_rows < needed[0] or width < needed[1]:
        raise ValueError(
            f"frames of {num_rows} x {width} px (rows in read order x px a row) are too small for bands of "
            f"{band_rows} rows searched over {search} px: at least {needed[0]} x {needed[1]} are needed"
        )
    grey = _flatten_rows(gaussian_blur2d(grey, (7, 7), (_SMOOTHING, _SMOOTHING)))
    tops = band_tops(num_rows, band_rows, options.band_step, grey.device)
    first, second = grey[:, :-1].flatten(0, 1), grey[:, 1:].flatten(0, 1)
    cost = len(tops) * (band_rows + 2 * search) * (width + 2 * search) * grey.element_size() * 4
    chunk = max(1, _MEMORY // cost)
    offsets, quality = [], []
    for begin in range(0, len(first), chunk):
        pair = slice(begin, begin + chunk)
        task = BandTask(first[pair], second[pair], coarse_offset(first[pair], second[pair]), tops, band_rows, search)
        if task.width < search:
            raise ValueError(f"frames {width} px wide overlap too little after their whole-frame offset")
        measured, correlation = BAND_METHODS[options.method](task)
        failed = ~(correlation > _LOWEST_QUALITY)
        offsets.append(torch.where(failed[..., None], torch.nan, measured))
        quality.append(torch.where(failed, 0.0, correlation))
    rows = tops.to(torch.float64) + 0.5 * (band_rows - 1)
    starts = timing.frame_starts(num_frames, grey.device)[:, None] + rows * timing.row_time
    index = torch.arange(num_frames, device=grey.device)
    return OffsetCurve(
        pairs=torch.stack([index[:-1], index[1:]], dim=-1),
        rows=rows,
        times=starts[:-1],
        later_times=starts[1:],
        offsets=torch.cat(offsets).to(torch.float64).unflatten(0, (batch, num_frames - 1)),
        quality=torch.cat(quality).to(torch.float64).unflatten(0, (batch, num_frames - 1)),
        heights=(band_rows, band_rows),
    )


def _flatten_rows(images: Tensor) -> Tensor:
    """Take out the slow course of the row means: products of windows then keep their precision in float32."""
    course = images.mean(-1)
    size = min(65, (course.shape[-1] - 1) // 2 * 2 + 1)
    padded = functional.pad(course, (size // 2, size // 2), mode="replicate")
    return images - functional.avg_pool1d(padded, size, stride=1)[..., None]
