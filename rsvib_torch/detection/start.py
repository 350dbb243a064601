"""The start of every detection: the offsets of row bands of grey frames, and the measurements these give.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.strips import FieldScale, combined_strips
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements, with_axes
from rsvib_torch.frames.pixels import cut_columns, detailed_parts
from rsvib_torch.frames.prepare import GreyFrames
from rsvib_torch.motion.motion import ColumnStrips
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.numerics.tables import Array, split_axis, table, tables
from rsvib_torch.options import RegistrationOptions
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.registration.register import check_frame_size, fits_frame, register_rows

_START_COLUMNS = 320  # px, columns that give a start of sufficient accuracy


def band_curve(
    frames: Tensor, valid: Tensor | None, timing: RowTiming, options: RegistrationOptions, *, mere_start: bool
) -> OffsetCurve:
    """Offsets of the row bands of grey frames (B, T, H, W), NaN for bands with more than half of their pixels missing.

    A ``mere_start`` is only the start of a fit to rows. Of wide frames, the 320 columns with the most detail are used
    then, unless a fifth of their bands cannot be registered.
    """
    check_frame_size(frames.shape[-2], frames.shape[-1], options)  # of the user's frames, not of the columns in use
    curve = None
    if mere_start and frames.shape[-1] > _START_COLUMNS:
        curve = register_rows(cut_columns(frames, detailed_parts(frames, _START_COLUMNS)), timing, options)
    if curve is None or float(curve.good.double().mean((1, 2)).amin()) <= 0.8:
        curve = register_rows(frames, timing, options)
    if valid is None:
        return curve
    height = max(curve.heights)
    tops = (curve.rows - 0.5 * (height - 1)).round().to(torch.int64)
    share = functional.avg_pool1d(valid.double().mean(-1), height, stride=1)[..., tops]  # (B, T, N)
    missing = torch.minimum(share[:, curve.pairs[:, 0]], share[:, curve.pairs[:, 1]]) < 0.5
    return replace(
        curve,
        offsets=torch.where(missing[..., None], torch.nan, curve.offsets),
        quality=torch.where(missing, 0.0, curve.quality),
    )


@dataclass(frozen=True, eq=False)
class BandStart:
    """Offsets of row bands, with which every detection starts."""

    curve: OffsetCurve  # (B, P, N) offsets; with roll and zoom in px (``FieldScale``)
    measurements: Measurements  # the same as input of a fit
    fit: ToneFit | None = None  # tones that are known; None if there are none

    def predicted(self, fit: ToneFit) -> Array:
        """Offsets (B, P, N, A) in px of the row bands that a fit predicts."""
        displacements = model_displacements(self.measurements, fit)
        return split_axis(displacements[:, :, 1] - displacements[:, :, 0], 1, *self.curve.quality.shape[1:])


def band_start(
    stacks: GreyFrames, timing: RowTiming, options: RegistrationOptions, known: OffsetCurve | None, *, mere_start: bool
) -> BandStart:
    """``band_curve`` with its measurements; ``known`` are the offsets of these frames with another timing."""
    if known is None:
        curve = band_curve(stacks.images, stacks.valid, timing, options, mere_start=mere_start)
    else:
        starts = timing.frame_starts(stacks.images.shape[1], stacks.images.device)
        times = starts[:, None] + known.rows * timing.row_time
        curve = replace(known, times=times[:-1], later_times=times[1:])
    return BandStart(curve, measurements_of_curve(curve, timing, options.band_step))


def _num_strips(width: int) -> int:
    """Parts of the columns from which roll and zoom are measured at the start."""
    return min(4, max(2, width // 128))


def strips_fit(num_rows: int, width: int, options: RegistrationOptions) -> bool:
    """Whether parts of the columns are wide enough for a motion with roll or zoom."""
    return fits_frame(num_rows, round(width / _num_strips(width)), options)


def field_start(
    stacks: GreyFrames, timing: RowTiming, options: RegistrationOptions, scale: FieldScale, translation: ToneFit | None
) -> BandStart:
    """Offsets of row bands for a motion with roll or zoom, from two to four parts of the columns.

    Bands of parts of the width are often registered wrongly. The tones of x and y are therefore taken from the
    ``translation``, a fit without roll and zoom, which has smaller errors. Parts that are too narrow are an error.
    """
    frames, valid, width = stacks.images, stacks.valid, stacks.images.shape[-1]
    count = _num_strips(width)
    check_frame_size(frames.shape[-2], width, options, count)
    part = round(width / count)  # px
    firsts = tuple(round(number * (width - part) / (count - 1)) for number in range(count))
    strips = ColumnStrips(width, part, firsts, tuple(first + 0.5 * (part - 1) for first in firsts))
    cut_valid = None if valid is None else strips.cut(valid)
    of_strips = band_curve(strips.cut(frames), cut_valid, timing, options, mere_start=False)
    columns = strips.columns.to(frames.device)
    rows = (of_strips.rows - 0.5 * (scale.height - 1)).repeat(len(of_strips.pairs))
    factors = scale.factors(columns[:, None].expand(-1, len(rows)), rows.expand(count, -1))
    of_parts = measurements_of_curve(of_strips, timing, options.band_step)
    measurements = combined_strips(of_parts, np.repeat(table(factors)[None], len(frames), 0))
    good = np.all(measurements.weights > 0, -1)[..., None]
    offsets = np.where(good, measurements.displacements[:, :, 1] - measurements.displacements[:, :, 0], np.nan)
    offsets, good = (split_axis(values, 1, *of_strips.quality.shape[1:]) for values in (offsets, good))
    quality = of_strips.quality.unflatten(0, (-1, count)).amin(1) * torch.from_numpy(good[..., 0]).to(frames.device)
    curve = replace(of_strips, offsets=torch.from_numpy(offsets).to(frames.device), quality=quality)
    return BandStart(curve, measurements, None if translation is None else with_axes(translation, scale.axes))


def measurements_of_curve(curve: OffsetCurve, timing: RowTiming, band_step: int) -> Measurements:
    """Measurements of a batch of offset curves (B, P, N), weighted by the quality of the bands.

    A correlation q of two noisy bands means a ratio of noise to signal of (1 - q) / q. Weights are its inverse, bounded
    so that no band dominates.
    """
    # 1. The offsets and the weights of the bands of all frame pairs.
    offsets, quality, times, later_times = tables(curve.offsets, curve.quality, curve.times, curve.later_times)
    offsets = offsets.reshape(len(offsets), -1, offsets.shape[-1])
    good = np.all(np.isfinite(offsets), -1)
    noise = 1.0 - np.minimum(quality.reshape(good.shape), 1.0)
    weight = np.where(good, 1.0 / (noise + 0.05), 0.0)
    weight = weight / np.maximum(weight.sum(1, keepdims=True) / np.maximum(good.sum(1, keepdims=True), 1), 1e-300)
    offsets = np.where(good[..., None], offsets, 0.0)
    # 2. Their times: content that moves by y along the scan axis is exposed y row times later in the later frame.
    starts = np.broadcast_to(times.ravel(), good.shape), later_times.ravel() + offsets[..., 1] * timing.row_time
    return Measurements(
        np.stack(starts, -1),
        np.stack([-0.5 * offsets, 0.5 * offsets], -2),
        visible=np.ones((*good.shape, 2)),
        information=2.0 * weight[..., None, None] * np.eye(2),  # of each of the two, equal and opposite
        exposure_time=timing.exposure_time,
        average_times=(curve.heights[0] * timing.row_time, curve.heights[1] * timing.row_time),
        independent=min(1.0, band_step / max(curve.heights)),
    )
