"""Reading and writing stacks: the file ending chooses the format."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.stacks.arrays import read_array, read_array_info, write_array
from rsvib_torch.stacks.atomic import check_writable, whole_file, whole_folder
from rsvib_torch.stacks.info import StackInfo
from rsvib_torch.stacks.png import check_png_folder, read_png, read_png_info, write_png, write_png_folder
from rsvib_torch.stacks.scale import check_full_scale, counts_to_frames, frames_to_counts, known_full_scale
from rsvib_torch.stacks.tiff import read_tiff, read_tiff_info, write_tiff
from rsvib_torch.stacks.video import read_video, read_video_info

__all__ = ["check_stack_target", "read_stack", "read_stack_info", "write_stack"]

PathLike = str | os.PathLike[str]
_Reader = Callable[[Path], tuple[NDArray[Any], StackInfo]]
_Writer = Callable[[Path, NDArray[Any], float | None], None]

_FORMATS = {
    ".tif": "tiff",
    ".tiff": "tiff",
    ".png": "png",
    "": "png folder",
    ".npy": "npy",
    ".avi": "video",
    ".mp4": "video",
    ".m4v": "video",
    ".mov": "video",
    ".mkv": "video",
    ".webm": "video",
}
_READERS: dict[str, tuple[_Reader, Callable[[Path], StackInfo]]] = {
    "tiff": (read_tiff, read_tiff_info),
    "png": (read_png, read_png_info),
    "png folder": (read_png, read_png_info),
    "npy": (read_array, read_array_info),
    "video": (read_video, read_video_info),
}
_WRITERS: dict[str, _Writer] = {
    "tiff": write_tiff,
    "png": write_png,
    "png folder": write_png_folder,
    "npy": write_array,
}
_TYPES: dict[str, tuple[str, ...]] = {
    "tiff": ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64"),
    "png": ("uint8", "uint16"),
    "png folder": ("uint8", "uint16"),
    "npy": ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64"),
}


def _format(path: Path) -> str:
    ending = path.suffix.lower()
    if ending not in _FORMATS:
        known = ", ".join(e for e in _FORMATS if e)
        raise ValueError(f"{path}: unknown file ending {ending!r}; expected {known} or a folder of PNG files")
    return _FORMATS[ending]


def _readers(path: Path) -> tuple[_Reader, Callable[[Path], StackInfo]]:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    return _READERS["png folder" if path.is_dir() else _format(path)]


def read_stack_info(path: PathLike) -> StackInfo:
    """Read shape, data type and full scale of a stack without its pixels.

    Args:
        path: As in ``read_stack``.

    Returns:
        What the file says of itself; ``full_scale`` is None where it does not say.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not a readable stack.
    """
    path = Path(path)
    return _readers(path)[1](path)


def read_stack(path: PathLike, *, full_scale: float | None = None) -> Tensor:
    """Read a stack of frames from a file.

    The ending chooses the format: TIFF (``.tif``, ``.tiff``; one or many pages), ``.npy`` with (H, W), (T, H, W) or
    (T, C, H, W), a video (three channels always, RGB), a single ``.png``, or a folder of PNG files in natural order
    (frame9 before frame10). Colour images have their channels in the order of the file, RGB or RGBA.

    Integers become floats whose full scale is 1. ``full_scale`` given here comes first, then what ``write_stack``
    stated in the file, then 255 for ``uint8``; other integers do not say theirs (16 bits may hold 12-bit counts).
    Floats keep their values, whatever ``full_scale`` says, and may be NaN or infinite here: processing refuses them.

    Args:
        path: The file or folder.
        full_scale: Count that means 1.0.

    Returns:
        float32 frames, (T, H, W) or (T, C, H, W).

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is damaged, its frames differ in size, or the full scale is unknown or exceeded.
    """
    path = Path(path)
    pixels, info = _readers(path)[0](path)
    return counts_to_frames(pixels, info.full_scale if full_scale is None else full_scale, str(path))


def check_stack_target(
    path: PathLike, shape: tuple[int, ...], *, dtype: str | None = None, full_scale: float | None = None
) -> float | None:
    """Raise what ``write_stack`` would raise for frames of this shape, before there are any.

    Args:
        path: The file or folder to write.
        shape: (T, H, W) or (T, C, H, W).
        dtype: As in ``write_stack``.
        full_scale: As in ``write_stack``.

    Returns:
        The full scale that would be used; None for floats.
    """
    path = Path(path)
    form = _format(path)
    if form not in _WRITERS:
        raise ValueError(f"{path}: videos are only read; write .tif, .png, .npy or a folder of PNG files")
    name = np.dtype(dtype or np.float32).name
    if name not in _TYPES[form]:
        raise ValueError(f"{path}: {form} files hold {', '.join(_TYPES[form])}; got dtype {name}")
    if len(shape) not in (3, 4) or min(shape) < 1:
        raise ValueError(f"frames must have shape (T, H, W) or (T, C, H, W), got {tuple(shape)}")
    if form.startswith("png") and len(shape) == 4 and shape[1] not in (1, 3, 4):
        raise ValueError(f"{path}: PNG files hold 1, 3 or 4 channels, got {shape[1]}")
    if form == "png" and shape[0] != 1:
        raise ValueError(f"{path}: a PNG file holds one frame, got {shape[0]}; name a folder instead")
    if form == "png folder":
        check_png_folder(path, shape[0])
    check_writable(path, folder=form == "png folder")
    kind = np.dtype(name)
    if kind.kind == "f":
        return None
    scale = known_full_scale(kind) if full_scale is None else check_full_scale(full_scale, kind)
    if scale is None:
        raise ValueError(f"full_scale must be stated to write {kind} frames, e.g. 4095 for 12-bit counts")
    return scale


def write_stack(path: PathLike, frames: Tensor, *, dtype: str | None = None, full_scale: float | None = None) -> None:
    """Write a stack of frames whose full scale is 1.

    The ending chooses the format as in ``read_stack``; a path without one is a folder of PNG files
    (frame_0000.png ...). Integers are scaled by the full scale, rounded and clipped to 0 ... full scale, so that
    12-bit counts come back as 12-bit counts; TIFF and PNG files state the full scale for the next reader. The file
    appears whole or not at all.

    Args:
        path: The file or folder to write.
        frames: (T, H, W) or (T, C, H, W), floating point.
        dtype: NumPy name of the type in the file, by default ``"float32"``.
        full_scale: Count to write for 1.0; 255 for ``"uint8"`` if not given, to be stated for other integers. Floats
            keep their values.

    Raises:
        OSError: If the file cannot be written.
        TypeError: If the frames are not a floating-point tensor.
        ValueError: If the format cannot hold them, or the full scale is not stated.
    """
    path = Path(path)
    if not isinstance(frames, Tensor) or not frames.dtype.is_floating_point:
        kind = getattr(frames, "dtype", type(frames).__name__)
        raise TypeError(f"frames must be a floating-point tensor whose full scale is 1, got {kind}")
    full_scale = check_stack_target(path, tuple(frames.shape), dtype=dtype, full_scale=full_scale)
    pixels = frames_to_counts(frames, np.dtype(dtype or np.float32), full_scale)
    form = _format(path)
    with (whole_folder if form == "png folder" else whole_file)(path) as part:
        _WRITERS[form](part, pixels, full_scale)
