"""Frames in, vibration out."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypedDict, Unpack, overload

import torch
from torch import Tensor, nn

from rsvib_torch.core.checks import check_choice, check_whole_number
from rsvib_torch.core.precision import full_precision, outside_graphs
from rsvib_torch.detection.band_curve import band_curve, measurements_of_curve
from rsvib_torch.detection.grey_frames import grey_frames
from rsvib_torch.detection.reliability import judge
from rsvib_torch.detection.result import DetectionResult, OtherMotion, stacked
from rsvib_torch.detection.rows.direct import refine_directly
from rsvib_torch.detection.rows.displacements import MAX_GROUP_FRAMES, compared_intervals, stack_spectra
from rsvib_torch.detection.shapes.free import MotionDetection, detect_motion
from rsvib_torch.detection.shapes.swept import SweptTone, detect_swept_tone
from rsvib_torch.detection.tones.fit import MotionModel, ToneFit, model_displacements, vibration_of_fit
from rsvib_torch.detection.tones.selection import MAX_TONES, find_tones
from rsvib_torch.frames.arrays import ArrayLike
from rsvib_torch.frames.orientation import (
    offsets_from_row_order,
)
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import blind_frequencies
from rsvib_torch.registration import OffsetCurve, Registration, RegistrationOptions

__all__ = ["DetectionMethod", "VibrationDetector", "VibrationModel", "detect_vibration"]

DetectionMethod = Literal["direct", "bands"]
VibrationModel = Literal["tones", "free", "swept"]

_NEAR = 0.15  # px: rows as near as this to the start tell the rest themselves
_FEWEST_COLUMNS = 64  # px: bands of fewer are hardly found again


class _BandOptions(TypedDict, total=False):
    """Options that all models take, as in ``detect_vibration``."""

    registration: Registration
    band_rows: int
    band_step: int
    search: int
    ignore: ArrayLike | None
    full_scale: float | None


class _ToneOptions(_BandOptions, total=False):
    """Options of steady tones, as in ``detect_vibration``."""

    method: DetectionMethod
    tones: Literal["auto"] | int
    harmonics: int
    image_acceleration: bool
    columns: int | None
    window: int | None
    window_step: int | None


@dataclass(frozen=True)
class _Options:
    """Options of ``detect_vibration`` behind the door."""

    method: DetectionMethod
    tones: int | None
    model: MotionModel
    bands: RegistrationOptions


def _tones_of_bands(curve: OffsetCurve, timing: RowTiming, options: _Options, enough: float = 0.0) -> ToneFit:
    """A fit of tones to the offsets of row bands."""
    measurements = measurements_of_curve(curve, timing, options.bands.band_step)
    interval = options.bands.band_step * timing.row_time
    blind = blind_frequencies(timing, 0.5 / interval).to(curve.offsets.device)
    return find_tones(measurements, interval, options.tones, options.model, blind=blind, accuracy=enough)


def _detect_bands(
    curve: OffsetCurve, frames: Tensor, valid: Tensor | None, timing: RowTiming, options: _Options
) -> tuple[ToneFit, OtherMotion | None]:
    """The paper's method."""
    return _tones_of_bands(curve, timing, options), None


def _detect_direct(
    curve: OffsetCurve, frames: Tensor, valid: Tensor | None, timing: RowTiming, options: _Options
) -> tuple[ToneFit, OtherMotion | None]:
    """The bands' result, refined on the images themselves, row by row."""
    start = _tones_of_bands(curve, timing, options, _NEAR)
    found = refine_directly(stack_spectra(frames, valid), timing, start, options.tones)
    return found.fit, found.other_motion


_METHODS: dict[
    str,
    Callable[
        [OffsetCurve, Tensor, Tensor | None, RowTiming, _Options],
        tuple[ToneFit, OtherMotion | None],
    ],
] = {"direct": _detect_direct, "bands": _detect_bands}


_OTHER_MODELS: dict[str, Callable[..., MotionDetection | SweptTone]] = {
    "free": detect_motion,
    "swept": detect_swept_tone,
}
_DEFAULTS: dict[str, object] = {
    "method": "direct",
    "tones": "auto",
    "harmonics": 1,
    "image_acceleration": False,
    "columns": None,
    "window": None,
    "window_step": None,
}


