"""Frames in, vibration out."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from rsvib_torch.arrays import ArrayLike, as_tensor
from rsvib_torch.checks import check_choice, check_whole_number
from rsvib_torch.detection.direct import refine_directly
from rsvib_torch.detection.inversion import vibration_of_fit
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import DetectionResult, OtherMotion, VibrationStd, stacked
from rsvib_torch.detection.row_groups import LARGEST_GROUP
from rsvib_torch.detection.selection import MAX_TONES, find_tones
from rsvib_torch.detection.tones import MotionModel, ToneFit, model_displacements
from rsvib_torch.detection.verdict import judge
from rsvib_torch.missing import fill_roughly
from rsvib_torch.orientation import (
    as_float_frames,
    frames_to_row_order,
    offsets_from_row_order,
    vibration_from_row_order,
)
from rsvib_torch.precision import full_precision, outside_graphs
from rsvib_torch.registration import OffsetCurve, Registration
from rsvib_torch.registration.register import register_rows
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import blind_frequencies

__all__ = ["DetectionMethod", "VibrationDetector", "detect_vibration"]

DetectionMethod = Literal["direct", "bands"]

_LEAST_VALID = 0.5  # of the pixels of a band
_ENOUGH_COLUMNS = 768  # px for a start
_LEAST_START = 0.8  # of the bands
_LEAST_FRAME = 0.1  # of the pixels of a frame


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


@dataclass(frozen=True)
class _Options:
    """Options of ``detect_vibration`` behind the door."""

    method: DetectionMethod
    registration: Registration
    tones: int | None
    model: MotionModel
    band_rows: int
    band_step: int
    search: int


def _detect_bands(
    curve: OffsetCurve, frames: Tensor, valid: Tensor | None, timing: SensorTiming, options: _Options
) -> tuple[ToneFit, OtherMotion | None]:
    """The paper's method: a fit of tones to the offsets of row bands."""
    measurements = measurements_of_curve(curve, timing, options.band_step)
    interval = options.band_step * timing.row_time
    blind = blind_frequencies(timing, 0.5 / interval).to(frames.device)
    return find_tones(measurements, interval, options.tones, options.model, blind=blind), None


def _detect_direct(
    curve: OffsetCurve, frames: Tensor, valid: Tensor | None, timing: SensorTiming, options: _Options
) -> tuple[ToneFit, OtherMotion | None]:
    """The bands' result, refined on the images themselves, row by row."""
    start, _ = _detect_bands(curve, frames, valid, timing, options)
    found = refine_directly(frames, valid, timing, start, options.tones)
    return found.fit, found.other_motion


_METHODS: dict[
    str,
    Callable[
        [OffsetCurve, Tensor, Tensor | None, SensorTiming, _Options],
        tuple[ToneFit, OtherMotion | None],
    ],
] = {"direct": _detect_direct, "bands": _detect_bands}


