"""Where detection starts: the offsets of row bands between frames, and what they tell a fit."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.registration import OffsetCurve, RegistrationOptions
from rsvib_torch.registration.register import register_rows

__all__ = ["band_curve", "measurements_of_curve"]

_LEAST_VALID = 0.5  # of the pixels of a band
_ENOUGH_COLUMNS = 512  # px for a start
_LEAST_START = 0.8  # of the bands


def band_curve(
    frames: Tensor, valid: Tensor | None, timing: RowTiming, options: RegistrationOptions, *, mere_start: bool
) -> OffsetCurve:
    """Offsets of the bands of grey frames (B, T, H, W) in row order, those without enough pixels left out.

    Args:
        frames: The frames.
        valid: (B, T, H, W) bool, pixels that count; None for all.
        timing: The sensor, in row order.
        options: How bands are registered.
        mere_start: Whether the columns in the middle of wide frames do, if they show enough.
    """
    width = frames.shape[-1]
    if not mere_start or width <= _ENOUGH_COLUMNS:
        curve = register_rows(frames, timing, options)
    else:
        first = (width - _ENOUGH_COLUMNS) // 2
        curve = register_rows(frames[..., first : first + _ENOUGH_COLUMNS], timing, options)
        if float(curve.good.double().mean((1, 2)).amin()) <= _LEAST_START:
            curve = register_rows(frames, timing, options)
    return curve if valid is None else _without_spoilt_bands(curve, valid)


def _without_spoilt_bands(curve: OffsetCurve, valid: Tensor) -> OffsetCurve:
    """The curve without the bands whose pixels hardly count in one of the frames."""
    rows = valid.double().mean(-1)  # (B, T, H)
    height = max(curve.heights)
    bands = torch.nn.functional.avg_pool1d(rows, height, stride=1)
    tops = (curve.rows - 0.5 * (height - 1)).round().to(torch.int64)
    share = bands[..., tops]
    spoilt = torch.minimum(share[:, curve.pairs[:, 0]], share[:, curve.pairs[:, 1]]) < _LEAST_VALID
    return replace(
        curve,
        offsets=torch.where(spoilt[..., None], torch.nan, curve.offsets),
        quality=torch.where(spoilt, 0.0, curve.quality),
    )


def measurements_of_curve(curve: OffsetCurve, timing: SensorTiming, band_step: int) -> Measurements:
    """Measurements of a batch of offset curves (B, P, N), weighted by the quality of the bands.

    A correlation q of two noisy bands means noise over signal of (1 - q)/q: bands weigh by its inverse, bounded so
    that no band dominates.
    """
    offsets = curve.offsets.flatten(1, 2)
    good = torch.isfinite(offsets).all(-1)
    noise = 1.0 - curve.quality.flatten(1, 2).clamp(max=1.0)
    weight = torch.where(good, 1.0 / (noise + 0.05), 0.0)
    typical = weight.sum(1, keepdim=True) / good.sum(1, keepdim=True).clamp(min=1)
    weight = weight / typical.clamp(min=1e-300)
    offsets = torch.where(good[..., None], offsets, 0.0)
    # content that moved along the scan axis is exposed that many row times later in the later frame
    later = curve.later_times.flatten() + offsets[..., 1] * timing.row_time
    return Measurements.of_pairs(
        starts=curve.times.flatten().expand(len(offsets), -1),
        later_starts=later,
        offsets=offsets,
        information=torch.diag_embed(weight[..., None].expand(-1, -1, 2)),
        exposure_time=timing.exposure_time,
        average_times=(curve.heights[0] * timing.row_time, curve.heights[1] * timing.row_time),
        independent=min(1.0, band_step / max(curve.heights)),
    )
