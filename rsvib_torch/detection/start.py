"""The start of every detection: the offsets of row bands of grey frames, as measurements for a fit.

Roll and zoom displace the content of a row by amounts that depend on the column (``displacement_at``). For a start,
strips of columns are registered as separate stacks. With the displacement ``d_s`` of a row in strip s, its
information ``W_s`` and the factors ``F_s`` from the components q of the motion to the displacement at the strip, the
components of the row are the weighted least-squares solution

    ``(sum_s F_s^T W_s F_s) q = sum_s F_s^T W_s d_s``,

whose matrix is the information of q. Fits then do not differ from those of whole rows. Components of roll and zoom are
multiplied by a length, the rms distance of the pixels from the centre, so that all components are in px.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements, with_axes
from rsvib_torch.frames.pixels import cut_columns, detailed_parts
from rsvib_torch.frames.prepare import GreyFrames
from rsvib_torch.motion.camera import Camera, displacement_factors
from rsvib_torch.motion.motion import ColumnStrips
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import Array, split_axis, table, tables
from rsvib_torch.options import ProjectionOptions, RegistrationOptions
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.registration.register import check_frame_size, fits_frame, register_rows


@dataclass(frozen=True)
class FieldScale:
    """Lengths of a frame that roll and zoom refer to."""

    axes: int  # number of components of the motion, 2 to 4
    width: int  # columns of a frame
    height: int  # rows of a frame
    camera: Camera | None = None  # focal length and lens, in row order

    @property
    def same_for_all_columns(self) -> bool:
        """Whether the motion displaces all columns of a row alike."""
        return self.axes == 2 and self.camera is None

    @property
    def radius(self) -> float:
        """Root-mean-square distance of the pixels from the centre of the frame, in px."""
        return math.sqrt((self.width**2 + self.height**2 - 2) / 12)

    def units(self, like: Tensor) -> Tensor:
        """(A,) factors from components in px to (px, px, rad, 1)."""
        return like.new_tensor([1.0, 1.0, 1 / self.radius, 1 / self.radius][: self.axes])

    def motion(self, fitted: Vibration) -> Vibration:
        """The vibration with roll in rad and relative zoom, of one whose components are all in px."""
        if self.same_for_all_columns:
            return fitted
        return replace(fitted.scaled(self.units(fitted.amplitude)), camera=self.camera)

    def free_motion(self, fitted: FreeMotion) -> FreeMotion:
        """``motion`` for a free motion."""
        coefficients = fitted.coefficients * self.units(fitted.coefficients)[:, None]
        return FreeMotion(coefficients, fitted.start, fitted.spacing, self.motion(fitted.tones))

    def std(self, fitted: VibrationStd) -> VibrationStd:
        """``motion`` for standard deviations."""
        factor = self.units(fitted.amplitude)
        values = {name: getattr(fitted, name) for name in ("image_motion", "image_acceleration", "displacement")}
        scaled = {name: value * factor for name, value in values.items() if value is not None}
        return replace(fitted, amplitude=fitted.amplitude * factor[:, None], **scaled)

    def factors(self, x: Tensor, y: Tensor) -> Tensor:
        """Displacement (S, 2, A) at positions (S) in px from the centre by unit components in px."""
        return displacement_factors(x, y, self.axes, self.camera) * self.units(x)


def camera_in_row_order(options: ProjectionOptions, size: tuple[int, int], timing: SensorTiming) -> Camera | None:
    """Camera of frames of ``size`` (rows, columns) in row order, from the options of ``detect_vibration``."""
    principal_point, distortion = options.principal_point, options.distortion
    if options.focal_length is None:
        for name, value in (("principal_point", principal_point), ("distortion", distortion)):
            if value is not None:
                raise ValueError(f"{name}={value!r} requires focal_length, in px")
        return None
    height, width = size if timing.scan_axis == -2 else size[::-1]
    centre = (0.5 * (width - 1), 0.5 * (height - 1))
    point = centre if principal_point is None else principal_point
    camera = Camera(options.focal_length, point, distortion or (0.0,) * 5)
    x, y = camera.principal_point
    camera = replace(camera, principal_point=(x - centre[0], y - centre[1]))
    camera.check_size(width, height)
    return Vibration.still(axes=2).with_camera(camera).to_row_order(timing).camera


def combined_strips(measured: Measurements, factors: Array) -> Measurements:
    """Components (B, N, G, A) of rows from displacements (B S, N, G, 2) of strips by ``factors`` (B, S, N, 2, A)."""
    strips = factors.shape[1]

    def by_strip(values: Array) -> Array:
        return split_axis(values, 0, -1, strips)

    # 1. Displacements relative to the frames in which all strips of a row are visible.
    visible = by_strip(measured.visible).min(1)
    everywhere = replace(measured, visible=np.repeat(visible, strips, 0))
    displacements = by_strip(everywhere.relative(measured.displacements))  # (B, S, N, G, 2)
    # 2. The normal equations of the components of every row, in units of their sizes.
    weighted = by_strip(measured.information) @ factors
    information = (factors.mT @ weighted).sum(1)  # (B, N, A, A)
    right_side = np.einsum("bsnia,bsngi->bnga", weighted, displacements)
    size = information.diagonal(axis1=-2, axis2=-1)
    unit = 1 / np.sqrt(np.maximum(size, 1e-300))
    normal = information * unit[..., :, None] * unit[..., None, :]
    # 3. Their solution; fewer than two strips with detail do not determine roll.
    values, vectors = np.linalg.eigh(np.where((size > 0).all(-1)[..., None, None], normal, 0.0))
    regular = values[..., 0] > 1e-6
    inverse = (vectors / np.where(regular[..., None], values, 1.0)[..., None, :]) @ vectors.mT  # (B, N, A, A)
    unit = unit[:, :, None]
    components = np.where(regular[:, :, None, None], ((right_side * unit) @ inverse) * unit, 0.0)
    return Measurements(
        by_strip(measured.exposure_starts).mean(1),
        components,
        visible,
        np.where(regular[..., None, None], information, 0.0),
        measured.exposure_time,
        measured.average_times,
        measured.independent,
    )


_START_COLUMNS = 320  # px, columns that give a start of sufficient accuracy


def band_curve(
    frames: Tensor, valid: Tensor | None, timing: RowTiming, options: RegistrationOptions, *, mere_start: bool
) -> OffsetCurve:
    """Offsets of the row bands of grey frames (B, T, H, W), NaN for bands with more than half of their pixels missing.

    A ``mere_start`` is only the start of a fit to rows: only the 320 columns of wide frames with the most detail are
    used, unless a fifth of their bands cannot be registered.
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
    measurements: Measurements  # the offsets as input of a fit
    fit: ToneFit | None = None  # fit of tones that are known; None if there are none

    def predicted(self, fit: ToneFit) -> Array:
        """Offsets (B, P, N, A) in px of the row bands that a fit predicts."""
        displacements = model_displacements(self.measurements, fit)
        return split_axis(displacements[:, :, 1] - displacements[:, :, 0], 1, *self.curve.quality.shape[1:])


