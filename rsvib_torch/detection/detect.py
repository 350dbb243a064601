"""Frames in, vibration out."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn

from rsvib_torch.checks import check_choice, check_whole_number
from rsvib_torch.detection.direct import refine_directly
from rsvib_torch.detection.inversion import vibration_of_fit
from rsvib_torch.detection.result import DetectionResult, VibrationStd
from rsvib_torch.detection.selection import MAX_TONES, find_tones
from rsvib_torch.detection.tones import Measurements, ToneFit, model_offsets
from rsvib_torch.detection.verdict import judge
from rsvib_torch.orientation import (
    as_float_frames,
    frames_to_row_order,
    offsets_from_row_order,
    vibration_from_row_order,
)
from rsvib_torch.registration import OffsetCurve, Registration
from rsvib_torch.registration.register import register_rows
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration

__all__ = ["DetectionMethod", "VibrationDetector", "detect_vibration"]

DetectionMethod = Literal["bands", "direct"]


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
    information = torch.diag_embed(weight[..., None].expand(-1, -1, 2))
    batch = len(offsets)
    starts = curve.times.flatten().expand(batch, -1)
    # content that moved along the scan axis is exposed that many row times later in the later frame
    later = curve.later_times.flatten() + offsets[..., 1] * timing.row_time
    return Measurements(
        starts=starts,
        later_starts=later,
        offsets=offsets,
        information=information,
        exposure_time=timing.exposure_time,
        average_times=(curve.heights[0] * timing.row_time, curve.heights[1] * timing.row_time),
        independent=min(1.0, band_step / max(curve.heights)),
    )


def _detect_bands(
    frames: Tensor, timing: SensorTiming, tones: int | None, registration: Registration, bands: tuple[int, int, int]
) -> tuple[Vibration, VibrationStd, OffsetCurve, Tensor]:
    """The paper's method: offsets of row bands, and a fit of tones to them."""
    height, step, search = bands
    curve = register_rows(frames, timing, method=registration, band_rows=height, band_step=step, search=search)
    measurements = measurements_of_curve(curve, timing, step)
    fit = find_tones(measurements, step * timing.row_time, tones)
    return _described(measurements, fit, curve, measurements)


def _detect_direct(
    frames: Tensor, timing: SensorTiming, tones: int | None, registration: Registration, bands: tuple[int, int, int]
) -> tuple[Vibration, VibrationStd, OffsetCurve, Tensor]:
    """The bands' result, refined on the images themselves, row by row."""
    start, _, curve, _ = _detect_bands(frames, timing, tones, registration, bands)
    grey = frames.mean(-3)
    measurements, fit = refine_directly(grey, timing, start, tones)
    return _described(measurements, fit, curve, measurements_of_curve(curve, timing, bands[1]))


def _described(
    measurements: Measurements, fit: ToneFit, curve: OffsetCurve, of_bands: Measurements
) -> tuple[Vibration, VibrationStd, OffsetCurve, Tensor]:
    """Vibration and standard deviations of a fit, and the offsets it predicts for the bands."""
    vibration, std = vibration_of_fit(measurements, fit)
    turn = 2 * math.pi * fit.frequencies * (of_bands.centre - measurements.centre)[:, None, None]
    recentred = replace(fit, coefficients=fit.coefficients * torch.polar(torch.ones_like(turn), turn))
    fitted = model_offsets(of_bands, recentred).unflatten(1, curve.quality.shape[1:])
    return vibration, std, curve, fitted


_METHODS: dict[
    str,
    Callable[
        [Tensor, SensorTiming, int | None, Registration, tuple[int, int, int]],
        tuple[Vibration, VibrationStd, OffsetCurve, Tensor],
    ],
] = {"bands": _detect_bands, "direct": _detect_direct}


