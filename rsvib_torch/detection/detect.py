"""``detect_vibration``: entry point of detection, with the tables of models and methods.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Literal, Unpack, overload

import torch
from torch import Tensor, nn

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.arrays import ArrayLike, Channels
from rsvib_torch.core.checks import check_choice, check_whole_number
from rsvib_torch.core.option_types import BandSettings, DetectionMethod, Registration, ToneSettings
from rsvib_torch.core.precision import full_precision, outside_graphs, without_gradients
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.other_timing import period_factor
from rsvib_torch.detection.reliability import contradicted_axes, judge, rotation_found, rotation_possible
from rsvib_torch.detection.result import DetectionResult, stacked
from rsvib_torch.detection.rows.direct import AbandonedError, DirectFit, refine_directly
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS, MAX_GROUP_FRAMES, compared_intervals
from rsvib_torch.detection.rows.measured_rows import strip_rows, whole_rows
from rsvib_torch.detection.sensitivity import assumptions, timing_sensitivity
from rsvib_torch.detection.shapes.free import MotionDetection, detect_motion
from rsvib_torch.detection.shapes.swept import SweptTone, detect_swept_tone
from rsvib_torch.detection.start import BandStart, band_start, field_start
from rsvib_torch.detection.strips import FieldScale, camera_in_row_order
from rsvib_torch.detection.tones.aliasing import without_aliasing
from rsvib_torch.detection.tones.fit import (
    MotionModel,
    ToneFit,
    displacement_std,
    model_displacements,
    residual_of,
    shrunk_motion,
    vibration_of_fit,
    with_unknown_errors,
)
from rsvib_torch.detection.tones.further import with_further_tones
from rsvib_torch.detection.tones.selection import MAX_TONES, MIN_SIGNIFICANCE, find_tones, robust_fit
from rsvib_torch.frames.grey import grey_frames
from rsvib_torch.frames.orientation import offsets_from_row_order
from rsvib_torch.io.stack_reading import FramesOrFiles
from rsvib_torch.motion.camera import Camera
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
        scale: Components of the motion.
        is_trial: Whether roll and zoom are assumed only because the halves of the rows move apart, or another timing
            than the stated one is tried.
        has_pattern: Whether the frames have a pattern of columns; None if it is not known.
    """

    tones: int | None
    model: MotionModel
    bands: RegistrationOptions
    scale: FieldScale
    is_trial: bool = False
    has_pattern: bool | None = None


@dataclass(frozen=True, eq=False)
class _Found:
    """Result of a method.

    Attributes:
        fit: The fit of all B stacks, with the covariance of its parameters.
        measurements: The measurements with the weights of the fit.
        offsets: The same as offsets between consecutive frames.
        fitted: (B, P, N, 2) px, the offsets that it predicts for them.
        direct: The complete result of the direct method; None for bands.
    """

    fit: ToneFit
    measurements: Measurements
    offsets: OffsetCurve
    fitted: Tensor
    direct: DirectFit | None = None


_Fit = Callable[[BandStart, Tensor, Tensor | None, RowTiming, _FitOptions], _Found]


@dataclass(frozen=True)
class _Method:
    """A method of detection: ``fit(start, frames, valid, timing, options)`` -> result.

    The arguments of ``fit`` are the offset curve (B, P, N) of row bands with its measurements, the grey frames
    (B, T, H, W) in row order, their valid pixels (bool of that shape, or None for all), the sensor in row order, and
    the options. Stacks of a batch must not affect each other.

    Attributes:
        fit: The function.
        max_group_frames: Number of frames that are compared with each other; it decides which tones have a gain.
        needs_whole_curve: Whether the accuracy depends on the offset curve, or the curve is only a start.
    """

    fit: _Fit
    max_group_frames: int
    needs_whole_curve: bool


def _fit_bands(
    start: BandStart,
    frames: Tensor,
    valid: Tensor | None,
    timing: RowTiming,
    options: _FitOptions,
    accuracy: float = 0.0,
) -> _Found:
    """The paper's method: tones are fitted to the offsets of row bands."""
    measurements = start.measurements
    interval = options.bands.band_step * timing.row_time
    blind = blind_frequencies(timing, 0.5 / interval).to(frames.device)
    fit = find_tones(
        measurements, interval, options.tones, options.model, start=start.fit, blind=blind, accuracy=accuracy
    )
    weighted = measurements.reweighted(residual_of(measurements, fit))
    return _Found(fit, weighted, start.curve, _band_offsets(start, fit))


