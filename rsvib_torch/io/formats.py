"""The registry of formats: who reads and writes which file ending."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from rsvib_torch.io.stack_info import StackInfo

__all__ = [
    "FrameReader",
    "FrameWriter",
    "StackFormat",
    "find_format",
    "needed_package",
    "of_frames",
    "register_format",
    "target_format",
]

Frame = NDArray[Any]
ALL_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64")


class FrameReader(Protocol):
    """An open stack; frames are read one at a time, in any order."""

    @property
    def info(self) -> StackInfo:
        """What the file says of itself."""

    def frame(self, index: int) -> Frame:
        """Pixels of a frame as stored, (H, W) or (C, H, W); ``FrameError`` if this one cannot be read."""

    def close(self) -> None:
        """Let go of the file."""


class FrameWriter(Protocol):
    """A stack being written; any frame may be written at any time, and again."""

    def write(self, index: int, frame: Frame) -> None:
        """Put a frame, (H, W) or (C, H, W), in its place."""

    def sync(self) -> None:
        """See that what was written is on the disk."""

    def close(self) -> None:
        """Finish the file."""


@dataclass(frozen=True)
class StackFormat:
    """How stacks are kept under some file endings.

    Attributes:
        name: What the format is called in messages.
        endings: File endings, lower case with the dot.
        open: Opens a stack for reading. Sizes in headers must be checked against the file before memory is taken.
        create: Makes a whole file of a stack whose frames are then written in any order (``fresh=True``), or opens
            one that was made so to go on with it; None where frames can only be written one after another.
        write_all: Writes a stack from an iterator of its frames; None where ``create`` does. The last argument is the
            compression asked for, or None.
        dtypes: NumPy names of the pixel types that can be written.
        check: Raises a ``ValueError`` if a stack of this kind cannot be written to that path.
        kind: ``"file"``, a ``"folder"`` that other files may share, or a ``"tree"`` that is replaced as one.
        companions: Endings of files beside it, added to its name.
        compressions: What ``write_all`` knows.
    """

    name: str
    endings: tuple[str, ...]
    open: Callable[[Path], FrameReader]
    create: Callable[[Path, StackInfo, bool], FrameWriter] | None = None
    write_all: Callable[[Path, StackInfo, Iterator[Frame], str | None], None] | None = None
    dtypes: tuple[str, ...] = ALL_TYPES
    check: Callable[[Path, StackInfo], None] | None = None
    kind: Literal["file", "folder", "tree"] = "file"
    companions: tuple[str, ...] = ()
    compressions: tuple[str, ...] = ()

    @property
    def writable(self) -> bool:
        """Whether stacks of this format can be written."""
        return self.create is not None or self.write_all is not None


_FORMATS: dict[str, StackFormat] = {}


def register_format(form: StackFormat) -> None:
    """Add a format to those that stacks are read from and written to; an ending that is known already changes hands.

    Args:
        form: The format.

    Raises:
        ValueError: If it has no ending, or one without a dot or in upper case.

    Example:
        >>> register_format(StackFormat("portable", ("pgm",), open=lambda path: None))
        Traceback (most recent call last):
        ...
        ValueError: endings must be like '.tif', got 'pgm'
    """
    if not form.endings:
        raise ValueError(f"format {form.name!r} has no file ending")
    for ending in form.endings:
        if ending and (not ending.startswith(".") or ending != ending.lower()):
            raise ValueError(f"endings must be like '.tif', got {ending!r}")
    for ending in form.endings:
        _FORMATS[ending] = form


def find_format(path: Path) -> StackFormat:
    """The format of a path: by its ending; a folder of another ending, or a name without one, is a folder of images.

    Raises:
        ValueError: If nobody knows the ending.
    """
    form = _FORMATS.get(path.suffix.lower())
    if form is not None and (form.kind != "file" or not path.is_dir()):
        return form
    if path.is_dir():
        return _FORMATS[".zarr" if (path / "zarr.json").is_file() else ""]
    return target_format(path)


def target_format(path: Path) -> StackFormat:
    """The format to write a path in: its ending tells, whatever is there now.

    Raises:
        ValueError: If nobody knows the ending.
    """
    if path.suffix.lower() in _FORMATS:
        return _FORMATS[path.suffix.lower()]
    known = ", ".join(ending for ending in _FORMATS if ending)
    raise ValueError(f"{path}: unknown file ending {path.suffix!r}; expected {known} or a folder of PNG or TIFF files")


def needed_package(name: str, what: str, extra: str) -> Any:
    """Import a package that is not always installed.

    Raises:
        ModuleNotFoundError: If it is missing, naming the extra to install.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.partition(".")[0] != name.partition(".")[0]:
            raise
        raise ModuleNotFoundError(
            f"{what} needs the package {name.partition('.')[0]}; install rsvib_torch[{extra}]", name=error.name
        ) from error


def of_frames(info: StackInfo, count: int) -> StackInfo:
    """The same kind of stack with another number of frames."""
    times = info.frame_times if count == info.shape[0] else None
    return replace(info, shape=(count, *info.shape[1:]), frame_times=times)
