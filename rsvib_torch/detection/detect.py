"""``detect_vibration``: entry point of detection, from the user's arguments to a result in the user's layout.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, Unpack, overload

from torch import nn

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.arrays import ArrayLike, Channels
from rsvib_torch.core.checks import check_choice, check_whole_number
from rsvib_torch.core.option_types import BandSettings, DetectionMethod, Registration, ToneSettings
from rsvib_torch.core.parallel import threads_for
from rsvib_torch.core.precision import full_precision, outside_graphs, without_gradients
from rsvib_torch.detection.attempts import FieldOptions, detect_tones, detect_windows, windows_of
from rsvib_torch.detection.pipeline import METHODS, DetectionOptions
from rsvib_torch.detection.result import DetectionResult
from rsvib_torch.detection.shapes.free import MotionDetection, detect_motion
from rsvib_torch.detection.shapes.swept import SweptTone, detect_swept_tone
from rsvib_torch.detection.strips import camera_in_row_order
from rsvib_torch.detection.tones.fit import MotionModel
from rsvib_torch.detection.tones.selection import MAX_TONES
from rsvib_torch.frames.grey import grey_frames
from rsvib_torch.io.stack_reading import FramesOrFiles
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.registration import RegistrationOptions

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
            **_given_for_model(
                model,
                roll=roll is True or None,  # "auto": not measured unless requested
                zoom=zoom is True or None,
                focal_length=focal_length,
                principal_point=principal_point,
                distortion=distortion,
            ),
        )
    check_choice("method", method, tuple(METHODS))
    if tones != "auto":
        check_whole_number("tones", tones, at_least=1)
        if tones > MAX_TONES:
            raise ValueError(f"tones must be 'auto' or 1 to {MAX_TONES}, got {tones}")
    check_whole_number("harmonics", harmonics, at_least=1, at_most=MAX_HARMONICS)
    if columns is not None:
        check_whole_number("columns", columns, at_least=64)  # px; narrower bands are often registered wrongly

    # 1. The user's frames become grey frames in row order, the arguments become options.
    bands = RegistrationOptions(registration, band_rows, band_step, search)
    stacks = grey_frames(frames, timing, full_scale, ignore, channels)
    timing = stacks.timing
    height, width = stacks.images.shape[-2:]
    camera = camera_in_row_order(focal_length, principal_point, distortion, (height, width), timing)
    field = _checked_field(roll, zoom, columns, camera)
    model_of_tones = MotionModel(harmonics, 2 if image_acceleration else 1)
    options = DetectionOptions(method, None if tones == "auto" else tones, model_of_tones, bands)
    if columns is not None:
        stacks = stacks.narrowed(columns)

    # 2. One result from all frames, or one from each window.
    with threads_for(stacks.images):
        if window is None:
            result = detect_tones(stacks, timing, options, field)
        else:
            windows = windows_of(stacks.images.shape[1], window, window_step, timing)
            result = detect_windows(stacks, windows, options, field)
    result = replace(result, timing=timing)  # of the stack, not of a window
    return result if stacks.batched else result[0]


def _checked_field(
    roll: bool | Literal["auto"], zoom: bool | Literal["auto"], columns: int | None, camera: Camera | None
) -> FieldOptions:
    """The checked options of roll and zoom, which are not measured of a part of the columns."""
    for name, value in (("roll", roll), ("zoom", zoom)):
        if value not in (True, False, "auto"):
            raise ValueError(f"{name} must be True, False or 'auto', got {value!r}")
    if columns is not None and (camera is not None or roll is True or zoom is True):
        raise ValueError(
            f"columns={columns} goes with roll=False, zoom=False and focal_length=None: roll, zoom and perspective "
            "are measured from all columns"
        )
    return FieldOptions(columns is None and roll, columns is None and zoom, camera)


def _given_for_model(model: str, **options: object) -> dict[str, object]:
    """Options of roll, zoom and camera that were given for another model than tones."""
    given = {name: value for name, value in options.items() if value is not None}
    if given and model == "swept":
        name, value = next(iter(given.items()))
        raise ValueError(f"{name}={value!r} goes with model='tones' or 'free', not with model='swept'")
    return given


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
        >>> found = detector(frames.expand(2, 1, *frames.shape).transpose(1, 2))  # two stacks (B, T, C, H, W)
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