def _band_offsets(start: BandStart, fit: ToneFit) -> Tensor:
    """Offsets (B, P, N, A) in px of row bands that a fit predicts."""
    predicted = model_displacements(start.measurements, fit)
    offsets: Tensor = (predicted[:, :, 1] - predicted[:, :, 0]).unflatten(1, start.curve.quality.shape[1:])
    return offsets


def _fit_direct(
    start: BandStart, frames: Tensor, valid: Tensor | None, timing: RowTiming, options: _FitOptions
) -> _Found:
    """The fit to bands, refined on the images."""
    # px; the gradients of rows reach a few tenths of a pixel, so that a start with this error converges
    fit = _fit_bands(start, frames, valid, timing, options, accuracy=0.15).fit
    intervals = compared_intervals(timing, frames.shape[1], MAX_GROUP_FRAMES, frames.device)
    motion, scale = shrunk_motion(fit, intervals), options.scale
    if scale.same_for_all_columns:
        rows = whole_rows(frames, valid, timing, motion)
    else:  # equal blur takes several times as long, and is not needed to find that there is no roll
        rows = strip_rows(frames, valid, timing, motion, scale, pairs_if_blurred_differently=not options.is_trial)
    found, offsets, fitted = refine_directly(
        rows, intervals, fit, options.tones, is_trial=options.is_trial, has_pattern=options.has_pattern
    )
    motion = shrunk_motion(found.fit, intervals)
    if options.is_trial and not scale.same_for_all_columns and rows.differently_blurred(motion):
        rows = strip_rows(frames, valid, timing, motion, scale)
        found, offsets, fitted = refine_directly(
            rows, intervals, found.fit, options.tones, has_pattern=options.has_pattern
        )
    return _Found(found.fit, found.measurements, offsets, fitted, found)


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
@without_gradients
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
    roll: bool | Literal["auto"] = "auto",
    zoom: bool | Literal["auto"] = "auto",
    focal_length: float | None = None,
    principal_point: tuple[float, float] | None = None,
    distortion: tuple[float, float, float, float, float] | None = None,
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
        timing: The sensor. Frame start times at unequal intervals (dropped frames) remove blind frequencies. If frames
            is a path, the frame times in the file are used.
        model: ``"tones"``: sinusoids and a uniform motion; ``"free"``: a motion of any shape; ``"swept"``: one tone per
            axis whose amplitude decays or grows and whose frequency sweeps. The last two take the options from
            ``registration`` to ``search``, ``ignore``, ``full_scale`` and ``channels``; ``detect_motion`` and
            ``detect_swept_tone`` have further ones. ``"free"`` also measures ``roll`` and ``zoom``, if they are True.
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
        roll: Measure the rotation about the optical axis as a third component of the motion, in rad: True, False, or
            ``"auto"``: if the halves of the rows move apart, and not with ``columns``. Results then have three axes
            instead of two, see ``Vibration``.
        zoom: The same for the change of scale, as a fourth component; includes roll.
        focal_length: Focal length in px, for a motion that is a rotation of the camera: displacements then follow from
            the projection (see ``Camera``), which matters for fields of view above about 20 degrees, and the result
            has an ``attitude``. None: the displacement by translation is the same in the whole frame.
        principal_point: px along x and y from the centre of the first pixel, as in OpenCV; by default the centre of the
            frame.
        distortion: Lens distortion (k1, k2, p1, p2, k3) as in OpenCV; by default none.

    Returns:
        The vibration in image axes (x, y) with standard deviations, a verdict for each axis, and the offset curve: a
        ``DetectionResult``, or the ``MotionDetection`` of the free and the ``SweptTone`` of the swept model.

    Warns:
        TimingWarning: If frames is a path, and the file states another frame rate than the sensor has.

    Raises:
        TypeError: If frames are not numbers.
        ValueError: If there are fewer than two frames, a frame is constant or has too many missing pixels, or an option
            is out of range.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=2)
        >>> detection = rsv.detect_vibration(frames, timing)
        >>> detection.vibration.amplitude[:, 0].round(decimals=2).tolist()  # px along x and y
        [2.1, 1.6]
        >>> detection.vibration.frequency[:, 0].round(decimals=1).tolist()  # Hz
        [110.0, 90.0]
        >>> detection.reliable.tolist(), detection.reasons
        ([True, True], ((), ()))

        Near a blind frequency (here 83.3 Hz, the frame rate) the axis is refused, with the reason:

        >>> blind = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 83.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, blind, num_frames=2)
        >>> detection = rsv.detect_vibration(frames, timing)
        >>> detection.reliable.tolist()
        [True, False]
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
            **_options_of_field(
                model,
                roll=roll is True or None,  # "auto": not measured unless requested
                zoom=zoom is True or None,
                focal_length=focal_length,
                principal_point=principal_point,
                distortion=distortion,
            ),
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
    stacks = grey_frames(frames, timing, full_scale, ignore, channels)
    timing = stacks.timing
    height, width = stacks.images.shape[-2:]
    camera = camera_in_row_order(focal_length, principal_point, distortion, (height, width), timing)
    field = _Field.of(roll, zoom, columns, width, height, camera)
    model_of_tones = MotionModel(harmonics, 2 if image_acceleration else 1)
    options = _FitOptions(None if tones == "auto" else tones, model_of_tones, bands, field.scale(2))
    if columns is not None:
        stacks = stacks.narrowed(columns)
    grey, valid_pixels = stacks.images, stacks.valid
    if window is None:
        found = _detect_field(grey, valid_pixels, timing, _METHODS[method], options, field, find_cause=True)
    else:
        windows = _windows(grey.shape[1], window, window_step, timing)
        found = _detect_windows(grey, valid_pixels, windows, _METHODS[method], options, field)
    found = replace(found, timing=timing)  # of the stack, not of a window
    return found if stacks.batched else found[0]