def band_start(stacks: GreyFrames, timing: RowTiming, options: RegistrationOptions, *, mere_start: bool) -> BandStart:
    """``band_curve`` with its measurements."""
    curve = band_curve(stacks.images, stacks.valid, timing, options, mere_start=mere_start)
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
    size = round(width / count)  # px
    firsts = tuple(round(number * (width - size) / (count - 1)) for number in range(count))
    strips = ColumnStrips(width, size, firsts, tuple(first + 0.5 * (size - 1) for first in firsts))
    cut_valid = None if valid is None else strips.cut(valid)
    strip_curve = band_curve(strips.cut(frames), cut_valid, timing, options, mere_start=False)
    columns = strips.columns.to(frames.device)
    rows = (strip_curve.rows - 0.5 * (scale.height - 1)).repeat(len(strip_curve.pairs))
    factors = scale.factors(columns[:, None].expand(-1, len(rows)), rows.expand(count, -1))
    strip_measurements = measurements_of_curve(strip_curve, timing, options.band_step)
    measurements = combined_strips(strip_measurements, np.repeat(table(factors)[None], len(frames), 0))
    mask = np.all(measurements.weights > 0, -1)[..., None]
    offsets = np.where(mask, measurements.displacements[:, :, 1] - measurements.displacements[:, :, 0], np.nan)
    offsets, mask = (split_axis(values, 1, *strip_curve.quality.shape[1:]) for values in (offsets, mask))
    quality = strip_curve.quality.unflatten(0, (-1, count)).amin(1) * torch.from_numpy(mask[..., 0]).to(frames.device)
    curve = replace(strip_curve, offsets=torch.from_numpy(offsets).to(frames.device), quality=quality)
    return BandStart(curve, measurements, None if translation is None else with_axes(translation, scale.axes))


def measurements_of_curve(curve: OffsetCurve, timing: RowTiming, band_step: int) -> Measurements:
    """Measurements of a batch of offset curves (B, P, N), weighted by the quality of the bands.

    A correlation q of two noisy bands means a ratio of noise to signal of (1 - q) / q. Weights are its inverse, bounded
    so that no band dominates.
    """
    # 1. The offsets and the weights of the bands of all frame pairs.
    offsets, quality, times, later_times = tables(curve.offsets, curve.quality, curve.times, curve.later_times)
    offsets = offsets.reshape(len(offsets), -1, offsets.shape[-1])
    measured = np.all(np.isfinite(offsets), -1)
    noise = 1.0 - np.minimum(quality.reshape(measured.shape), 1.0)
    weight = np.where(measured, 1.0 / (noise + 0.05), 0.0)
    weight = weight / np.maximum(weight.sum(1, keepdims=True) / np.maximum(measured.sum(1, keepdims=True), 1), 1e-300)
    offsets = np.where(measured[..., None], offsets, 0.0)
    # 2. Their times: content that moves by y along the scan axis is exposed y row times later in the later frame.
    starts = np.broadcast_to(times.ravel(), measured.shape), later_times.ravel() + offsets[..., 1] * timing.row_time
    return Measurements(
        np.stack(starts, -1),
        np.stack([-0.5 * offsets, 0.5 * offsets], -2),
        visible=np.ones((*measured.shape, 2)),
        information=2.0 * weight[..., None, None] * np.eye(2),  # of each of the two, equal and opposite
        exposure_time=timing.exposure_time,
        average_times=(curve.heights[0] * timing.row_time, curve.heights[1] * timing.row_time),
        independent=min(1.0, band_step / max(curve.heights)),
    )
