"""Stacks in NumPy files, ``.npy``."""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np

from rsvib_torch.checks.arrays import channels_appear_last
from rsvib_torch.io.blocks import BlockReader, contiguous_reader
from rsvib_torch.io.full_scale import check_dtype
from rsvib_torch.io.stack_info import StackInfo, readable_stack
from rsvib_torch.io.stated_metadata import info_from_attributes
from rsvib_torch.numerics.tables import Array


def open_npy(path: Path) -> BlockReader:
    """Open (H, W), (T, H, W) or (T, C, H, W). Pickled objects are refused."""
    with readable_stack(path, ".npy"):
        with path.open("rb") as file:
            head = BytesIO(file.read(1 << 14))  # bytes; NumPy accepts headers of up to 10,000
        first = np.lib.format.read_magic(head) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read_header(head)
        check_dtype(dtype)
        if channels_appear_last(shape):
            raise ValueError(f"array of shape {shape} appears to have its channels last; store (T, C, H, W)")
        info = info_from_attributes({}, shape, dtype)
        if fortran_order:  # all frames together: the pixels of a frame lie everywhere in the file
            frames: Array = np.load(path, mmap_mode="r", allow_pickle=False).reshape(info.shape)
            return BlockReader(path, info, lambda *_: np.ascontiguousarray(frames), info.shape[0], info.frame_bytes)
        return contiguous_reader(path, info, head.tell(), dtype)


def write_npy(path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None) -> None:
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
