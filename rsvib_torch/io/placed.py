"""Stacks whose frames lie one after another in a file: read and written at their place."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = [
    "ArrayReader",
    "PlacedReader",
    "PlacedWriter",
    "check_frames_held",
    "frame_from_file_order",
    "frame_to_file_order",
]

_LEAST_HELD = 0.5  # of the frames that a header promises


def frame_from_file_order(frame: NDArray[Any], info: StackInfo) -> NDArray[Any]:
    """A frame as the file keeps it, turned to (H, W) or (C, H, W)."""
    return np.moveaxis(frame, -1, 0) if info.axes == "TCHW" and info.channels_last else frame


def frame_to_file_order(frame: NDArray[Any], info: StackInfo) -> NDArray[Any]:
    """Undo ``frame_from_file_order``."""
    frame = np.moveaxis(frame, 0, -1) if info.axes == "TCHW" and info.channels_last else frame
    return np.ascontiguousarray(frame, dtype=info.dtype)


def check_frames_held(info: StackInfo, offset: int, size: int, *, strict: bool = True) -> int:
    """Number of whole frames that a file of ``size`` bytes holds from ``offset`` on.

    Raises:
        ValueError: If these are less than half of what the header promises, or, when strict, not all.
    """
    frame_bytes = int(np.prod(info.shape[1:], dtype=object)) * np.dtype(info.dtype).itemsize
    needed, held = frame_bytes * info.shape[0], max(0, size - offset)
    whole = min(info.shape[0], held // frame_bytes)
    if whole < info.shape[0] and (strict or whole < _LEAST_HELD * info.shape[0]):
        raise ValueError(f"truncated: the header promises {needed} bytes of pixels, the file holds {held}")
    return int(whole)


class ArrayReader:
    """Frames of an array that is in memory, or mapped there.

    Args:
        info: What it holds.
        pixels: (T, H, W) or (T, C, H, W).
    """

    def __init__(self, info: StackInfo, pixels: NDArray[Any]) -> None:
        self.info, self._pixels = info, pixels

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        return np.array(self._pixels[index])

    def close(self) -> None:
        """Let go of the array."""


class PlacedReader:
    """Frames at equal distances in a file, read one at a time.

    Args:
        path: The file.
        info: What it holds.
        offset: Where its first frame begins.
        dtype: Type in the file, with its byte order.
        name: What the file is called in messages; its path if not given.
    """

    def __init__(self, path: Path, info: StackInfo, offset: int, dtype: np.dtype[Any], name: str = "") -> None:
        self.info = info
        self._name, self._offset, self._dtype = name or str(path), offset, dtype
        self._shape = info.stored_shape[1:]
        self._bytes = int(np.prod(self._shape)) * dtype.itemsize
        check_frames_held(info, offset, path.stat().st_size, strict=False)
        self._file = path.open("rb", buffering=0)

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        start = self._offset + index * self._bytes
        if start + self._bytes > os.fstat(self._file.fileno()).st_size:
            raise FrameError(f"{self._name}: truncated: frame {index} lies beyond the end of the file")
        pixels = np.empty(self._shape, self._dtype)
        view, done = memoryview(pixels.data).cast("B"), 0
        self._file.seek(start)
        while done < len(view):
            # read, not mapped: a file that shrinks meanwhile is an error then, not the end of the process
            count = self._file.readinto(view[done:])
            if not count:
                raise FrameError(f"{self._name}: truncated: frame {index} lies beyond the end of the file")
            done += count
        frame = frame_from_file_order(pixels, self.info)
        return frame.astype(frame.dtype.newbyteorder("="), copy=False)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


class PlacedWriter:
    """Frames written at equal distances into a file that has its full length from the start.

    Args:
        path: The file, made already.
        info: What it is to hold.
        offset: Where its first frame begins.
    """

    def __init__(self, path: Path, info: StackInfo, offset: int) -> None:
        self._info, self._offset = info, offset
        self._bytes = int(np.prod(info.shape[1:])) * np.dtype(info.dtype).itemsize
        self._file = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
        needed = offset + self._bytes * info.shape[0]
        if os.fstat(self._file).st_size < needed:
            os.ftruncate(self._file, needed)

    def reserve(self) -> "PlacedWriter":
        """Take the room on the disk now, so that a full disk is noticed before there is work to lose."""
        if hasattr(os, "posix_fallocate"):
            try:
                os.posix_fallocate(self._file, 0, self._offset + self._bytes * self._info.shape[0])
            except OSError as error:
                if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):
                    os.close(self._file)
                    raise
        return self

    def write(self, index: int, frame: NDArray[Any]) -> None:
        """Put a frame in its place."""
        data = memoryview(frame_to_file_order(frame, self._info).data).cast("B")
        os.lseek(self._file, self._offset + index * self._bytes, os.SEEK_SET)
        while len(data):
            data = data[os.write(self._file, data) :]

    def sync(self) -> None:
        """See that what was written is on the disk."""
        os.fdatasync(self._file) if hasattr(os, "fdatasync") else os.fsync(self._file)

    def close(self) -> None:
        """Finish the file."""
        os.close(self._file)
