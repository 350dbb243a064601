"""Stacks in NumPy files, ``.npy``."""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np

from rsvib_torch.io.frame_reader import FrameReader, contiguous_reader, readable_stack
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.stated_metadata import info_of_array
from rsvib_torch.numerics.tables import Array


def open_npy(path: Path) -> FrameReader:
    """Open (H, W), (T, H, W) or (T, C, H, W). Pickled objects are refused."""
    with readable_stack(path, ".npy"):
        with path.open("rb") as file:
            head = BytesIO(file.read(1 << 14))  # bytes; NumPy accepts headers of up to 10,000
        first = np.lib.format.read_magic(head) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read_header(head)
        info = info_of_array(shape, dtype)
        if fortran_order:  # the pixels of a frame lie everywhere in the file
            raise ValueError("the array has Fortran order; store numpy.ascontiguousarray(array)")
        return contiguous_reader(path, info, head.tell(), dtype)


def write_npy(path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None) -> None:
    """Write a file frame by frame, channels second; arguments as in ``StackFormat.write``."""
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(info.dtype)), "fortran_order": False, "shape": info.shape}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for frame in frames:
            file.write(np.ascontiguousarray(frame).data)