@outside_graphs
@full_precision
@torch.no_grad()
def detect_vibration(
    frames: ArrayLike,
    timing: SensorTiming,
    *,
    method: DetectionMethod = "direct",
    registration: Registration = "ncc",
    tones: Literal["auto"] | int = "auto",
    harmonics: int = 1,
    image_acceleration: bool = False,
    window: int | None = None,
    window_step: int | None = None,
    band_rows: int = 32,
    band_step: int = 16,
    search: int = 16,
    ignore: Tensor | None = None,
    full_scale: float | None = None,
) -> DetectionResult:
    """Detect the vibration of the camera from consecutive frames (Sec. 2 of Liu et al. 2023).

    Row bands are registered between frames, and the offset curve is fitted with sinusoids and a uniform motion
    (Eq. 5) whose gain, exposure, band average and coupling with the scan are part of the model (Eqs. 4, 6-8). Start
    values come from the data. The direct method then warps the frames to the scene with what was found, lets every
    row tell what it still misses, and fits again: all frames of a stack together, down to the noise. The result is a
    measurement: no gradient flows back through it.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) of at least two frames, tensor or NumPy array;
            floats, or integers of known full scale. NaN marks pixels that were not measured.
        timing: The sensor. Frame start times of its own (dropped frames) open frequencies that even ones are blind to.
        method: ``"direct"``, or ``"bands"`` (the paper's method), in half the time and ten times less accurate.
        registration: ``"ncc"``, ``"phase"`` or ``"projection"``.
        tones: Number of tones of each axis, 1 to 4, or ``"auto"`` to choose it from the data.
        harmonics: Every tone comes with its multiples up to this one, tied to one frequency; 1 leaves tones free.
        image_acceleration: Whether the image motion may change its speed steadily.
        window: Frames that one result comes from: the vibration is followed through the stack, and the result is a
            batch of one entry a window (a leading dimension behind B). None for one result from all frames.
        window_step: Frames from one window to the next; half a window when not given.
        band_rows: Rows of a band.
        band_step: Rows from one band to the next.
        search: Search range in px around the whole-frame offset.
        ignore: Bool, broadcastable to (..., H, W) of the frames: True for pixels to leave out (dead, saturated).
        full_scale: Count that means 1.0, for integer frames.

    Returns:
        The vibration in image axes (x, y) with standard deviations, verdict, and the curve it stands on.

    Raises:
        TypeError: If frames are not numbers.
        ValueError: If there are fewer than two frames, a frame has no detail or hardly a pixel that counts, or an
            option is out of range.

    Example:
        >>> timing = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
        >>> detect_vibration(torch.rand(1, 256, 256), timing)
        Traceback (most recent call last):
        ...
        ValueError: at least 2 frames are needed, got 1
    """
    check_choice("method", method, tuple(_METHODS))
    if tones != "auto":
        check_whole_number("tones", tones, at_least=1)
        if tones > MAX_TONES:
            raise ValueError(f"tones must be 'auto' or 1 to {MAX_TONES}, got {tones}")
    check_whole_number("harmonics", harmonics, at_least=1)
    frames = as_float_frames(frames, full_scale, minimum_frames=2, nan_is_missing=True)
    valid = _valid_pixels(frames, ignore)
    frames = frames_to_row_order(frames, timing)
    batched = frames.ndim == 5
    frames = frames if batched else frames[None] if frames.ndim == 4 else frames[None, :, None]
    if valid is not None:
        valid = frames_to_row_order(valid, timing)
        valid = valid if batched else valid[None]
        share = valid.float().mean((-2, -1))
        if bool((share < _LEAST_FRAME).any()):
            where = (share < _LEAST_FRAME).nonzero()[0].tolist()
            raise ValueError(f"frame {where[-1]} has only {share[*where]:.1%} of pixels that count")
        frames = fill_roughly(frames, ~valid[:, :, None].expand(frames.shape))
    check_detail(frames)
    count = None if tones == "auto" else tones
    model = MotionModel(harmonics, 2 if image_acceleration else 1)
    options = _Options(method, registration, count, model, band_rows, band_step, search)
    grey = frames.mean(-3) if frames.shape[-3] > 1 else frames[:, :, 0]
    if window is None:
        result = _detect(grey, valid, timing, options)
        return result if batched else result[0]
    results = [
        _detect(grey[:, part], None if valid is None else valid[:, part], within, options)
        for part, within in _windows(grey.shape[1], window, window_step, timing)
    ]
    followed = stacked(results)
    return followed if batched else followed[0]


def check_detail(frames: Tensor) -> None:
    """Raise ValueError for frames (B, T, C, H, W) of which one is constant."""
    low, high = frames.amin((-3, -2, -1)), frames.amax((-3, -2, -1))
    flat = high - low <= 1e-6 * torch.maximum(low.abs(), high.abs())
    if bool(flat.any()):
        where = flat.nonzero()[0].tolist()
        raise ValueError(f"frame {where[-1]} is constant: without detail there is nothing to register")


def _valid_pixels(frames: Tensor, ignore: Tensor | None) -> Tensor | None:
    """Pixels (..., T, H, W) that count, in image orientation; None where all do."""
    missing = torch.isnan(frames)
    missing = missing if frames.ndim == 3 else missing.any(-3)
    if ignore is not None:
        ignore = as_tensor("ignore", ignore).to(frames.device)
        if ignore.dtype != torch.bool:
            raise TypeError(f"ignore must be a bool tensor, got {ignore.dtype}")
        try:
            missing = missing | ignore
        except RuntimeError as error:
            raise ValueError(f"ignore {tuple(ignore.shape)} does not fit frames {tuple(missing.shape)}") from error
    return ~missing if bool(missing.any()) else None


