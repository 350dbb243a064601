"""The contract of a stack format: how frames are read and written, and what a format states about itself."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from rsvib_torch.io.stack_info import StackInfo

__all__ = ["FrameReader", "FrameWriter", "StackFormat", "needed_package"]

Frame = NDArray[Any]


class FrameReader(Protocol):
    """An open stack; frames are read one at a time, in any order."""

    info: StackInfo

    def frame(self, index: int) -> Frame:
        """Pixels of a frame as stored: (H, W) or (C, H, W), in ``info.dtype``; ``FrameError`` if it is damaged."""

    def close(self) -> None:
        """Close the file, if it is open between frames."""
        return


class FrameWriter(Protocol):
    """A stack being written; any frame may be written at any time, and again."""

    def write(self, index: int, frame: Frame) -> None:
        """Write a frame, (H, W) or (C, H, W)."""

    def sync(self) -> None:
        """Return when all written frames, and the names of their files, are on the disk (``core.atomic.sync``)."""
        return

    def stored(self, index: int | None) -> Iterator[bytes]:
        """Bytes on the disk that hold a frame, or everything else (headers) for None; fewer if the file is damaged.

        An interrupted run is resumed with the frames for which they are unchanged. Without this method it starts again.
        """

    def close(self) -> None:
        """Finish the file, if it is open between frames."""
        return


# Contract of a format. All functions are called with the path of the stack; ``create`` and ``write_all`` with that of a
# temporary file or folder, which the caller renames when it is complete (``rsvib_torch/core/atomic.py``).
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
# Writing:     a format defines ``create``, ``write_all``, or neither (it is then only read).
#              After ``create(path, info, False)`` on an unfinished stack all frames that were synced are still there,
#              also after a loss of power; it must not change the files of a damaged stack before a frame is written.
@dataclass(frozen=True)
class StackFormat:
    """How stacks are stored in files with certain endings.

    Attributes:
        name: Name in messages.
        endings: File endings, lower case with the dot; ``""`` is a name without an ending.
        open: Opens a stack for reading.
        create: ``create(path, info, fresh)`` makes a file of full size whose frames are then written in any order
            (``fresh=True``), or opens an unfinished one to continue it (``fresh=False``); None if frames can only be
            written one after another.
        write_all: ``write_all(path, info, frames, compression)`` writes a stack from an iterator of its frames; None if
            ``create`` writes every stack.
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
    create: Callable[[Path, StackInfo, bool], FrameWriter] | None = None
    write_all: Callable[[Path, StackInfo, Iterator[Frame], str | None], None] | None = None
    dtypes: tuple[str, ...] = (
        "uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64",
    )  # fmt: skip
    check: Callable[[Path, StackInfo], None] | None = None
    kind: Literal["file", "folder", "tree"] = "file"
    marker: str = ""
    companions: tuple[str, ...] = ()
    compressions: tuple[str, ...] = ()
    keeps: tuple[str, ...] = ()

    @property
    def writable(self) -> bool:
        """Whether stacks of this format can be written."""
        return self.create is not None or self.write_all is not None


def needed_package(name: str, purpose: str, extra: str) -> Any:
    """Import an optional package.

    Args:
        name: Module to import.
        purpose: What needs it, for the message.
        extra: Extra of this package that installs it.

    Raises:
        ModuleNotFoundError: If it is missing, naming the extra to install.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.partition(".")[0] != name.partition(".")[0]:
            raise
        raise ModuleNotFoundError(
            f"{purpose} needs the package {name.partition('.')[0]}: pip install rsvib_torch[{extra}]", name=error.name
        ) from error
