"""``detect_vibration``: entry point of detection, with the tables of models and methods.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Unpack, overload

import torch
from torch import Tensor, nn

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.checks import check_choice, check_whole_number
from rsvib_torch.core.option_types import BandSettings, DetectionMethod, Registration, ToneSettings
from rsvib_torch.core.precision import full_precision, outside_graphs
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.reliability import judge
from rsvib_torch.detection.result import DetectionResult, OtherMotion, stacked
from rsvib_torch.detection.rows.direct import refine_directly
from rsvib_torch.detection.rows.displacements import MAX_GROUP_FRAMES, compared_intervals, stack_spectra
from rsvib_torch.detection.sensitivity import assumptions, timing_sensitivity
from rsvib_torch.detection.shapes.free import MotionDetection, detect_motion
from rsvib_torch.detection.shapes.swept import SweptTone, detect_swept_tone
from rsvib_torch.detection.start import band_curve, grey_frames, measurements_of_curve
from rsvib_torch.detection.tones.fit import (
    MotionModel,
    ToneFit,
    displacement_std,
    model_displacements,
    residual_of,
    vibration_of_fit,
)
from rsvib_torch.detection.tones.further import with_further_tones
from rsvib_torch.detection.tones.selection import MAX_TONES, find_tones
from rsvib_torch.frames.arrays import ArrayLike, Channels
from rsvib_torch.frames.orientation import offsets_from_row_order
from rsvib_torch.io.files import FramesOrFiles
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration, blind_frequencies
from rsvib_torch.registration import OffsetCurve, RegistrationOptions

__all__ = ["DetectionMethod", "VibrationDetector", "VibrationModel", "detect_vibration"]

VibrationModel = Literal["tones", "free", "swept"]


MAX_HARMONICS = 50  # the sensors of the paper sample a tone of 100 Hz up to its 120th harmonic


class BandOptions(BandSettings, total=False):
    """Options of all models, see ``detect_vibration``."""

    ignore: ArrayLike | None
    full_scale: float | None
    channels: Channels


class ToneOptions(BandOptions, ToneSettings, total=False):
    """Options of the model of tones, see ``detect_vibration``."""

    window: int | None
    window_step: int | None


# Methods: how tones are fitted


@dataclass(frozen=True)
class _FitOptions:
    """Options of a method.

    Attributes:
        tones: Number of tones of each axis; None to select it by significance.
        model: Harmonics and order of the image motion.
        bands: Registration of the row bands.
    """

    tones: int | None
    model: MotionModel
    bands: RegistrationOptions


@dataclass(frozen=True, eq=False)
class _Found:
    """Result of a method.

    Attributes:
        fit: The fit of all B stacks, with the covariance of its parameters.
        measurements: The measurements with the weights of the fit.
        offsets: The same as offsets between consecutive frames.
        fitted: (B, P, N, 2) px, the offsets that it predicts for them.
        other_motion: Motion that it does not explain; None if the method does not measure it.
    """

    fit: ToneFit
    measurements: Measurements
    offsets: OffsetCurve
    fitted: Tensor
    other_motion: OtherMotion | None = None


_Fit = Callable[[OffsetCurve, Tensor, Tensor | None, RowTiming, _FitOptions], _Found]


@dataclass(frozen=True)
class _Method:
    """A method of detection: ``fit(curve, frames, valid, timing, options)`` -> result.

    The arguments of ``fit`` are the offset curve (B, P, N) in px with NaN where a band could not be registered, the
    grey frames (B, T, H, W) in row order, their valid pixels (bool of that shape, or None for all), the sensor in row
    order, and the options. Stacks of a batch must not affect each other.

    Attributes:
        fit: The function.
        max_group_frames: Number of frames that are compared with each other; it decides which tones have a gain.
        needs_whole_curve: Whether the accuracy depends on the offset curve, or the curve is only a start.
    """

    fit: _Fit
    max_group_frames: int
    needs_whole_curve: bool


def _fit_bands(
    curve: OffsetCurve,
    frames: Tensor,
    valid: Tensor | None,
    timing: RowTiming,
    options: _FitOptions,
    accuracy: float = 0.0,
) -> _Found:
    """The paper's method: tones are fitted to the offsets of row bands."""
    measurements = measurements_of_curve(curve, timing, options.bands.band_step)
    interval = options.bands.band_step * timing.row_time
    blind = blind_frequencies(timing, 0.5 / interval).to(curve.offsets.device)
    fit = find_tones(measurements, interval, options.tones, options.model, blind=blind, accuracy=accuracy)
    weighted = measurements.reweighted(residual_of(measurements, fit))
    return _Found(fit, weighted, curve, _band_offsets(curve, fit, timing, options))


