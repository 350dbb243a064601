"""Stacks in files that are mapped into memory, read-only."""

import mmap
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.placed import check_frames_held
from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = ["MappedReader"]


class MappedReader:
    """Frames of an array in a mapped file; its pages are let go of after each.

    Args:
        path: The file.
        info: What it holds.
        offset: Where its first pixel is.
        dtype: Type in the file, with its byte order.
        order: ``"C"`` where frames lie one after another, ``"F"`` where the first axis runs fastest.

    Raises:
        ValueError: If the file holds less than half of what ``info`` promises, or, in order ``"F"``, not all.
    """

    def __init__(
        self, path: Path, info: StackInfo, offset: int, dtype: np.dtype[Any], order: Literal["C", "F"]
    ) -> None:
        self.info, self._path = info, path
        self._held = check_frames_held(info, offset, path.stat().st_size, strict=order == "F")
        self._file = path.open("rb", buffering=0)
        try:
            self._map = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
            shape = (self._held, *info.shape[1:])
            self._pixels: NDArray[Any] | None = np.ndarray(shape, dtype, self._map, offset, order=order)
        except BaseException:
            self._file.close()
            raise
        self._first_end = offset + (self._pixels.nbytes if order == "F" else self._pixels[0].nbytes)
        self._step = 0 if order == "F" else self._pixels[0].nbytes

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        # to touch what has been cut off would end the process, so the length is looked at just before
        held = index < self._held and self._first_end + index * self._step <= os.fstat(self._file.fileno()).st_size
        if self._pixels is None or not held:
            raise FrameError(f"{self._path}: truncated: frame {index} lies beyond the end of the file")
        frame: NDArray[Any] = np.array(self._pixels[index], dtype=self._pixels.dtype.newbyteorder("="), order="C")
        if hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED)
        return frame

    def close(self) -> None:
        """Let go of the file."""
        self._pixels = None
        self._map.close()
        self._file.close()