def _windows(num_frames: int, window: int, step: int | None, timing: SensorTiming) -> list[tuple[slice, SensorTiming]]:
    """Windows of frames, the last one flush with the end, each with the start times of its frames."""
    check_whole_number("window", window, at_least=2)
    if window > num_frames:
        raise ValueError(f"window of {window} frames is longer than the stack of {num_frames}")
    step = max(1, window // 2) if step is None else step
    check_whole_number("window_step", step, at_least=1)
    firsts = list(range(0, num_frames - window + 1, step))
    if firsts[-1] + window < num_frames:
        firsts.append(num_frames - window)
    starts = timing.frame_starts(num_frames)
    return [
        (slice(first, first + window), replace(timing, frame_start_times=starts[first : first + window]))
        for first in firsts
    ]


def _detect(frames: Tensor, valid: Tensor | None, timing: SensorTiming, options: _Options) -> DetectionResult:
    """``detect_vibration`` of grey frames (B, T, H, W) in row order; the result is a batch in image axes."""
    in_rows = timing.in_row_order()
    curve = _register(frames, in_rows, options)
    if valid is not None:
        curve = _without_spoilt_bands(curve, valid)
    fit, other_motion = _METHODS[options.method](curve, frames, valid, in_rows, options)
    vibration, std = vibration_of_fit(fit)
    predicted = model_displacements(measurements_of_curve(curve, in_rows, options.band_step), fit)
    fitted = (predicted[:, :, 1] - predicted[:, :, 0]).unflatten(1, curve.quality.shape[1:])
    difference = (curve.offsets - fitted).abs().nanmean(dim=(1, 2))

    # bands that an image motion has carried out of the later frame cannot be found there
    later = curve.rows + fitted[..., 1]
    shown = (later >= 0.5 * options.band_rows) & (later <= frames.shape[-2] - 1 - 0.5 * options.band_rows)
    duration = float(curve.later_times.max() - curve.times.min()) + options.band_rows * timing.row_time
    starts = in_rows.frame_starts(frames.shape[1], frames.device)
    baselines = 1 if options.method == "bands" else min(len(starts), LARGEST_GROUP) - 1
    intervals = torch.cat([starts[step:] - starts[:-step] for step in range(1, baselines + 1)])
    verdicts = [
        judge(
            vibration[index],
            std[index],
            offsets=curve.offsets[index].flatten(0, 1),
            fitted=fitted[index].flatten(0, 1),
            shown=shown[index].flatten(),
            intervals=intervals,
            duration=duration,
            timing=in_rows,
            other_motion=None if other_motion is None else other_motion[index],
        )
        for index in range(len(frames))
    ]
    reliable = torch.stack([verdict[0] for verdict in verdicts])
    swap = timing.scan_axis == -1
    reasons = tuple((r[1], r[0]) if swap else r for _, r in verdicts)
    in_image = vibration_from_row_order(vibration, timing)
    return DetectionResult(
        vibration=in_image,
        std=_swap_std(std) if swap else std,
        offsets=replace(
            curve,
            offsets=offsets_from_row_order(curve.offsets, timing),
            heights=(curve.heights[1], curve.heights[0]) if swap else curve.heights,
        ),
        fitted=offsets_from_row_order(fitted, timing),
        gain=in_image.gain(float(intervals[0])),
        residual=difference.flip(-1) if swap else difference,
        reliable=reliable.flip(-1) if swap else reliable,
        reasons=reasons,
    )


def _register(frames: Tensor, timing: SensorTiming, options: _Options) -> OffsetCurve:
    """Offsets of the bands of frames (B, T, H, W).

    As a mere start the columns in the middle of wide frames do, if they show enough.
    """

    def offsets_of(columns: Tensor) -> OffsetCurve:
        return register_rows(
            columns[:, :, None],
            timing,
            method=options.registration,
            band_rows=options.band_rows,
            band_step=options.band_step,
            search=options.search,
        )

    width = frames.shape[-1]
    if options.method == "bands" or width <= _ENOUGH_COLUMNS:
        return offsets_of(frames)
    first = (width - _ENOUGH_COLUMNS) // 2
    curve = offsets_of(frames[..., first : first + _ENOUGH_COLUMNS])
    return curve if float(curve.good.double().mean((1, 2)).amin()) > _LEAST_START else offsets_of(frames)


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


def _swap_std(std: VibrationStd) -> VibrationStd:
    return VibrationStd(
        std.amplitude.flip(-2),
        std.frequency.flip(-2),
        std.period.flip(-2),
        std.phase.flip(-2),
        std.image_motion.flip(-1),
        std.image_acceleration.flip(-1),
    )


class VibrationDetector(nn.Module):
    """``detect_vibration`` with fixed timing and options as a module, for one stack or a batch of stacks.

    It has no weights. Autocast does not reach it, and ``torch.compile`` calls it as it is, at one break of the graph.

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
