"""Options of detection, restoration and stacks, in groups.

A field of a group, with the text below it, is the only statement of an option: arguments of public functions, keys of
configuration files, options of the commands, their checks, help texts and reference pages follow from it. To add an
option, add a field, and use it where the group is used.

Configuration files and command lines are checked before torch is imported, which takes seconds. This module therefore
imports only their checks. The tables of the packages hold the functions that belong to the names.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, SkipValidation
from pydantic.config import JsonDict

from rsvib_torch.checks.values import Count, Extensible, NotNegative, Number, Positive, fields_of, options

if TYPE_CHECKING:
    from rsvib_torch.checks.arguments import ArrayLike

    Mask = ArrayLike | None
    Curve = tuple[ArrayLike | Sequence[float], ArrayLike | Sequence[float]]
else:  # arrays are checked where they are used
    Mask = object
    Curve = list[list[float]]

FilePath = str | os.PathLike[str] | None
OptionTable = Mapping[str, Any] | None
Detections = Sequence[Any] | None  # entries are ``DetectedVibration`` or None
Progress = Callable[[int, int], None] | None
BorderName = Literal["mirror", "crop"]
Channels = Literal["first", "last"] | None
DetectionMethod = Literal["direct", "bands"]
Mosaic = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
MotionUnit = Literal["px", "rad", "mrad", "urad", "deg", "arcsec", "rad/s", "deg/s"]
PriorName = Literal["gaussian", "edges"]
Registration = Literal["projection", "ncc", "phase"]
RestorationName = Literal["exact", "banded", "dewarp", "richardson-lucy"]

Columns = Annotated[int, Field(ge=64, le=2**31)]  # px; narrower bands are often registered wrongly
Frames = Annotated[int, Field(ge=2, le=2**31)]
Side = Annotated[float, Field(gt=0.0, le=0.4)]  # parts of a frame; more leaves less than a fifth of it
COMMAND_LINE: JsonDict = {"command_line": True}  # mark of fields that are options of commands as well
MAX_TONES = 4  # tones of one axis; a record of a few frames does not resolve more


@options
class InputOptions:
    """How frames are given."""

    full_scale: Positive | None = None
    """Count that means 1.0, for integer frames; by default that of the file, 255 for uint8."""
    channels: Channels = None
    """``"last"`` for frames (T, H, W, C) or (B, T, H, W, C). By default channels come before the image axes, and frames
    that appear to have them last are refused; ``"first"`` omits this check."""


@options
class MaskedInputOptions(InputOptions):
    """How frames are given, with missing pixels."""

    ignore: Annotated[Mask, SkipValidation] = None
    """Boolean mask of pixels that do not count (dead, saturated, a dark rim), broadcastable to (..., H, W) of the
    frames; they may hold any value. NaN marks missing pixels as well."""


@options
class BandOptions:
    """Row bands whose offsets between frames are measured."""

    band_rows: int = Field(default=32, ge=4, le=2**31)
    """Rows of a band."""
    band_step: Count = 16
    """Rows from one band to the next."""
    search: int = Field(default=16, ge=2, le=2**31)
    """Search range in px around the whole-frame offset; a peak at its edge fails."""


@options
class RegistrationOptions(BandOptions):
    """Row bands, and how their offsets are measured."""

    registration: Annotated[Registration, Extensible] = "ncc"
    """Method of the band registration: ``"projection"`` (gray projection, the paper), ``"ncc"`` or ``"phase"``, as in
    ``register_bands``."""


@options
class ProjectionOptions:
    """The camera, for a motion that is a rotation."""

    focal_length: Positive | None = None
    """Focal length in px, for a motion that is a rotation of the camera: displacements then follow from the projection
    (see ``Camera``), which matters for fields of view above about 20 degrees. None: the displacement by translation is
    the same in the whole frame."""
    principal_point: tuple[Number, Number] | None = Field(default=None, strict=False)
    """px along x and y from the centre of the first pixel, as in OpenCV; by default the centre of the frame."""
    distortion: tuple[Number, Number, Number, Number, Number] | None = Field(default=None, strict=False)
    """Lens distortion (k1, k2, p1, p2, k3) as in OpenCV; by default none."""


@options
class ToneOptions(ProjectionOptions, RegistrationOptions):
    """Detection of tones."""

    method: DetectionMethod = "direct"
    """``"direct"``, or ``"bands"`` (of the paper), in half the time with ten times larger errors."""
    tones: Annotated[int, Field(ge=1, le=MAX_TONES)] | Literal["auto"] = "auto"
    """Number of tones of each axis, 1 to 4, or ``"auto"`` to select it by significance; the standard deviations then
    allow for a further tone."""
    image_acceleration: bool = False
    """Whether the image motion has a constant acceleration."""
    columns: Columns | None = None
    """Use only this number of neighbouring columns, those with the most detail: all columns contain the same vibration,
    and a quarter of them takes two thirds of the time for half the accuracy. None for all."""
    roll: bool | Literal["auto"] = "auto"
    """Measure the rotation about the optical axis as a third component of the motion, in rad: True, False, or
    ``"auto"``: if the halves of the rows move apart, and not with ``columns``. Results then have three axes instead of
    two, see ``Vibration``."""
    zoom: bool | Literal["auto"] = "auto"
    """The same for the change of scale, as a fourth component; includes roll."""


@options
class VibrationOptions(ToneOptions, MaskedInputOptions):
    """Options of ``detect_vibration``."""


@options
class FreeMotionOptions(ProjectionOptions, RegistrationOptions, MaskedInputOptions):
    """Options of ``detect_motion``; bands are those of the start."""

    knot_rows: int = Field(default=24, ge=4, le=2**31)
    """Row times from one knot of the spline to the next, which then resolves frequencies up to ``1 / (2 knot_rows
    T_row)``. In long stacks the spacing is larger, for 3000 knots at most."""
    iterations: int = Field(default=4, ge=1, le=100)
    """Rounds of measuring and fitting."""
    roll: bool = False
    """Measure the rotation about the optical axis as a third component of the motion, in rad, from strips of
    columns."""
    zoom: bool = False
    """The same for the change of scale, as a fourth component; includes roll."""


@options
class BandRegistrationOptions(BandOptions, InputOptions):
    """Options of ``register_bands``."""

    method: Annotated[Registration, Extensible] = "ncc"
    """``"projection"`` (gray projection, the paper), ``"ncc"`` or ``"phase"``."""


@options
class OpticsOptions:
    """Transfer function of a lens and of square pixels, see ``Optics``."""

    sigma: NotNegative = 0.0
    """Standard deviation of the Gaussian blur of aberrations in px."""
    cutoff: Positive | None = None
    """Diffraction cutoff frequency in cycles/px (pixel pitch over wavelength and f-number); None for no diffraction."""
    pixel: NotNegative = 0.0
    """Width of the light-sensitive square in px; 0 for none, for a scene that was recorded by pixels before."""
    mtf: Annotated[Curve, SkipValidation] | None = None
    """Measured MTF: frequencies in cycles/px, increasing from above 0 or from 0 with an MTF of 1, and values; 0 beyond
    the last one. The curve of ``slanted_edge_mtf`` contains the pixel: ``Optics(mtf=(curve.frequency, curve.mtf))``."""


@options
class ExactOptions:
    """Options of method ``"exact"``."""

    joint: bool | Count = Field(default=False, json_schema_extra=COMMAND_LINE)
    """``True``: one image from all frames, in the coordinates of the middle one (the time axis keeps length 1); a
    number K: every frame from K neighbouring ones; ``False``: every frame from itself. With image motion, only what a
    frame has in common with the restored one is used."""
    prior: Annotated[PriorName, Extensible] = Field(default="gaussian", json_schema_extra=COMMAND_LINE)
    """``"gaussian"``: rows predict their neighbours, one fast solution; ``"edges"``: moreover, every patch of 8 x 8 px
    is a sum of few cosines, which separates edges and flat areas from noise; several times slower."""
    noise: NotNegative | Literal["auto"] = "auto"
    """Standard deviation of the noise (full scale 1); ``"auto"`` estimates it for every frame. Noise and texture are
    distinguished with two frames or with blur, and only within bounds with one sharp frame, see ``noise_levels``."""
    regularisation: Positive = 1.0
    """Factor on the prior; 1 is the strength estimated from the frames."""
    scale: Literal[1, 2] = Field(default=1, json_schema_extra=COMMAND_LINE)
    """Points of the restored frames per pixel along both axes, 1 or 2. With 2, the unknown is the scene after optics
    and pixel on a grid of half pixels, and aliasing is part of the model: several frames that sample between each
    other's pixels contain detail beyond half a cycle per px, one frame does not. The prior is then a polynomial in the
    Laplacians of both axes (``PolynomialPrior``)."""
    mosaic: Mosaic | None = Field(default=None, json_schema_extra=COMMAND_LINE)
    """Colours of the pixels (0, 0), (0, 1), (1, 0), (1, 1) of raw frames (T, H, W) or (T, 1, H, W) behind colour
    filters: ``"RGGB"``, ``"BGGR"``, ``"GRBG"`` or ``"GBRG"``. The restored frames have three channels R, G, B, see
    ``restore_mosaic``."""
    optics: OpticsOptions | None = None
    """Optics of the camera, pixel included: the restored frames are as sharp as from a camera with pixels of the
    restored grid behind a Gaussian of half a pixel, ``Optics(sigma=0.5 / scale, pixel=1 / scale)``, where noise allows
    it, see ``sharpened``. None: the restored frames have the sharpness of the camera at rest."""


@options
class BandedOptions:
    """Options of method ``"banded"``."""

    half_rows: Count = 16
    """Half height of a slab, in rows."""
    noise_to_signal: NotNegative | Literal["auto"] = "auto"
    """Variance of the noise over that of the scene gradients; ``"auto"`` estimates it."""


@options
class DewarpOptions:
    """Options of method ``"dewarp"``: none."""


@options
class RichardsonLucyOptions:
    """Options of method ``"richardson-lucy"``."""

    # each takes the time of four blurs; noise is amplified long before 1000 (docs/method.md)
    iterations: int = Field(default=20, ge=1, le=1000)
    """Number of iterations, at most 1000."""


METHOD_OPTIONS: dict[str, type] = {
    "exact": ExactOptions,
    "banded": BandedOptions,
    "dewarp": DewarpOptions,
    "richardson-lucy": RichardsonLucyOptions,
}


def method_options(method: str) -> tuple[str, ...]:
    """Names of the options of a restoration method."""
    return tuple(fields_of(METHOD_OPTIONS[method]))


@options
class RestorationOptions(ExactOptions, BandedOptions, DewarpOptions, RichardsonLucyOptions):
    """A restoration method and its options; those of other methods must have their default values."""

    method: RestorationName = Field(default="exact", json_schema_extra=COMMAND_LINE)
    """``"exact"``: all rows coupled, several frames jointly if requested; ``"banded"``: row by row within slabs (Sec.
    3.2 of Liu et al. 2023); ``"dewarp"``: geometry only, fastest; ``"richardson-lucy"``: iterative, non-negative."""
    saturation: Positive | Literal["auto"] | None = Field(default="auto", json_schema_extra=COMMAND_LINE)
    """Level from which pixels are saturated, in the unit of the frames; ``"auto"``: for integer frames full scale, or
    65520 of 65535 for 12 bits stored left-aligned; none for floating-point frames, whose level is unknown. None: no
    pixel is saturated."""

    def __post_init__(self) -> None:
        names = method_options(self.method)
        for group in METHOD_OPTIONS.values():
            for name, field in fields_of(group).items():
                if name not in names and getattr(self, name) != field.default:
                    known_options = f"; its options are {', '.join(names)}" if names else ", which has none"
                    raise ValueError(f"{name} is no option of method={self.method!r}{known_options}")


@options
class RestorerOptions(RestorationOptions, InputOptions):
    """Options of ``VibrationRestorer``."""

    check: bool = True
    """Judge the result on a part of the frames, and warn if it is no better than the raw frames; needs two frames.
    ``judge_restoration`` judges all of them."""


@options
class RestoreOptions(RestorerOptions, MaskedInputOptions):
    """Options of ``restore``."""


@options
class TrackerOptions(RestorationOptions, InputOptions):
    """Options of ``VibrationTracker``."""

    window: Frames = 8
    """Number of frames from which the vibration is detected at the start, and again if tracking fails."""
    columns: Columns | None = 384
    """Columns that are measured, those with the most detail; None for all."""
    method: RestorationName = "dewarp"
    """Method of ``restore``; ``"dewarp"`` is the fastest."""
    steady: NotNegative = 0.0
    """s; the image is moved to the straight line that fits its path during this time, so that slow shaking is removed
    as well, and its skew and wobble also along axes without a reliable vibration. 0: frames stay where they are."""


@options
class WindowOptions:
    """The windows that a stack is cut into."""

    window: Frames = Field(default=8, json_schema_extra=COMMAND_LINE)
    """Largest number of frames in which one vibration is detected."""


@options
class ResourceOptions:
    """Memory, threads and device of a run, and the full scale of its stack."""

    full_scale: Positive | None = None
    """As in ``read_stack``."""
    memory: str | float | None = Field(default=None, json_schema_extra=COMMAND_LINE)
    """Limit for the memory of the process, in bytes or like ``"2GB"``; by default three quarters of the memory that is
    free or used by the process."""
    workers: Annotated[int, Field(ge=1)] | None = Field(default=None, json_schema_extra=COMMAND_LINE)
    """Largest number of windows, or of frames of a video, to compute at once; by default the number of processors."""
    device: str = "auto"
    """``"auto"``, ``"cpu"`` or ``"cuda"``."""


@options
class StackOptions(WindowOptions, ResourceOptions):
    """How the windows of a stack are processed."""

    detection: OptionTable = None
    """Options of ``detect_vibration``. Without any, ``detect_motion`` measures windows in which no steady vibration
    explains the frames, e.g. because it decays, if more axes are reliable then."""
    restoration: OptionTable = None
    """Options of ``restore``, for frames whose full scale is 1; without ``saturation``, integer frames are saturated at
    the level of ``"auto"``. With ``joint=True``, every window becomes one image."""
    force: bool = False
    """Whether to keep restored frames even if they are judged worse than the raw ones."""
    given: Detections = None
    """Detections to use instead, one for each window (see ``read_manifest``)."""
    motion: object = None
    """A ``FreeMotion`` of all frames to use instead of detections, such as a recorded one (``align_motion``): in image
    axes, with the exposure start of the first row of frame 0 as time origin. Frames are restored to its place 0."""


@options
class FileRunOptions:
    """A run from file to file."""

    progress: Progress = None
    """Called with the number of complete frames and of all frames."""
    resume: bool = Field(default=False, json_schema_extra=COMMAND_LINE)
    """Whether to continue an interrupted run; a complete output is not changed."""
    manifest: FilePath = None
    """Path of the manifest; by default ``sink`` with ``.manifest.json`` appended."""


@options
class ProcessStackOptions(FileRunOptions, StackOptions):
    """Options of ``process_stack``."""


@options
class ProcessVideoOptions(FileRunOptions, ResourceOptions):
    """Options of ``process_video``; each of its two passes counts as half of the progress."""

    border: BorderName = "mirror"
    """Pixels that the sensor did not record: ``"mirror"``, extrapolated from each frame by itself; ``"crop"``, cut off
    by constant margins."""
    steady: NotNegative = 0.0
    """Every frame is moved to a smooth path, and its skew and wobble are undone: of shaking whose period is this time
    in s or shorter, at most a sixteenth remains; slower motion is kept. 0: frames stay where they are, and only
    vibration is removed."""
    crop_limit: Side = 0.04
    """Largest displacement of a corner of a frame by ``steady``, in parts of the width or height; where the path would
    need more, it is smoothed less."""
    gyroscope: FilePath = None
    """File with the rates of a gyroscope (gyroflow log, GoPro video, CSV), or ``"auto"``: the track of the video.
    See ``read_gyroscope``. The path of the camera is its rotation by the gyroscope, instead of the path and the tones
    by corners."""
    lens_profile: FilePath = None
    """Lens profile of Gyroflow (JSON), which goes with ``gyroscope``. See ``Camera.from_gyroflow``; by default, a focal
    length without distortion is fitted."""
    restoration: OptionTable = None
    """``method`` (default ``"exact"``), its options, and ``saturation``, as in ``restore``, for frames whose full scale
    is 1. Without ``saturation``, saturated pixels count as measured: their values are restored 0.2 dB worse if 1 % of
    the pixels are saturated, in a quarter of the time. Not ``joint``, ``scale``, ``mosaic`` or ``optics``."""