def _options_of_field(model: str, **options: object) -> dict[str, object]:
    """Options of roll, zoom and camera that were given for another model than tones."""
    given = {name: value for name, value in options.items() if value is not None}
    if given and model == "swept":
        name, value = next(iter(given.items()))
        raise ValueError(f"{name}={value!r} goes with model='tones' or 'free', not with model='swept'")
    return given


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


def _detect_windows(
    frames: Tensor,
    valid: Tensor | None,
    windows: list[tuple[slice, SensorTiming]],
    method: "_Method",
    options: _FitOptions,
    field: "_Field",
) -> DetectionResult:
    """Results of all windows, with the same axes."""

    def of_window(number: int, field: _Field) -> DetectionResult:
        part, timing = windows[number]
        of_pixels = None if valid is None else valid[:, part]
        return _detect_field(frames[:, part], of_pixels, timing, method, options, field)

    each = [of_window(number, field) for number in range(len(windows))]
    axes = max(one.vibration.num_axes for one in each)
    if axes > 2:
        same = replace(field, roll=True, zoom=axes > 3)
        each = [one if one.vibration.num_axes == axes else of_window(i, same) for i, one in enumerate(each)]
    return stacked(each)


@dataclass(frozen=True)
class _Field:
    """Whether roll and zoom are measured (True, False or ``"auto"``), the size of the frames, and the camera."""

    roll: bool | Literal["auto"]
    zoom: bool | Literal["auto"]
    width: int
    height: int
    camera: Camera | None

    @classmethod
    def of(
        cls,
        roll: bool | Literal["auto"],
        zoom: bool | Literal["auto"],
        columns: int | None,
        width: int,
        height: int,
        camera: Camera | None,
    ) -> "_Field":
        """The field of checked options; of a part of the columns, roll and zoom are not measured."""
        for name, value in (("roll", roll), ("zoom", zoom)):
            if value not in (True, False, "auto"):
                raise ValueError(f"{name} must be True, False or 'auto', got {value!r}")
        if columns is not None and (camera is not None or roll is True or zoom is True):
            raise ValueError(
                f"columns={columns} goes with roll=False, zoom=False and focal_length=None: roll, zoom and perspective "
                "are measured from all columns"
            )
        return cls(columns is None and roll, columns is None and zoom, width, height, camera)

    def scale(self, axes: int, camera: Camera | None = None) -> FieldScale:
        """Lengths for a motion of so many components."""
        return FieldScale(axes, self.width, self.height, camera)

    @property
    def most_axes(self) -> int:
        """Number of components, if roll and zoom are found."""
        return 4 if self.zoom else 3 if self.roll else 2

    @property
    def least_axes(self) -> int:
        """Number of components that were requested."""
        return 4 if self.zoom is True else 3 if self.roll is True else 2


