"""Stacks whose frames lie one after another in a file: frames are read at their offsets."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.blocks import BlockReader
from rsvib_torch.io.stack_info import FrameError, StackInfo

BLOCK_BYTES = 1 << 26  # of frames that are read together; the whole file is read once per block
BAND_BYTES = 1 << 24  # of the file that are read at once, so that not the whole file is in memory


def check_frames_held(info: StackInfo, offset: int, size: int, *, fraction: float = 0.5) -> None:
    """Raise a ``ValueError`` if a file is too short for the stack that its header states.

    Args:
        info: The stack.
        offset: Position of its first pixel in bytes.
        size: Size of the file in bytes.
        fraction: Smallest fraction of frames that must be complete; missing frames are reported when they are read.
    """
    held = max(0, size - offset)
    if min(info.shape[0], held // info.frame_bytes) < fraction * info.shape[0]:
        needed = info.frame_bytes * info.shape[0]
        raise ValueError(f"truncated: the header states {needed} bytes of pixels, the file holds {held}")


class ContiguousReader:
    """Frames at equal distances in a file, read one at a time.

    Files are read instead of mapped into memory: if a mapped file shrinks, the access ends the process.

    Args:
        path: The file.
        info: The stack.
        offset: Position of the first frame in bytes.
        dtype: Data type in the file, with its byte order.

    Raises:
        ValueError: If the file holds less than half of the frames.
    """

    def __init__(self, path: Path, info: StackInfo, offset: int, dtype: np.dtype[Any]) -> None:
        self.info = info
        self._path, self._offset, self._dtype = path, offset, dtype
        check_frames_held(info, offset, path.stat().st_size)
        self._file = path.open("rb", buffering=0)

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        start, size = self._offset + index * self.info.frame_bytes, self.info.frame_bytes
        truncated = FrameError(f"{self._path}: truncated: frame {index} lies beyond the end of the file")
        if start + size > os.fstat(self._file.fileno()).st_size:
            raise truncated  # before memory is allocated
        pixels = np.empty(self.info.stored_shape[1:], self._dtype)
        if not _read_exactly(self._file, start, memoryview(pixels.data).cast("B")):
            raise truncated
        return self.info.from_stored(pixels)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _read_exactly(file: Any, start: int, buffer: memoryview) -> bool:
    """Fill a buffer with the bytes of a file from ``start`` on; whether the file holds them."""
    file.seek(start)
    done = 0
    while done < len(buffer):
        count = file.readinto(buffer[done:])
        if not count:
            return False
        done += count
    return True


class InterleavedReader(BlockReader):
    """Uncompressed frames whose pixels do not lie one after another, e.g. an array in Fortran order.

    Files are read instead of mapped into memory: mapped pages count as memory of the process.

    Args:
        path: The file.
        info: The stack.
        offset: Position of the first pixel in bytes.
        dtype: Data type in the file, with its byte order.
        shape: Shape of the array in the file, the last axis varies fastest.
        order: Permutation of its axes to (..., T, H, W) or (..., T, C, H, W) with leading axes of length 1.

    Raises:
        ValueError: If the file does not hold all frames.
    """

    def __init__(
        self,
        path: Path,
        info: StackInfo,
        offset: int,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
        order: tuple[int, ...],
    ) -> None:
        check_frames_held(info, offset, path.stat().st_size, fraction=1.0)
        # the pixels of a block in the order of the file, of which a part is read at a time
        super().__init__(path, info, max(1, BLOCK_BYTES // info.frame_bytes), info.frame_bytes + BAND_BYTES)
        self._offset, self._dtype, self._shape, self._order = offset, dtype, shape, order
        self._time = order[len(order) - len(info.shape)]
        self._file = path.open("rb", buffering=0)

    def read_block(self, first: int, last: int) -> NDArray[Any]:
        """Frames ``first`` to ``last`` (exclusive), (N, H, W) or (N, C, H, W)."""
        before, after = (math.prod(part) for part in (self._shape[: self._time], self._shape[self._time + 1 :]))
        count, size = self._shape[self._time], self._dtype.itemsize
        block = np.empty((before, last - first, after), self._dtype)
        run = count * after * size  # bytes between the same frame's pixels
        at_once = BAND_BYTES // run
        for begin in range(0, before, max(1, at_once)):
            part = block[begin : begin + max(1, at_once)]
            if at_once:
                band = np.empty((len(part), count, after), self._dtype)
                held = _read_exactly(self._file, self._offset + begin * run, memoryview(band.data).cast("B"))
                part[:] = band[:, first:last]
            else:
                start = self._offset + begin * run + first * after * size
                held = _read_exactly(self._file, start, memoryview(part.data).cast("B"))
            if not held:
                raise EOFError("truncated: its pixels lie beyond the end of the file")
        stored = (*self._shape[: self._time], last - first, *self._shape[self._time + 1 :])
        return block.reshape(stored).transpose(self._order).reshape(-1, *self.info.shape[1:])

    def close(self) -> None:
        """Close the file."""
        self._block = None
        self._file.close()
