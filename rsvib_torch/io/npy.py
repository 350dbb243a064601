"""Stacks in NumPy ``.npy`` files; the file has no room for the full scale."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.arrays import channels_appear_last
from rsvib_torch.io.contiguous import ContiguousReader, InterleavedReader
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.stack_info import StackInfo, readable_stack

_MAX_HEADER_BYTES = 10_000  # as in numpy, which reads the header before it compares


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Shape, whether the first axis varies fastest, data type, and position of the first pixel."""
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        start = file.tell()
        length = int.from_bytes(file.read(4), "little")
        file.seek(start)
        if length > _MAX_HEADER_BYTES:
            raise ValueError(f"its header has {length} bytes; expected at most {_MAX_HEADER_BYTES}")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = read(file)
    check_dtype(dtype)
    if any(not isinstance(size, int) or size < 0 for size in shape):
        raise ValueError(f"its shape is {shape}")
    return shape, fortran_order, dtype, file.tell()


def open_npy(path: Path) -> ContiguousReader | InterleavedReader:
    """Open (H, W), (T, H, W) or (T, C, H, W). Pickled objects are refused."""
    with readable_stack(path, ".npy"):
        with path.open("rb") as file:
            shape, fortran_order, dtype, offset = _read_header(file)
        if len(shape) == 2:
            shape = (1, *shape)
        if len(shape) not in (3, 4) or min(shape) < 1:
            raise ValueError(f"array has shape {shape}; expected (H, W), (T, H, W) or (T, C, H, W)")
        if channels_appear_last(shape):
            raise ValueError(f"array of shape {shape} appears to have its channels last; store (T, C, H, W)")
        info = StackInfo(shape, dtype.name, known_full_scale(dtype))
        if fortran_order:
            axes = tuple(range(len(shape)))
            return InterleavedReader(path, info, offset, dtype, shape[::-1], axes[::-1])
        return ContiguousReader(path, info, offset, dtype)


def write_npy(path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None) -> None:
    """Write a file frame by frame, channels second; arguments as in ``StackFormat.write``."""
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(info.dtype)), "fortran_order": False, "shape": info.shape}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for frame in frames:
            file.write(np.ascontiguousarray(frame).data)


def check_npy(path: Path, info: StackInfo) -> None:
    """Refuse a shape that would be read as another one."""
    if channels_appear_last(info.shape):
        raise ValueError(f"{path}: array of shape {info.shape} would be read as one with channels last; write .tif")