def _detect_field(
    frames: Tensor,
    valid: Tensor | None,
    timing: SensorTiming,
    method: _Method,
    options: _FitOptions,
    field: _Field,
    *,
    find_cause: bool = False,
) -> DetectionResult:
    """``_detect`` with as many components as were requested or, with ``"auto"``, as the frames require."""
    alike = _detect(frames, valid, timing, method, options)
    if field.camera is not None or field.least_axes > 2 or (field.most_axes > 2 and any(alike.rolls)):
        scale = field.scale(field.most_axes, field.camera)
        uncertain = field.camera is None and field.least_axes == 2
        assumed = replace(options, scale=scale, is_trial=uncertain, has_pattern=alike.has_pattern)
        try:
            found = _detect(frames, valid, timing, method, assumed, alike.fit).result
        except (AbandonedError, ValueError):  # parallax; narrow frames, and fits that diverge
            if not uncertain:
                raise
            return _with_cause(alike, frames, valid, timing, method, options) if find_cause else alike.result
        # a given number of tones is fitted to all axes, also to those that do not move
        significant = found.vibration.amplitude > MIN_SIGNIFICANCE * found.std.amplitude
        moving = significant.flatten(0, -3).any(0).any(-1).tolist()
        axes = max([field.least_axes, *(axis + 1 for axis in range(2, len(moving)) if moving[axis])])
        if axes > 2 or field.camera is not None:
            return found.with_axes(axes)
    return _with_cause(alike, frames, valid, timing, method, options) if find_cause else alike.result


@dataclass(frozen=True, eq=False)
class _Detected:
    """Result of ``_detect``.

    Attributes:
        result: A batch of results in image axes.
        fit: Its fit.
        measurements: The measurements of the fit.
        rotates: For each stack, whether the halves of its rows move apart.
        rolls: For each stack, whether roll or zoom may be the cause.
        contradicted: For each stack, the axes in row order whose measurements contradict the timing.
        bands: Offsets of the row bands.
        has_pattern: Whether a pattern of columns was subtracted.
    """

    result: DetectionResult
    fit: ToneFit
    measurements: Measurements
    rotates: list[bool]
    rolls: list[bool]
    contradicted: list[tuple[bool, bool]]
    bands: OffsetCurve
    has_pattern: bool


