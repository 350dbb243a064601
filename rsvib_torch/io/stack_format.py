"""The contract of a stack format: how frames are read and written, and what a format states about itself."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from rsvib_torch.io.stack_info import StackInfo

Frame = NDArray[Any]

# Endings of videos: of those that are written with H.264 and FFV1, and of those that are only read.
H264, FFV1 = (".mp4", ".mov", ".m4v"), (".mkv",)
READ_ONLY_VIDEO = (".avi", ".webm", ".3gp", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv")
VIDEO = (*FFV1, *H264, *READ_ONLY_VIDEO)


class FrameReader(Protocol):
    """An open stack; frames are read one at a time, in any order."""

    info: StackInfo

    def frame(self, index: int) -> Frame:
        """Pixels of a frame as stored: (H, W) or (C, H, W), in ``info.dtype``; ``FrameError`` if it is damaged."""

    def close(self) -> None:
        """Close the file, if it is open between frames."""
        return


_RANGE = re.compile(r"(.+)\[(\d*):(\d*)\]")


def split_range(path: Path) -> tuple[Path, tuple[int, int | None] | None]:
    """The file of a stack and the frames ``NAME[START:END]`` that are read of it; None for all of them.

    Example:
        >>> split_range(Path("clip.mp4[100:200]"))
        (PosixPath('clip.mp4'), (100, 200))
        >>> split_range(Path("clip.mp4"))
        (PosixPath('clip.mp4'), None)
    """
    found = _RANGE.fullmatch(path.name)
    if found is None or path.exists():
        return path, None
    name, start, end = found.groups()
    return path.with_name(name), (int(start or 0), int(end) if end else None)


# Contract of a format. All functions are called with the path of the stack; ``write`` with that of a temporary file or
# folder, which the caller renames when it is complete (``rsvib_torch/core/atomic.py``).
#
# Shapes:      frames are (H, W) or (C, H, W), channels RGB or RGBA; ``StackInfo.shape`` is (T, H, W) or (T, C, H, W),
#              also if the file stores channels last (``StackInfo.from_stored``, ``to_stored``).
# Data types:  one of ``dtypes`` in native byte order; pixels are returned as stored, without scaling.
# Full scale:  ``info.full_scale`` is the count that corresponds to 1.0, or None if the file does not state it; formats
#              that have room for it store it (``known_full_scale`` supplies 255 for uint8).
# Frame times: exposure starts in seconds, or None; times that are not exact need ``time_error`` and ``time_source``.
# Orientation: frames have the rows and columns of the file; ``info.orientation`` states how they are displayed.
# Metadata:    ``keeps`` states what the format stores besides pixels; users are told what their file loses.
# Reading:     ``open`` must not allocate memory by sizes in a header before it has compared them with the size of the
#              file, must not decode pixels, execute code or follow links to other files, and raises an ``OSError`` if
#              the file cannot be opened, a one-line ``ValueError`` that names the file if it is not a stack
#              (``readable_stack``), and ``ModuleNotFoundError`` if a package is missing (``needed_package``). A reader
#              raises ``FrameError`` for a damaged frame (``readable_frame``); opening fails if more than half of the
#              frames are missing. Frames that are stored together are decoded once (``io/blocks.py``);
#              ``info.decoding_bytes`` is the memory that this needs.
# Writing:     ``write`` takes the frames one after another; the caller synchronises the files with the disk.
@dataclass(frozen=True)
class StackFormat:
    """How stacks are stored in files with certain endings.

    Attributes:
        name: Name in messages.
        endings: File endings, lower case with the dot; ``""`` is a name without an ending.
        open: Opens a stack for reading.
        write: ``write(path, info, frames, compression)`` writes a stack from an iterator of its frames; None for
            formats that are only read.
        dtypes: NumPy names of the data types that can be written.
        check: Raises an error if a stack cannot be written to a path.
        kind: ``"file"``; ``"folder"``, which may contain other files; or ``"tree"``, a folder that is replaced as one.
        marker: File that identifies a folder of any name as a stack of this format.
        companions: Endings of additional files, which are appended to the file name.
        compressions: Values of ``compression`` besides None.
        keeps: What is stored besides pixels: ``"full_scale"``, ``"frame_times"``, ``"orientation"``, ``"resolution"``
            and ``"metadata"``, attributes of ``StackInfo``.
    """

    name: str
    endings: tuple[str, ...]
    open: Callable[[Path], FrameReader]
    write: Callable[[Path, StackInfo, Iterator[Frame], str | None], None] | None = None
    dtypes: tuple[str, ...] = (
        "uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64",
    )  # fmt: skip
    check: Callable[[Path, StackInfo], None] | None = None
    kind: Literal["file", "folder", "tree"] = "file"
    marker: str = ""
    companions: tuple[str, ...] = ()
    compressions: tuple[str, ...] = ()
    keeps: tuple[str, ...] = ()
