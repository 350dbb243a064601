"""Names and types of the options that configuration files and the command line state.

A configuration file and the arguments of a command are checked before torch is imported, which takes seconds. This
module therefore imports no other package. The tables of the packages hold the functions that belong to the
names; tests/test_imports.py compares both.
"""

from typing import Literal, TypedDict

from rsvib_torch.core.checks import check_choice

__all__ = [
    "DEFAULT_WINDOW",
    "METHOD_SETTINGS",
    "BadFrames",
    "BandSettings",
    "BandedSettings",
    "BorderName",
    "DetectionMethod",
    "DetectionSettings",
    "DewarpSettings",
    "ExactSettings",
    "ExportFormat",
    "IsdModel",
    "Mosaic",
    "MotionUnit",
    "OpticsSettings",
    "PriorName",
    "Registration",
    "RichardsonLucySettings",
    "StmapConvention",
    "TimeUnit",
    "ToneSettings",
    "method_options",
]

DEFAULT_WINDOW = 8  # frames

BorderName = Literal["mirror", "hold", "crop"]
BadFrames = Literal["pass", "skip"]
DetectionMethod = Literal["direct", "bands"]
ExportFormat = Literal["gcsv", "stmap", "isd", "csv"]
IsdModel = Literal["auto", "frame", "line-scan"]
Mosaic = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
MotionUnit = Literal["px", "rad", "mrad", "urad", "deg", "arcsec", "rad/s", "deg/s"]
PriorName = Literal["gaussian", "edges"]
Registration = Literal["projection", "ncc", "phase"]
StmapConvention = Literal["nuke", "opencv"]
TimeUnit = Literal["s", "ms", "us", "ns"]


class BandSettings(TypedDict, total=False):
    """Registration of row bands, see ``detect_vibration``."""

    registration: Registration
    band_rows: int
    band_step: int
    search: int


class ToneSettings(TypedDict, total=False):
    """Model of tones, see ``detect_vibration``."""

    method: DetectionMethod
    tones: Literal["auto"] | int
    harmonics: int
    image_acceleration: bool
    columns: int | None
    roll: bool | Literal["auto"]
    zoom: bool | Literal["auto"]
    focal_length: float | None
    principal_point: tuple[float, float] | None
    distortion: tuple[float, float, float, float, float] | None


class DetectionSettings(BandSettings, ToneSettings, total=False):
    """Options of detection in a configuration file."""


class OpticsSettings(TypedDict, total=False):
    """Optics of the camera, see ``Optics``."""

    sigma: float
    cutoff: float | None
    pixel: float
    mtf: list[list[float]] | None


class ExactSettings(TypedDict, total=False):
    """Options of method ``"exact"``, see ``restore_exact``."""

    joint: bool | int
    prior: str
    noise: float | Literal["auto"]
    regularisation: float
    chunk_frequencies: int | None
    segments: int | None
    scale: Literal[1, 2]


class BandedSettings(TypedDict, total=False):
    """Options of method ``"banded"``, see ``restore_banded``."""

    half_rows: int
    stride: int
    interpolation: Literal["linear", "cubic"]
    noise_to_signal: float | Literal["auto"]
    chunk_rows: int | None


class DewarpSettings(TypedDict, total=False):
    """Options of method ``"dewarp"``, see ``restore_dewarp``."""

    chunk_rows: int


class RichardsonLucySettings(TypedDict, total=False):
    """Options of method ``"richardson-lucy"``, see ``restore_richardson_lucy``."""

    joint: bool | int
    iterations: int


# Options of the restoration methods, by name.
METHOD_SETTINGS: dict[str, type] = {
    "exact": ExactSettings,
    "banded": BandedSettings,
    "dewarp": DewarpSettings,
    "richardson-lucy": RichardsonLucySettings,
}


def method_options(method: str) -> tuple[str, ...]:
    """Names of the options of a restoration method.

    Raises:
        ValueError: If there is no such method.

    Example:
        >>> method_options("dewarp")
        ('chunk_rows',)
    """
    check_choice("method", method, tuple(METHOD_SETTINGS))
    return tuple(METHOD_SETTINGS[method].__annotations__)