def _detect(
    frames: Tensor,
    valid: Tensor | None,
    timing: SensorTiming,
    method: _Method,
    options: _FitOptions,
    translation: ToneFit | None = None,
    bands_known: OffsetCurve | None = None,
    frequencies: Tensor | None = None,
) -> _Detected:
    """``detect_vibration`` of grey frames (B, T, H, W) in row order.

    Args:
        frames: The frames.
        valid: Their valid pixels, or None for all.
        timing: The sensor.
        method: How tones are fitted.
        options: Its options.
        translation: Fit without roll and zoom, from which a fit with roll or zoom starts.
        bands_known: Offsets of the row bands, if they were measured with another timing.
        frequencies: (B, 2, 1) Hz of one tone of each axis, if they are known.

    Raises:
        AbandonedError: If the options are a trial, and the motion is another one.
    """
    row_timing, bands, scale = timing.in_row_order(), options.bands, options.scale
    if scale.same_for_all_columns:
        start = band_start(frames, valid, row_timing, bands, mere_start=not method.needs_whole_curve, known=bands_known)
        if frequencies is not None:
            active = torch.ones_like(frequencies, dtype=torch.bool)
            start = replace(start, fit=robust_fit(start.measurements, frequencies, active, options.model)[0])
    else:
        start = field_start(frames, valid, row_timing, bands, scale, translation)
    found = method.fit(start, frames, valid, row_timing, options)
    direct, measured = found.direct, found.offsets
    starts = row_timing.frame_starts(frames.shape[1], frames.device)[:, None]
    starts = (
        starts + torch.arange(frames.shape[-2], dtype=torch.float64, device=frames.device)[::8] * row_timing.row_time
    ).flatten()
    fit = found.fit
    if direct is None:
        fit = with_unknown_errors(found.measurements, fit)
    else:
        fit = without_aliasing(found.measurements, fit, direct.aliasing)
    own_std = displacement_std(fit, starts, row_timing.exposure_time)
    fit, total_std = with_further_tones(found.measurements, fit, starts, number_is_known=options.tones is not None)
    vibration, std = vibration_of_fit(fit)
    std = replace(std, displacement=total_std)
    tones = Vibration(vibration.amplitude, vibration.frequency, vibration.phase)
    moved = tones.mean_displacement(starts.expand(len(frames), -1), row_timing.exposure_time)
    residual = (measured.offsets - found.fitted).abs().nanmean(dim=(1, 2))

    curve, fitted = start.curve, _band_offsets(start, fit)
    # an image motion may carry bands out of the later frame
    later = curve.rows + fitted[..., 1]
    visible = (later >= 0.5 * bands.band_rows) & (later <= frames.shape[-2] - 1 - 0.5 * bands.band_rows)
    intervals = compared_intervals(row_timing, frames.shape[1], method.max_group_frames, frames.device)
    max_tones = MAX_TONES if options.tones is None and options.model.harmonics == 1 else math.inf
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
            other_motion=None if direct is None else direct.other_motion[index],
            max_tones=max_tones,
            radius=scale.radius,
        )
        for index in range(len(frames))
    ]
    rotates, rolls, contradicted = [False] * len(frames), [False] * len(frames), [(False, False)] * len(frames)
    if direct is not None:
        aspect = frames.shape[-2] / frames.shape[-1]
        others = [direct.other_motion[index] for index in range(len(frames))]
        rolls = [rotation_possible(other, uneven, aspect) for other, uneven in zip(others, direct.uneven, strict=True)]
        rotates = [rotation_found(other) for other in others]
        contradicted = [contradicted_axes(vibration[index], other, max_tones) for index, other in enumerate(others)]
    reliable = torch.stack([verdict[0] for verdict in verdicts])
    swap = timing.scan_axis == -1
    order = ([1, 0, 2, 3] if swap else [0, 1, 2, 3])[: scale.axes]
    units = scale.units(residual)
    in_image = scale.motion(vibration).from_row_order(timing)
    sensitivity = timing_sensitivity(fit, row_timing, frames.shape[1], frames.shape[-2])
    sensitivity = sensitivity.mapped(lambda values: values[..., order, :])
    result = DetectionResult(
        vibration=in_image,
        std=scale.std(std).from_row_order(timing),
        offsets=replace(
            measured,
            offsets=offsets_from_row_order(measured.offsets * units, timing),
            std=None if measured.std is None else (measured.std * units)[..., order],
            heights=(measured.heights[1], measured.heights[0]) if swap else measured.heights,
        ),
        fitted=offsets_from_row_order(found.fitted * units, timing),
        gain=in_image.gain(float(intervals[0])),
        residual=(residual * units)[..., order],
        reliable=reliable[..., order],
        reasons=tuple(tuple(reasons[axis] for axis in order) for _, reasons in verdicts),
        sensitivity=sensitivity,
        assumptions=tuple(
            assumptions(in_image[index], sensitivity[index], row_timing, frames.shape[1], frames.shape[-2])
            for index in range(len(frames))
        ),
        timing=timing,
    )
    has_pattern = direct is not None and direct.has_pattern
    return _Detected(result, fit, found.measurements, rotates, rolls, contradicted, start.curve, has_pattern)


def _with_cause(
    found: _Detected,
    frames: Tensor,
    valid: Tensor | None,
    timing: SensorTiming,
    method: _Method,
    options: _FitOptions,
) -> DetectionResult:
    """The result with the timing as a reason, if the measurements contradict the stated one and agree with another."""
    reliable, all_reasons = found.result.reliable.clone(), list(found.result.reasons)
    for index, axes in enumerate(found.contradicted):
        if not any(axes):
            continue
        part = slice(index, index + 1)
        own = found.measurements.mapped(itemgetter(part))
        of_stack = frames[part], None if valid is None else valid[part]
        curve = replace(found.bands, offsets=found.bands.offsets[part], quality=found.bands.quality[part])
        rotates = found.rotates[index]
        cause = _wrong_setting(*of_stack, own, curve, axes, timing, method, options, rotates=rotates)
        if cause is not None:
            # the axes have one timing: of 9 reliable axes beside a contradicted one, 3 were wrong
            reliable[index] = False
            all_reasons[index] = tuple((cause, *reasons) for reasons in all_reasons[index])
    return replace(found.result, reliable=reliable, reasons=tuple(all_reasons))


