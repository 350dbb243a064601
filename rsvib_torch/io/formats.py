"""The table of stack formats, and the choice of a format by the ending of a file name.

The table is data. The module that reads and writes a format is imported when a stack of that format is opened, checked
or written: see ``in_module``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from rsvib_torch.io.stack_format import StackFormat

__all__ = ["FORMATS", "find_format", "in_module", "register_format", "target_format"]


@dataclass(frozen=True)
class _InModule:
    """Function of a module of this package that is imported at the first call."""

    module: str
    name: str

    def __call__(self, *arguments: Any) -> Any:
        return getattr(import_module(self.module), self.name)(*arguments)


def in_module(module: str, name: str) -> Callable[..., Any]:
    """A function that imports its module when it is called: reading a TIFF file imports no other format.

    ``tests/test_imports.py`` reads the calls of this function as imports.

    Args:
        module: Full name of the module.
        name: Name of the function or class.

    Example:
        >>> in_module("math", "sqrt")(9.0)
        3.0
    """
    return _InModule(module, name)


_KEPT = ("full_scale", "frame_times", "orientation", "resolution")
_KEPT_BY_PNG = ("full_scale", "orientation", "resolution")
_KEPT_BY_VIDEO = ("full_scale", "frame_times", "orientation")

# Entries: name, endings, and functions of the contract in ``stack_format.py``. The order is that of error messages.
_FORMATS_OF_THE_PACKAGE = (
    StackFormat(
        "npy",
        (".npy",),
        in_module("rsvib_torch.io.npy", "open_npy"),
        in_module("rsvib_torch.io.npy", "create_npy"),
        check=in_module("rsvib_torch.io.npy", "check_npy"),
    ),
    StackFormat(
        "hdf5",
        (".h5", ".hdf5", ".hdf"),
        in_module("rsvib_torch.io.hdf5", "open_hdf5"),
        in_module("rsvib_torch.io.hdf5", "create_hdf5"),
        keeps=_KEPT,
    ),
    StackFormat("jpeg", (".jpg", ".jpeg"), in_module("rsvib_torch.io.image_folder", "ImagesReader")),
    StackFormat(
        "png",
        (".png",),
        in_module("rsvib_torch.io.image_folder", "ImagesReader"),
        in_module("rsvib_torch.io.image_folder", "create_image"),
        dtypes=("uint8", "uint16"),
        check=in_module("rsvib_torch.io.image_folder", "check_image"),
        keeps=_KEPT_BY_PNG,
    ),
    StackFormat(
        "image folder",
        ("",),
        in_module("rsvib_torch.io.image_folder", "ImagesReader"),
        in_module("rsvib_torch.io.image_folder", "create_folder"),
        check=in_module("rsvib_torch.io.image_folder", "check_folder"),
        kind="folder",
        keeps=_KEPT_BY_PNG,
    ),
    StackFormat(
        "raw",
        (".raw",),
        in_module("rsvib_torch.io.raw", "open_raw"),
        in_module("rsvib_torch.io.raw", "create_raw"),
        companions=(".json",),
        keeps=_KEPT,
    ),
    StackFormat(
        "tiff",
        (".tif", ".tiff"),
        in_module("rsvib_torch.io.tiff", "open_tiff"),
        in_module("rsvib_torch.io.tiff", "create_tiff"),
        in_module("rsvib_torch.io.tiff", "write_tiff"),
        compressions=("zlib", "lzma"),
        keeps=(*_KEPT, "metadata"),
    ),
    StackFormat(
        "FFV1 video",
        (".mkv", ".avi"),
        in_module("rsvib_torch.io.video", "VideoReader"),
        write_all=in_module("rsvib_torch.io.video", "write_video"),
        dtypes=("uint8", "uint16"),
        check=in_module("rsvib_torch.io.video", "check_video"),
        keeps=_KEPT_BY_VIDEO,
    ),
    StackFormat(
        "H.264 video",
        (".mp4", ".mov", ".m4v"),
        in_module("rsvib_torch.io.video", "VideoReader"),
        write_all=in_module("rsvib_torch.io.video", "write_video"),
        check=in_module("rsvib_torch.io.video", "check_video"),
        keeps=_KEPT_BY_VIDEO,
    ),
    StackFormat(
        "webm, mpeg, 3gp and wmv",
        (".webm", ".3gp", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv"),
        in_module("rsvib_torch.io.video", "VideoReader"),
    ),
    StackFormat(
        "zarr",
        (".zarr",),
        in_module("rsvib_torch.io.zarr_store", "open_zarr"),
        in_module("rsvib_torch.io.zarr_store", "create_zarr"),
        kind="tree",
        marker="zarr.json",
        keeps=_KEPT,
    ),
)
FORMATS: dict[str, StackFormat] = {ending: form for form in _FORMATS_OF_THE_PACKAGE for ending in form.endings}
"""Format of every file ending."""


def register_format(form: StackFormat) -> None:
    """Register a format for reading and writing stacks; it replaces earlier formats of the same endings.

    Args:
        form: The format; see the contract in ``stack_format.py``.

    Raises:
        ValueError: If it has no ending, or one without a dot or in upper case.

    Example:
        >>> register_format(StackFormat("portable", ("pgm",), open=lambda path: None))
        Traceback (most recent call last):
        ...
        ValueError: endings must be like '.tif', got 'pgm'
    """
    if not form.endings:
        raise ValueError(f"format {form.name!r} has no file ending; expected at least one, like '.tif'")
    for ending in form.endings:
        if ending and (not ending.startswith(".") or ending != ending.lower()):
            raise ValueError(f"endings must be like '.tif', got {ending!r}")
    FORMATS.update(dict.fromkeys(form.endings, form))


def find_format(path: Path) -> StackFormat:
    """The format of an existing stack: by its ending, of a folder also by its marker file, else a folder of images.

    Raises:
        ValueError: If the ending is not registered.
    """
    if not path.is_dir():
        return target_format(path)
    by_ending = FORMATS.get(path.suffix.lower())
    if by_ending is not None and by_ending.kind != "file":
        return by_ending
    marked = (form for form in FORMATS.values() if form.marker and (path / form.marker).is_file())
    return next(marked, FORMATS[""])


def target_format(path: Path) -> StackFormat:
    """The format in which a path is written, by its ending only.

    Raises:
        ValueError: If the ending is not registered.
    """
    if path.suffix.lower() in FORMATS:
        return FORMATS[path.suffix.lower()]
    known = ", ".join(ending for ending in FORMATS if ending)
    raise ValueError(
        f"{path}: unknown file ending {path.suffix!r}; expected {known} or a folder of PNG, TIFF or JPEG files"
    )