def detect_vibration(
    frames: Tensor,
    timing: SensorTiming,
    *,
    method: DetectionMethod = "bands",
    registration: Registration = "ncc",
    tones: Literal["auto"] | int = "auto",
    band_rows: int = 32,
    band_step: int = 16,
    search: int = 16,
    full_scale: float | None = None,
) -> DetectionResult:
    """Detect the vibration of the camera from consecutive frames (Sec. 2 of Liu et al. 2023).

    Row bands are registered between frames, and the offset curve is fitted with sinusoids and a uniform motion
    (Eq. 5) whose gain, exposure, band average and coupling with the scan are part of the model (Eqs. 4, 6-8). Start
    values come from the data.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) of at least two frames; floats, or integers of known
            full scale.
        timing: The sensor.
        method: ``"bands"`` (the paper's method), or ``"direct"``: its result refined on the images themselves, row by
            row, several times slower and about ten times more accurate.
        registration: ``"ncc"``, ``"phase"`` or ``"projection"``.
        tones: Number of tones of each axis, 1 to 4, or ``"auto"`` to choose it from the data.
        band_rows: Rows of a band.
        band_step: Rows from one band to the next.
        search: Search range in px around the whole-frame offset.
        full_scale: Count that means 1.0, for integer frames.

    Returns:
        The vibration in image axes (x, y) with standard deviations, verdict, and the curve it stands on.

    Raises:
        TypeError: If frames are not numbers.
        ValueError: If there are fewer than two frames, a pixel is not finite, frames have no detail at all, or an
            option is out of range.
    """
    check_choice("method", method, tuple(_METHODS))
    if tones != "auto":
        check_whole_number("tones", tones, at_least=1)
        if tones > MAX_TONES:
            raise ValueError(f"tones must be 'auto' or 1 to {MAX_TONES}, got {tones}")
    frames = frames_to_row_order(as_float_frames(frames, full_scale, minimum_frames=2), timing)
    batched = frames.ndim == 5
    frames = frames if batched else frames[None] if frames.ndim == 4 else frames[None, :, None]
    flat = frames.flatten(-3).std(-1) <= 1e-7 * frames.flatten(-3).abs().amax(-1)
    if bool(flat.any()):
        where = flat.nonzero()[0].tolist()
        raise ValueError(f"frame {where[-1]} is constant: without detail there is nothing to register")
    in_rows = timing.in_row_order()
    vibration, std, curve, fitted = _METHODS[method](
        frames, in_rows, None if tones == "auto" else tones, registration, (band_rows, band_step, search)
    )
    difference = (curve.offsets - fitted).abs().nanmean(dim=(1, 2))

    duration = float(curve.times.max() - curve.times.min()) + band_rows * timing.row_time
    intervals = (curve.later_times - curve.times)[:, 0].unique()
    verdicts = [
        judge(
            vibration[index],
            std[index],
            offsets=curve.offsets[index].flatten(0, 1),
            fitted=fitted[index].flatten(0, 1),
            intervals=intervals,
            duration=duration,
            timing=in_rows,
        )
        for index in range(len(frames))
    ]
    reliable = torch.stack([verdict[0] for verdict in verdicts])
    swap = timing.scan_axis == -1
    reasons = tuple((r[1], r[0]) if swap else r for _, r in verdicts)
    in_image = vibration_from_row_order(vibration, timing)
    result = DetectionResult(
        vibration=in_image,
        std=_swap_std(std) if swap else std,
        offsets=OffsetCurve(
            curve.pairs,
            curve.rows,
            curve.times,
            curve.later_times,
            offsets_from_row_order(curve.offsets, timing),
            curve.quality,
            (curve.heights[1], curve.heights[0]) if swap else curve.heights,
        ),
        fitted=offsets_from_row_order(fitted, timing),
        gain=in_image.gain(float(intervals[0])),
        residual=difference.flip(-1) if swap else difference,
        reliable=reliable.flip(-1) if swap else reliable,
        reasons=reasons,
    )
    return result if batched else result[0]


def _swap_std(std: VibrationStd) -> VibrationStd:
    return VibrationStd(
        std.amplitude.flip(-2),
        std.frequency.flip(-2),
        std.period.flip(-2),
        std.phase.flip(-2),
        std.image_motion.flip(-1),
    )


class VibrationDetector(nn.Module):
    """``detect_vibration`` with fixed timing and options as a module.

    Args:
        timing: The sensor.
        **options: Options of ``detect_vibration``.
    """

    def __init__(self, timing: SensorTiming, **options: object) -> None:
        super().__init__()
        self.timing = timing
        self.options = options

    def forward(self, frames: Tensor) -> DetectionResult:
        """Detect the vibration in a stack of frames."""
        return detect_vibration(frames, self.timing, **self.options)  # type: ignore[arg-type]