def _wrong_setting(
    frames: Tensor,
    valid: Tensor | None,
    measurements: Measurements,
    curve: OffsetCurve,
    axes: tuple[bool, bool],
    timing: SensorTiming,
    method: _Method,
    options: _FitOptions,
    *,
    rotates: bool,
) -> str | None:
    """Sentence about another timing with which the frames of one stack agree; None if none was found.

    A timing agrees if detection with it is reliable along the axes that contradict the stated one. With the wrong scan
    axis, the halves of a row are exposed at different times and move apart.

    Args:
        frames: (1, T, H, W) in row order.
        valid: Their valid pixels.
        measurements: Displacements of the rows.
        curve: Offsets of the row bands.
        axes: Axes (x, y) in row order that contradict the stated timing.
        timing: The stated timing, in image order.
        method: The method.
        options: Its options.
        rotates: Whether the halves of the rows move apart.
    """
    trial = replace(options, is_trial=True)

    def agrees(
        other: RowTiming,
        change: Callable[[Tensor], Tensor] | None = None,
        concerned: tuple[bool, bool] = axes,
        tones: Tensor | None = None,
    ) -> bool:
        changed, pixels, bands = frames, valid, curve if change is None else None
        if change is not None:
            changed, pixels = change(frames), None if valid is None else change(valid)
        try:
            found = _detect(changed, pixels, other, method, trial, bands_known=bands, frequencies=tones).result
        except (ValueError, AbandonedError):  # columns may lack the detail that rows have
            return False
        return all(good or not axis for good, axis in zip(found.reliable[0].tolist(), concerned, strict=True))

    row_timing = timing.in_row_order()
    count = frames.shape[1]
    agreeing = period_factor(measurements, row_timing, count, BLOCK_ROWS) if count > 2 else None
    factor, tones = (None, None) if agreeing is None else agreeing
    if factor is not None and factor < 0:
        if agrees(row_timing, lambda images: images.flip(-2), tones=tones):
            other = "reverse" if timing.readout_direction == "forward" else "forward"
            return f"the frames agree with readout_direction={other!r}, not with {timing.readout_direction!r}"
    elif factor is not None and timing.frame_start_times is None:
        frame_rows = factor * timing.frame_rows
        changed = replace(row_timing, frame_rows=max(frame_rows, frames.shape[-2], timing.exposure_rows))
        if changed.frame_rows == frame_rows and agrees(changed, tones=tones):
            return (
                f"the frames agree with frame_rows={frame_rows:.5g}, not with {timing.frame_rows:g}: frame_rows counts "
                "the blanking rows and is not the image height; if the frame rate is known, row_time is 1 / (frame "
                f"rate x frame_rows), with {timing.frame_rate:.5g} frames/s {timing.row_time / factor:.5g} s"
            )
    elif factor is not None:
        times = {name: getattr(timing, name) * factor for name in ("frame_rows", "exposure_rows")}
        changed = replace(row_timing, row_time=timing.row_time / factor, **times)
        if agrees(changed, tones=tones):
            return (
                f"the frames agree with row_time={changed.row_time:.5g} s, not with {timing.row_time:g} s, if the "
                "start times of the frames are right"
            )
    swapped = (axes[1], axes[0])
    if rotates and frames.shape[-1] <= timing.frame_rows and agrees(row_timing, lambda images: images.mT, swapped):
        other, stated = ("x", "y") if timing.scan_axis == -2 else ("y", "x")
        return f"the frames agree with scan_axis={other!r}, not with {stated!r}"
    return None


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
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=2)
        >>> detector = rsv.VibrationDetector(timing, method="bands", tones=1)
        >>> found = detector(torch.stack([frames, 0.5 * frames])[:, :, None])  # two stacks (B, T, C, H, W)
        >>> found.vibration.frequency[..., 0].round(decimals=0).tolist()  # Hz, (B, 2)
        [[111.0, 90.0], [111.0, 90.0]]
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
