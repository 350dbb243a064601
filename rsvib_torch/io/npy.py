"""Stacks in NumPy ``.npy`` files, mapped into memory to be read."""

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rsvib_torch.io.formats import StackFormat, register_format
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.mapped import MappedReader
from rsvib_torch.io.placed import PlacedWriter
from rsvib_torch.io.stack_info import StackInfo

__all__ = ["create_array", "open_array"]


def _stack_shape(shape: tuple[int, ...], path: Path) -> tuple[int, ...]:
    if len(shape) == 2:
        return (1, *shape)
    if len(shape) not in (3, 4) or min(shape) < 1:
        raise ValueError(f"{path}: array has shape {shape}; expected (H, W), (T, H, W) or (T, C, H, W)")
    if len(shape) == 4 and shape[-1] <= 4 < shape[1]:
        raise ValueError(f"{path}: array has shape {shape}; channels go second, (T, C, H, W)")
    return shape


def _read_header(file: BinaryIO, path: Path) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Shape, whether the first axis runs fastest, dtype, and where the pixels begin."""
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, columns_first, dtype = read(file)
        check_dtype(dtype)
        if any(not isinstance(size, int) or size < 0 for size in shape):
            raise ValueError(f"its shape is {shape}")
    except Exception as error:  # a damaged header can fail anywhere in its parser
        raise ValueError(f"{path}: not a readable .npy file ({' '.join(str(error).split())})") from error
    return shape, columns_first, dtype, file.tell()


def open_array(path: Path) -> MappedReader:
    """Map a ``.npy`` file: (H, W), (T, H, W) or (T, C, H, W). Pickled objects are refused."""
    with path.open("rb") as file:
        shape, columns_first, dtype, offset = _read_header(file, path)
    info = StackInfo(_stack_shape(shape, path), dtype.name, known_full_scale(dtype))
    try:
        return MappedReader(path, info, offset, dtype, "F" if columns_first else "C")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def create_array(path: Path, info: StackInfo, fresh: bool) -> PlacedWriter:
    """Make a ``.npy`` file, or go on with one; it has no room for the full scale."""
    if fresh:
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype(info.dtype)), "fortran_order": False}
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {**header, "shape": info.shape})
            return PlacedWriter(path, info, file.tell()).reserve()
    with path.open("rb") as file:
        return PlacedWriter(path, info, _read_header(file, path)[3])


def _check(path: Path, info: StackInfo) -> None:
    if len(info.shape) == 4 and info.shape[-1] <= 4 < info.shape[1]:
        raise ValueError(f"{path}: array of shape {info.shape} would be taken for one with channels last")


register_format(StackFormat("npy", (".npy",), open_array, create_array, check=_check))
