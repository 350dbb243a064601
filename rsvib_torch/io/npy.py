"""Stacks in NumPy ``.npy`` files; the file has no room for the full scale."""

import mmap
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.frames.arrays import channels_appear_last
from rsvib_torch.io.contiguous import ContiguousReader, ContiguousWriter, check_frames_held
from rsvib_torch.io.formats import StackFormat
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.stack_info import FrameError, StackInfo, readable_stack

__all__ = ["FORMAT"]


class _FortranOrderReader:
    """Frames of an array whose first axis varies fastest, in a file that is mapped into memory.

    Arguments are those of ``ContiguousReader``; the file must hold all frames.
    """

    def __init__(self, path: Path, info: StackInfo, offset: int, dtype: np.dtype[Any]) -> None:
        self.info, self._path = info, path
        check_frames_held(info, offset, path.stat().st_size, fraction=1.0)
        self._file = path.open("rb", buffering=0)
        try:
            self._map = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
            self._pixels: NDArray[Any] | None = np.ndarray(info.shape, dtype, self._map, offset, order="F")
        except BaseException:
            self._file.close()
            raise
        self._end = offset + self._pixels.nbytes

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        # reading a mapped page beyond the end of the file would end the process
        if self._pixels is None or os.fstat(self._file.fileno()).st_size < self._end:
            raise FrameError(f"{self._path}: truncated: frame {index} lies beyond the end of the file")
        frame: NDArray[Any] = np.array(self._pixels[index], dtype=self._pixels.dtype.newbyteorder("="), order="C")
        if hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED)  # else the pages read so far stay in memory
        return frame

    def close(self) -> None:
        """Close the file."""
        self._pixels = None
        self._map.close()
        self._file.close()


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Shape, whether the first axis varies fastest, data type, and position of the first pixel."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = read(file)
    check_dtype(dtype)
    if any(not isinstance(size, int) or size < 0 for size in shape):
        raise ValueError(f"its shape is {shape}")
    return shape, fortran_order, dtype, file.tell()


def _open(path: Path) -> ContiguousReader | _FortranOrderReader:
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
        return (_FortranOrderReader if fortran_order else ContiguousReader)(path, info, offset, dtype)


def _create(path: Path, info: StackInfo, fresh: bool) -> ContiguousWriter:
    if fresh:
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype(info.dtype)), "fortran_order": False}
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {**header, "shape": info.shape})
    with path.open("rb") as file:
        offset = _read_header(file)[3]
    # channels are always stored second, whatever the input was
    return ContiguousWriter(path, replace(info, channels_last=False), offset, fresh=fresh)


def _check(path: Path, info: StackInfo) -> None:
    if channels_appear_last(info.shape):
        raise ValueError(f"{path}: array of shape {info.shape} would be read as one with channels last; write .tif")


FORMAT = StackFormat("npy", (".npy",), _open, _create, check=_check)