def _band_offsets(curve: OffsetCurve, fit: ToneFit, timing: RowTiming, options: _FitOptions) -> Tensor:
    """Offsets (B, P, N, 2) in px of row bands that a fit predicts."""
    predicted = model_displacements(measurements_of_curve(curve, timing, options.bands.band_step), fit)
    offsets: Tensor = (predicted[:, :, 1] - predicted[:, :, 0]).unflatten(1, curve.quality.shape[1:])
    return offsets


def _fit_direct(
    curve: OffsetCurve, frames: Tensor, valid: Tensor | None, timing: RowTiming, options: _FitOptions
) -> _Found:
    """The fit to bands, refined on the images."""
    # px; the gradients of rows reach a few tenths of a pixel, so that a start with this error converges
    start = _fit_bands(curve, frames, valid, timing, options, accuracy=0.15).fit
    found, offsets, fitted = refine_directly(stack_spectra(frames, valid), timing, start, options.tones)
    return _Found(found.fit, found.measurements, offsets, fitted, found.other_motion)


_METHODS: dict[DetectionMethod, _Method] = {
    "direct": _Method(_fit_direct, MAX_GROUP_FRAMES, needs_whole_curve=False),
    "bands": _Method(_fit_bands, 2, needs_whole_curve=True),
}


# Models: what is fitted

# A model is a function ``model(frames, timing, **options)`` of the user's frames and timing. All models take
# ``BandOptions``. The result is in image axes and has ``reliable`` (..., 2) bool, ``reasons`` for each axis, and a
# motion that ``restore`` accepts. "tones" also takes ``ToneOptions`` and is implemented by ``detect_vibration``.
_OTHER_MODELS: dict[str, Callable[..., MotionDetection | SweptTone]] = {
    "free": detect_motion,
    "swept": detect_swept_tone,
}