@overload
def detect_vibration(
    frames: ArrayLike, timing: SensorTiming, *, model: Literal["tones"] = "tones", **options: Unpack[_ToneOptions]
) -> DetectionResult: ...
@overload
def detect_vibration(
    frames: ArrayLike, timing: SensorTiming, *, model: Literal["free"], **options: Unpack[_BandOptions]
) -> MotionDetection: ...
@overload
def detect_vibration(
    frames: ArrayLike, timing: SensorTiming, *, model: Literal["swept"], **options: Unpack[_BandOptions]
) -> SweptTone: ...
@outside_graphs
@full_precision
@torch.no_grad()
def detect_vibration(
    frames: ArrayLike,
    timing: SensorTiming,
    *,
    model: VibrationModel = "tones",
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
    columns: int | None = None,
    ignore: ArrayLike | None = None,
    full_scale: float | None = None,
) -> DetectionResult | MotionDetection | SweptTone:
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
        model: ``"tones"``: sinusoids and a uniform motion; ``"free"``: a motion of any shape; ``"swept"``: one tone an
            axis that decays or grows and sweeps. The last two take the options of ``registration`` to ``search``,
            ``ignore`` and ``full_scale``; ``detect_motion`` and ``detect_swept_tone`` have others of their own.
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
        columns: Look at so many neighbouring pixels of every row only, those with the most detail: every column shows
            the same vibration, and a quarter of them tells it in two thirds of the time, half as accurately. None for
            all.
        ignore: Bool, broadcastable to (..., H, W) of the frames: True for pixels to leave out (dead, saturated).
        full_scale: Count that means 1.0, for integer frames.

    Returns:
        The vibration in image axes (x, y) with standard deviations, verdict, and the curve it stands on: a
        ``DetectionResult``, or the ``MotionDetection`` of the free and the ``SweptTone`` of the swept model.

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
    check_choice("model", model, ("tones", *_OTHER_MODELS))
    if model != "tones":
        given: dict[str, object] = {"method": method, "tones": tones, "harmonics": harmonics}
        given |= {"image_acceleration": image_acceleration, "columns": columns}
        given |= {"window": window, "window_step": window_step}
        wrong = [name for name, value in given.items() if value != _DEFAULTS[name]]
        if wrong:
            raise ValueError(f"{wrong[0]}={given[wrong[0]]!r} goes with model='tones', not with model={model!r}")
        return _OTHER_MODELS[model](
            frames,
            timing,
            registration=registration,
            band_rows=band_rows,
            band_step=band_step,
            search=search,
            ignore=ignore,
            full_scale=full_scale,
        )
    check_choice("method", method, tuple(_METHODS))
    if tones != "auto":
        check_whole_number("tones", tones, at_least=1)
        if tones > MAX_TONES:
            raise ValueError(f"tones must be 'auto' or 1 to {MAX_TONES}, got {tones}")
    check_whole_number("harmonics", harmonics, at_least=1)
    if columns is not None:
        check_whole_number("columns", columns, at_least=_FEWEST_COLUMNS)
    stacks = grey_frames(frames, timing, full_scale, ignore)
    stacks = stacks if columns is None else stacks.narrowed(columns)
    grey, valid, batched = stacks.images, stacks.valid, stacks.batched
    bands = RegistrationOptions(registration, band_rows, band_step, search)
    options = _Options(
        method, None if tones == "auto" else tones, MotionModel(harmonics, 2 if image_acceleration else 1), bands
    )
    if window is None:
        result = _detect(grey, valid, timing, options)
        return result if batched else result[0]
    results = [
        _detect(grey[:, part], None if valid is None else valid[:, part], within, options)
        for part, within in _windows(grey.shape[1], window, window_step, timing)
    ]
    followed = stacked(results)
    return followed if batched else followed[0]


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
    curve = band_curve(frames, valid, in_rows, options.bands, mere_start=options.method != "bands")
    fit, other_motion = _METHODS[options.method](curve, frames, valid, in_rows, options)
    vibration, std = vibration_of_fit(fit)
    predicted = model_displacements(measurements_of_curve(curve, in_rows, options.bands.band_step), fit)
    fitted = (predicted[:, :, 1] - predicted[:, :, 0]).unflatten(1, curve.quality.shape[1:])
    difference = (curve.offsets - fitted).abs().nanmean(dim=(1, 2))

    # bands that an image motion has carried out of the later frame cannot be found there
    later = curve.rows + fitted[..., 1]
    shown = (later >= 0.5 * options.bands.band_rows) & (later <= frames.shape[-2] - 1 - 0.5 * options.bands.band_rows)
    duration = float(curve.later_times.max() - curve.times.min()) + options.bands.band_rows * timing.row_time
    largest = 2 if options.method == "bands" else MAX_GROUP_FRAMES
    intervals = compared_intervals(in_rows, frames.shape[1], largest, frames.device)
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
    in_image = vibration.from_row_order(timing)
    return DetectionResult(
        vibration=in_image,
        std=std.from_row_order(timing),
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


class VibrationDetector(nn.Module):
    """``detect_vibration`` with fixed timing and options as a module, for one stack or a batch of stacks.

    It has no weights. Autocast does not reach it, and ``torch.compile`` calls it as it is, at one break of the graph.

    Args:
        timing: The sensor.
        **options: Options of ``detect_vibration`` for steady tones.

    Raises:
        ValueError: If another model is asked for.
    """

    def __init__(self, timing: SensorTiming, **options: object) -> None:
        super().__init__()
        if options.get("model", "tones") != "tones":
            raise ValueError(f"a VibrationDetector finds steady tones; model={options['model']!r} is a function's")
        self.timing = timing
        self.options = options

    def forward(self, frames: Tensor) -> DetectionResult:
        """Detect the vibration in a stack of frames."""
        found: DetectionResult = detect_vibration(frames, self.timing, **self.options)  # type: ignore[call-overload]
        return found
