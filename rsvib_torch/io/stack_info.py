"""What a file states about a stack: shape, data type, full scale, times, orientation."""

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import ExifTags, Image

from rsvib_torch.checks.arguments import channels_appear_last, check_fields, checked_methods
from rsvib_torch.files.reading import Table
from rsvib_torch.frames.full_scale import check_dtype, known_full_scale
from rsvib_torch.text import one_line

# Endings of videos: of those that are written with H.264 and FFV1, and of those that are only read.
H264, FFV1 = (".mp4", ".mov", ".m4v"), (".mkv",)
READ_ONLY_VIDEO = (".avi", ".webm", ".3gp", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv")
VIDEO = (*FFV1, *H264, *READ_ONLY_VIDEO)

DIFFERENT = " (differs between files)"  # ending of the names of metadata of a folder


Scope = Literal["file", "image"]


@dataclass(frozen=True)
class Tag:
    """An entry in the header of a TIFF file."""

    code: int  # number of the tag
    dtype: int  # number of its data type in TIFF
    count: int  # number of values
    value: Any  # a number, text, bytes, or a tuple of numbers
    first_page: bool  # whether only the first page has it
    scope: Scope  # for which frames it is valid: of the same size only (``"image"``, georeferencing), or for any


@dataclass(frozen=True)
@checked_methods
class StackInfo:
    """Shape, data type and full scale of a stack in a file.

    Attributes:
        shape: (T, H, W) or (T, C, H, W).
        dtype: NumPy name of the data type in the file, e.g. ``"uint16"``.
        full_scale: Count that corresponds to 1.0: stated in the file, or 255 for ``uint8``; None if unknown, and for
            floats, whose values are not scaled.
        frame_times: Exposure start of the first row of every frame in seconds, if the file states it.
        frame_rate: Frames per second, if the file states it instead of the times.
        orientation: How the stored image is to be turned for display: 1 (as stored) to 8, the values of the tag of TIFF
            and EXIF, e.g. 6 for 90 degrees clockwise. Frames always have the stored rows and columns.
        time_error: Largest error of ``frame_times`` in seconds, e.g. rounding in a video; 0 if they are exact exposure
            starts. Times with an error may run at another rate than the exposures (``exposure_times``).
        frame_numbers: Number of frame intervals from the first frame to each frame, if frames of a recording are
            missing and the file states this instead of the times.
        path: The file; None if the stack is not in a file, or has another number of frames than the file.
        metadata: Further metadata of a TIFF file by name, which are kept when it is restored to TIFF; None for those
            that cannot be kept.
        decoding_bytes: Memory that reading needs besides the frame that is returned: frames that are stored together
            are decoded together.
        camera: Make and model of the camera, if the file states them (EXIF of JPEG and PNG, tags of videos).
        files: The file of each frame, of a folder of TIFF files. Frames that are restored to a folder get their names,
            metadata.

    Example:
        >>> import rsvib_torch as rsv
        >>> times = (0.0, 0.0333, 0.0667)
        >>> info = rsv.StackInfo((3, 3, 256, 256), "uint8", 255, frame_times=times)  # colour video
        >>> info.axes
        'TCHW'
        >>> rsv.write_stack("clip.mp4", frames, dtype="uint8", like=info)  # doctest: +SKIP
    """

    shape: tuple[int, ...]
    dtype: str
    full_scale: float | None
    frame_times: tuple[float, ...] | None = None
    frame_rate: float | None = None
    orientation: int = 1
    time_error: float = field(default=0.0, compare=False)
    path: Path | None = field(default=None, compare=False)
    frame_numbers: tuple[int, ...] | None = field(default=None, compare=False)
    metadata: Mapping[str, Tag | None] = field(default_factory=dict, compare=False, repr=False)
    decoding_bytes: int = field(default=0, compare=False)
    camera: str | None = field(default=None, compare=False)
    files: tuple[Path, ...] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        check_fields(self)
        if len(self.shape) not in (3, 4) or min(self.shape) < 1:
            raise ValueError(f"shape must be (T, H, W) or (T, C, H, W) with sizes of at least 1, got {self.shape}")

    @property
    def nodata(self) -> float | None:
        """Value of pixels without data that the tag GDAL_NODATA states, if the data type can hold it."""
        tag, value = self.metadata.get("GDAL_NODATA"), math.nan
        with suppress(ValueError):
            value = math.nan if tag is None else float(str(tag.value).strip("\0 "))
        limits = np.iinfo(self.dtype) if self.is_integer else np.finfo(self.dtype)
        fits = limits.min <= value <= limits.max and (value.is_integer() or not self.is_integer)  # NaN does not
        return value if fits else None

    @property
    def time_source(self) -> str:
        """Where the file states times or frame rate, for messages."""
        return "time stamps" if self.time_error else "frame_rate" if self.frame_times is None else "frame_times"

    @property
    def axes(self) -> str:
        """``"THW"`` (grey) or ``"TCHW"``."""
        return "THW" if len(self.shape) == 3 else "TCHW"

    @property
    def kind(self) -> str:
        """Shape of a frame, data type, full scale and orientation, for messages."""
        scale = "" if self.full_scale is None else f" with full scale {self.full_scale:g}"
        orientation = "" if self.orientation == 1 else f" with orientation {self.orientation}"
        return f"{self.shape[1:]} {self.dtype}{scale}{orientation}"

    @property
    def is_integer(self) -> bool:
        """Whether the pixels are counts."""
        return "int" in self.dtype

    @property
    def frame_bytes(self) -> int:
        """Size of a frame in bytes."""
        return int(np.prod(self.shape[1:], dtype=object)) * np.dtype(self.dtype).itemsize

    def with_shape(self, shape: tuple[int, ...]) -> "StackInfo":
        """A stack of another shape: times and files belong to its number of frames, a georeference to their size."""
        metadata = self.metadata
        if shape[-2:] != self.shape[-2:]:
            metadata = {name: None if tag is None or tag.scope == "image" else tag for name, tag in metadata.items()}
        same = tuple(shape[:1]) == self.shape[:1]
        of_frames: Table = {} if same else dict.fromkeys(("frame_times", "frame_numbers", "path", "files"))
        return replace(self, shape=shape, metadata=metadata, **of_frames)

    def with_frames(self, count: int) -> "StackInfo":
        """The same kind of stack with ``count`` frames."""
        return self.with_shape((count, *self.shape[1:]))

    def restored_as(self, scale: int, mosaic: str | None) -> "StackInfo":
        """The kind of stack of the restored frames: ``scale`` times the rows and columns, colours of a mosaic."""
        channels = self.shape[1:-2] if mosaic is None else (3,)
        return self.with_shape((self.shape[0], *channels, scale * self.shape[-2], scale * self.shape[-1]))


_RANGE = re.compile(r"(.+)\[(\d*):(\d*)\]")


def split_range(path: Path) -> tuple[Path, tuple[int, int | None] | None]:
    """The file of a stack and the frames ``NAME[START:END]`` that are read of it; None for all of them."""
    match = _RANGE.fullmatch(path.name)
    if match is None or path.exists():
        return path, None
    name, start, end = match.groups()
    return path.with_name(name), (int(start or 0), int(end) if end else None)


def is_video(path: Path) -> bool:
    """Whether a stack, or frames of it, is a video by its name."""
    return split_range(path)[0].suffix.lower() in VIDEO


def orientation_of(value: object) -> int:
    """The value of an orientation tag, 1 to 8; 1 (as stored) if it is anything else."""
    return int(value) if isinstance(value, int | np.integer) and value in range(1, 9) else 1


def camera_name(make: object, model: object) -> str | None:
    """Make and model of a camera as one name, with the make once (Canon, Canon EOS R5); None without a model."""
    maker, name = (one_line("" if text is None else str(text).replace("\0", " "), 60) for text in (make, model))
    repeated = name.casefold().startswith(maker.casefold())
    return None if not name else name if repeated else f"{maker} {name}"


def attributes_of(info: StackInfo) -> Table:
    """Attributes of an array in a file, or keys of a TIFF description, that state ``info``, without unknown values."""
    times = info.frame_times
    stated: Table = {
        "full_scale": None if info.full_scale is None else float(info.full_scale),
        "frame_times": None if times is None else [float(time) for time in times],
        "frame_rate": None if times is not None or info.frame_rate is None else float(info.frame_rate),
        "orientation": None if info.orientation == 1 else info.orientation,
    }
    return {name: value for name, value in stated.items() if value is not None}


def fields_of_attributes(attributes: Table, count: int, dtype: np.dtype) -> Table:
    """Fields of ``StackInfo`` of ``count`` frames that the attributes state, as ``attributes_of`` writes them."""
    full_scale, rate = (attributes.get(name) for name in ("full_scale", "frame_rate"))
    times = np.asarray(attributes.get("frame_times", ()), dtype=np.float64).ravel().tolist()
    return {
        "full_scale": known_full_scale(dtype, None if full_scale is None else float(full_scale)),
        "frame_times": tuple(times) if len(times) == count else None,
        "frame_rate": None if rate is None else float(np.asarray(rate).item()),
        "orientation": orientation_of(attributes.get("orientation")),
    }


def info_of_array(shape: tuple[int, ...], dtype: np.dtype, attributes: Table | None = None) -> StackInfo:
    """An array (H, W), (T, H, W) or (T, C, H, W) in a file as a stack."""
    check_dtype(dtype)
    if len(shape) not in (2, 3, 4) or min(shape) < 1:
        raise ValueError(f"array of shape {shape}; expected (H, W), (T, H, W) or (T, C, H, W)")
    if channels_appear_last(shape):
        raise ValueError(f"array of shape {shape} appears to have its channels last; store (T, C, H, W)")
    stack = shape if len(shape) > 2 else (1, *shape)
    return StackInfo(stack, dtype.name, **fields_of_attributes(attributes or {}, stack[0], dtype))


def check_array(path: Path, info: StackInfo) -> None:
    """Refuse a shape that would be read as another one."""
    if channels_appear_last(info.shape):
        raise ValueError(f"{path}: array of shape {info.shape} would be read as one with channels last; write .tif")


def exif_fields(data: bytes) -> Table:
    """Orientation and camera of one image from its EXIF metadata."""
    exif = Image.Exif()
    try:
        exif.load(data)
    except Exception:  # damaged metadata raise errors of many types
        return {}
    tags = ExifTags.Base
    camera = camera_name(exif.get(tags.Make), exif.get(tags.Model))
    return {"orientation": orientation_of(exif.get(tags.Orientation)), "camera": camera}