@overload
def detect_vibration(
    frames: FramesOrFiles, timing: SensorTiming, *, model: Literal["tones"] = "tones", **options: Unpack[ToneOptions]
) -> DetectionResult: ...
@overload
def detect_vibration(
    frames: FramesOrFiles, timing: SensorTiming, *, model: Literal["free"], **options: Unpack[BandOptions]
) -> MotionDetection: ...
@overload
def detect_vibration(
    frames: FramesOrFiles, timing: SensorTiming, *, model: Literal["swept"], **options: Unpack[BandOptions]
) -> SweptTone: ...
@outside_graphs
@full_precision
@torch.no_grad()
@checks_arguments
def detect_vibration(
    frames: FramesOrFiles,
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
    channels: Channels = None,
) -> DetectionResult | MotionDetection | SweptTone:
    """Detect the vibration of the camera from consecutive frames (Sec. 2 of Liu et al. 2023).

    Row bands are registered between frames, and sinusoids and a uniform motion (Eq. 5) are fitted to the offset curve.
    Gain, exposure, band average and coupling with the scan are part of the model (Eqs. 4, 6-8); no initial guess is
    needed. The direct method then warps the frames to the scene by this motion, measures the residual displacement of
    every row, and fits again: all frames of a stack together, down to the noise. No gradient flows through the result.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) of at least two frames, floating point, or
            integers of known full scale: a tensor, an array, a list of these, or a path or list of paths of files,
            which are read as by ``read_stack``. NaN marks missing pixels.
        timing: The sensor. Frame start times at unequal intervals (dropped frames) remove blind frequencies.
        model: ``"tones"``: sinusoids and a uniform motion; ``"free"``: a motion of any shape; ``"swept"``: one tone per
            axis whose amplitude decays or grows and whose frequency sweeps. The last two take the options from
            ``registration`` to ``search``, ``ignore``, ``full_scale`` and ``channels``; ``detect_motion`` and
            ``detect_swept_tone`` have further ones.
        method: ``"direct"``, or ``"bands"`` (the paper's method), in half the time with ten times larger errors.
        registration: Method of the band registration, as in ``register_bands``.
        tones: Number of tones of each axis, 1 to 4, or ``"auto"`` to select it by significance; the standard deviations
            then allow for a further tone.
        harmonics: Number of multiples of every tone, with one common base frequency; 1 for independent tones.
        image_acceleration: Whether the image motion has a constant acceleration.
        window: Number of frames of one result: the vibration is followed through the stack, and the result is a batch
            with one entry per window (a leading dimension behind B). None for one result from all frames.
        window_step: Frames from one window to the next; half a window by default.
        band_rows: Rows of a band.
        band_step: Rows from one band to the next.
        search: Search range in px around the whole-frame offset.
        columns: Use only this number of neighbouring columns, those with the most detail: all columns contain the same
            vibration, and a quarter of them takes two thirds of the time for half the accuracy. None for all.
        ignore: Bool, broadcastable to (..., H, W) of the frames: True for missing pixels (dead, saturated).
        full_scale: Count that means 1.0, for integer frames.
        channels: ``"last"`` for frames (T, H, W, C) or (B, T, H, W, C). By default channels come before the image axes,
            and frames that appear to have them last are refused; ``"first"`` omits this check.

    Returns:
        The vibration in image axes (x, y) with standard deviations, a verdict for each axis, and the offset curve: a
        ``DetectionResult``, or the ``MotionDetection`` of the free and the ``SweptTone`` of the swept model.

    Raises:
        TypeError: If frames are not numbers.
        ValueError: If there are fewer than two frames, a frame is constant or has too many missing pixels, or an option
            is out of range.

    Example:
        >>> timing = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
        >>> detect_vibration(torch.rand(1, 256, 256), timing)
        Traceback (most recent call last):
        ...
        ValueError: at least 2 frames are needed, got 1
    """
    check_choice("model", model, ("tones", *_OTHER_MODELS))
    if model != "tones":
        tone_options = (
            ("method", method, "direct"),
            ("tones", tones, "auto"),
            ("harmonics", harmonics, 1),
            ("image_acceleration", image_acceleration, False),
            ("columns", columns, None),
            ("window", window, None),
            ("window_step", window_step, None),
        )
        for name, value, default in tone_options:
            if value != default:
                valid = ", ".join(sorted(BandOptions.__optional_keys__))
                raise ValueError(
                    f"{name}={value!r} goes with model='tones', not with model={model!r}, which takes {valid}"
                )
        return _OTHER_MODELS[model](
            frames,
            timing,
            registration=registration,
            band_rows=band_rows,
            band_step=band_step,
            search=search,
            ignore=ignore,
            full_scale=full_scale,
            channels=channels,
        )
    check_choice("method", method, tuple(_METHODS))
    if tones != "auto":
        check_whole_number("tones", tones, at_least=1)
        if tones > MAX_TONES:
            raise ValueError(f"tones must be 'auto' or 1 to {MAX_TONES}, got {tones}")
    check_whole_number("harmonics", harmonics, at_least=1, at_most=MAX_HARMONICS)
    if columns is not None:
        check_whole_number("columns", columns, at_least=64)  # px; narrower bands are often registered wrongly
    bands = RegistrationOptions(registration, band_rows, band_step, search)
    options = _FitOptions(
        None if tones == "auto" else tones, MotionModel(harmonics, 2 if image_acceleration else 1), bands
    )
    stacks = grey_frames(frames, timing, full_scale, ignore, channels)
    if columns is not None:
        stacks = stacks.narrowed(columns)
    grey, valid_pixels = stacks.images, stacks.valid
    if window is None:
        found = _detect(grey, valid_pixels, timing, _METHODS[method], options)
    else:
        found = stacked(
            [
                _detect(
                    grey[:, part],
                    None if valid_pixels is None else valid_pixels[:, part],
                    window_timing,
                    _METHODS[method],
                    options,
                )
                for part, window_timing in _windows(grey.shape[1], window, window_step, timing)
            ]
        )
    found = replace(found, timing=timing)  # of the stack, not of a window
    return found if stacks.batched else found[0]


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


