"""Stacks in NumPy ``.npy`` files."""

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.stacks.info import StackInfo
from rsvib_torch.stacks.scale import check_dtype, known_full_scale

__all__ = ["read_array", "read_array_info", "write_array"]


def _stack_shape(shape: tuple[int, ...], path: Path) -> tuple[int, ...]:
    if len(shape) == 2:
        return (1, *shape)
    if len(shape) not in (3, 4) or min(shape) < 1:
        raise ValueError(f"{path}: array has shape {shape}; expected (H, W), (T, H, W) or (T, C, H, W)")
    if len(shape) == 4 and shape[-1] <= 4 < shape[1]:
        raise ValueError(f"{path}: array has shape {shape}; channels go second, (T, C, H, W)")
    return shape


def _read_header(file: BinaryIO, path: Path) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype, with the file's size checked against them before anything is allocated."""
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        check_dtype(dtype)
    except Exception as error:  # a damaged header can fail anywhere in its parser
        raise ValueError(f"{path}: not a readable .npy file ({' '.join(str(error).split())})") from error
    needed = dtype.itemsize
    for size in shape:
        needed *= size
    held = path.stat().st_size - file.tell()
    if held < needed:
        raise ValueError(f"{path}: truncated: the header promises {needed} bytes of pixels, the file holds {held}")
    return shape, dtype


def read_array_info(path: Path) -> StackInfo:
    """What the header of a ``.npy`` file says."""
    with path.open("rb") as file:
        shape, dtype = _read_header(file, path)
    return StackInfo(_stack_shape(shape, path), dtype.name, known_full_scale(dtype))


def read_array(path: Path) -> tuple[NDArray[Any], StackInfo]:
    """Pixels as stored, (T, H, W) or (T, C, H, W). Pickled objects are refused."""
    info = read_array_info(path)
    pixels: NDArray[Any] = np.load(path, allow_pickle=False)
    return pixels.reshape(info.shape), info


def write_array(path: Path, pixels: NDArray[Any], full_scale: float | None) -> None:
    """Write pixels as they are; a ``.npy`` file has no room for the full scale."""
    np.save(path, pixels, allow_pickle=False)
