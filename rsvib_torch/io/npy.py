"""Stacks in NumPy ``.npy`` files; the file has no room for the full scale."""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.arrays import channels_appear_last
from rsvib_torch.io.blocks import BlockReader, contiguous_reader
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.stack_info import StackInfo, readable_stack


def open_npy(path: Path) -> BlockReader:
    """Open (H, W), (T, H, W) or (T, C, H, W). Pickled objects are refused."""
    with readable_stack(path, ".npy"):
        with path.open("rb") as file:
            head = BytesIO(file.read(1 << 14))  # bytes; NumPy accepts headers of up to 10,000
        first = np.lib.format.read_magic(head) == (1, 0)
        read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read(head)
        check_dtype(dtype)
        if len(shape) == 2:
            shape = (1, *shape)
        if len(shape) not in (3, 4) or min(shape) < 1:
            raise ValueError(f"array has shape {shape}; expected (H, W), (T, H, W) or (T, C, H, W)")
        if channels_appear_last(shape):
            raise ValueError(f"array of shape {shape} appears to have its channels last; store (T, C, H, W)")
        info = StackInfo(shape, dtype.name, known_full_scale(dtype))
        reader = contiguous_reader(path, info, head.tell(), dtype)
        if not fortran_order:
            return reader
        reader.close()
        # all frames together: the pixels of a frame lie everywhere in the file
        return BlockReader(
            path, info, lambda *_: np.load(path, allow_pickle=False).reshape(shape), shape[0], info.frame_bytes
        )


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
