"""The table of stack formats, and the choice of a format by the ending of a file name."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rsvib_torch.files.atomic import Kind
from rsvib_torch.files.reading import check_regular
from rsvib_torch.io.array_stores import open_hdf5, open_npy, write_hdf5, write_npy
from rsvib_torch.io.frame_reader import FrameReader
from rsvib_torch.io.images import check_images, open_images, write_images
from rsvib_torch.io.stack_info import FFV1, H264, READ_ONLY_VIDEO, StackInfo, check_array
from rsvib_torch.io.tiff import open_tiff, write_tiff
from rsvib_torch.io.video import VideoReader, check_video, write_video
from rsvib_torch.numerics.tables import Array
from rsvib_torch.text import quoted


@dataclass(frozen=True)
class StackFormat:
    """How stacks are stored in files with certain endings; docs/architecture.md has the contract."""

    name: str  # in messages
    endings: tuple[str, ...]  # lower case with the dot; ``""`` is a name without an ending
    open: Callable[[Path], FrameReader]
    # ``write(path, info, frames)``; None for formats that are only read
    write: Callable[[Path, StackInfo, Iterator[Array]], None] | None = None
    dtypes: tuple[str, ...] = (  # NumPy names of those that can be written
        "uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64",
    )  # fmt: skip
    check: Callable[[Path, StackInfo], None] | None = None  # raises an error if a stack cannot be written to a path
    uncompressed: bool = False  # whether files have the size of their pixels
    kind: Kind = "file"  # a "folder" may contain other files
    keeps: tuple[str, ...] = ()  # attributes of ``StackInfo`` that are stored besides the pixels


_KEPT = ("full_scale", "frame_times", "orientation")
_KEPT_BY_PNG = ("full_scale", "orientation")

# The order is that of error messages.
_STACK_FORMATS = (
    StackFormat("npy", (".npy",), open_npy, write_npy, check=check_array, uncompressed=True),
    StackFormat(
        "hdf5", (".h5", ".hdf5", ".hdf"), open_hdf5, write_hdf5, check=check_array, uncompressed=True, keeps=_KEPT
    ),
    StackFormat("jpeg", (".jpg", ".jpeg"), open_images),
    StackFormat("png", (".png",), open_images, write_images, ("uint8", "uint16"), check_images, keeps=_KEPT_BY_PNG),
    StackFormat(
        "image folder", ("",), open_images, write_images, check=check_images, kind="folder", keeps=_KEPT_BY_PNG
    ),
    StackFormat("tiff", (".tif", ".tiff"), open_tiff, write_tiff, uncompressed=True, keeps=(*_KEPT, "metadata")),
    StackFormat("FFV1 video", FFV1, VideoReader, write_video, ("uint8", "uint16"), check_video, keeps=_KEPT),
    StackFormat("H.264 video", H264, VideoReader, write_video, check=check_video, keeps=_KEPT),
    StackFormat("avi, webm, mpeg, 3gp and wmv", READ_ONLY_VIDEO, VideoReader),
)
FORMATS: dict[str, StackFormat] = {ending: form for form in _STACK_FORMATS for ending in form.endings}
"""Format of every file ending."""


def find_format(path: Path) -> StackFormat:
    """The format of an existing stack: by its ending, or a folder of images."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    check_regular(path)
    return FORMATS[""] if path.is_dir() else _format_of_ending(path, FORMATS, "a folder of PNG, TIFF or JPEG files")


def target_format(path: Path) -> StackFormat:
    """The format in which a path is written, by its ending only."""
    written = {ending: form for ending, form in FORMATS.items() if form.write is not None}
    return _format_of_ending(path, written, "a name without an ending for a folder of PNG files")


def _format_of_ending(path: Path, formats: Mapping[str, StackFormat], folder: str) -> StackFormat:
    ending = path.suffix.lower()
    if ending in formats:
        return formats[ending]
    read_only = f"{FORMATS[ending].name} files can only be read" if ending in FORMATS else ""
    known = ", ".join(known for known in formats if known)
    problem = read_only or f"unknown file ending {quoted(path.suffix)}"
    raise ValueError(f"{path}: {problem}; expected {known} or {folder}")