def _detect(
    frames: Tensor, valid: Tensor | None, timing: SensorTiming, method: _Method, options: _FitOptions
) -> DetectionResult:
    """``detect_vibration`` of grey frames (B, T, H, W) in row order; the result is a batch in image axes."""
    row_timing, bands = timing.in_row_order(), options.bands
    curve = band_curve(frames, valid, row_timing, bands, mere_start=not method.needs_whole_curve)
    found = method.fit(curve, frames, valid, row_timing, options)
    fit, other_motion, measured = found.fit, found.other_motion, found.offsets
    starts = row_timing.frame_starts(frames.shape[1], frames.device)[:, None]
    starts = (
        starts + torch.arange(frames.shape[-2], dtype=torch.float64, device=frames.device)[::8] * row_timing.row_time
    ).flatten()
    own_std = displacement_std(fit, starts, row_timing.exposure_time)
    fit, total_std = with_further_tones(found.measurements, fit, starts, number_is_known=options.tones is not None)
    vibration, std = vibration_of_fit(fit)
    std = replace(std, displacement=total_std)
    tones = Vibration(vibration.amplitude, vibration.frequency, vibration.phase)
    moved = tones.mean_displacement(starts.expand(len(frames), -1), row_timing.exposure_time)
    residual = (measured.offsets - found.fitted).abs().nanmean(dim=(1, 2))

    fitted = _band_offsets(curve, fit, row_timing, options)
    # an image motion may carry bands out of the later frame
    later = curve.rows + fitted[..., 1]
    visible = (later >= 0.5 * bands.band_rows) & (later <= frames.shape[-2] - 1 - 0.5 * bands.band_rows)
    intervals = compared_intervals(row_timing, frames.shape[1], method.max_group_frames, frames.device)
    verdicts = [
        judge(
            vibration[index],
            std[index],
            offsets=curve.offsets[index].flatten(0, 1),
            fitted=fitted[index].flatten(0, 1),
            visible=visible[index].flatten(),
            intervals=intervals,
            displacement=moved[index].std(0, correction=0),
            own_std=own_std[index],
            timing=row_timing,
            other_motion=None if other_motion is None else other_motion[index],
            max_tones=MAX_TONES if options.tones is None and options.model.harmonics == 1 else math.inf,
        )
        for index in range(len(frames))
    ]
    reliable = torch.stack([verdict[0] for verdict in verdicts])
    swap = timing.scan_axis == -1
    in_image = vibration.from_row_order(timing)
    sensitivity = timing_sensitivity(fit, row_timing, frames.shape[1], frames.shape[-2])
    sensitivity = sensitivity.flip(-2) if swap else sensitivity
    return DetectionResult(
        vibration=in_image,
        std=std.from_row_order(timing),
        offsets=replace(
            measured,
            offsets=offsets_from_row_order(measured.offsets, timing),
            std=measured.std if measured.std is None or not swap else measured.std.flip(-1),
            heights=(measured.heights[1], measured.heights[0]) if swap else measured.heights,
        ),
        fitted=offsets_from_row_order(found.fitted, timing),
        gain=in_image.gain(float(intervals[0])),
        residual=residual.flip(-1) if swap else residual,
        reliable=reliable.flip(-1) if swap else reliable,
        reasons=tuple((reasons[1], reasons[0]) if swap else reasons for _, reasons in verdicts),
        sensitivity=sensitivity,
        assumptions=tuple(
            assumptions(in_image[index], sensitivity[index], row_timing, frames.shape[1])
            for index in range(len(frames))
        ),
        timing=timing,
    )


class VibrationDetector(nn.Module):
    """``detect_vibration`` with fixed timing and options as a module, for one stack or a batch of stacks.

    It has no weights. Autocast does not affect it, and ``torch.compile`` calls it uncompiled, at one graph break.

    Args:
        timing: The sensor.
        model: Only ``"tones"``.
        **options: Options of ``detect_vibration`` for tones.

    Raises:
        TypeError: If an option is unknown.
        ValueError: If another model is given.

    Example:
        >>> detector = VibrationDetector(SensorTiming(20.52e-6, 20, 2048), method="bands", tones=1)
        >>> detector.options
        {'method': 'bands', 'tones': 1}
    """

    @checks_arguments
    def __init__(
        self, timing: SensorTiming, *, model: Literal["tones"] = "tones", **options: Unpack[ToneOptions]
    ) -> None:
        super().__init__()
        if model != "tones":
            raise ValueError(f"a VibrationDetector finds steady tones; for model={model!r} call detect_vibration")
        unknown = sorted(set(options) - ToneOptions.__optional_keys__)
        if unknown:
            valid = ", ".join(sorted(ToneOptions.__optional_keys__))
            raise TypeError(f"unknown option {unknown[0]!r} of VibrationDetector; the options are {valid}")
        self.timing = timing
        self.options = options

    @checks_arguments
    def forward(self, frames: FramesOrFiles) -> DetectionResult:
        """Detect the vibration in a stack of frames."""
        return detect_vibration(frames, self.timing, **self.options)
