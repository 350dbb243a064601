"""Stacks whose frames lie one after another in a file: frames are read and written at their offsets."""

import errno
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = ["ContiguousReader", "ContiguousWriter", "check_frames_held"]


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
        view, done = memoryview(pixels.data).cast("B"), 0
        self._file.seek(start)
        while done < size:
            count = self._file.readinto(view[done:])
            if not count:
                raise truncated
            done += count
        return self.info.from_stored(pixels)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class ContiguousWriter:
    """Frames written at equal distances into a file that has its full length from the start.

    Args:
        path: The file, which exists already.
        info: The stack.
        offset: Position of the first frame in bytes.
        fresh: Whether the file is new: it gets its full length, and the space on the disk is allocated, so that a full
            disk is an error before any work.
        beside: Other files of the stack.
    """

    def __init__(self, path: Path, info: StackInfo, offset: int, *, fresh: bool, beside: Sequence[Path] = ()) -> None:
        self._info, self._offset, self._beside = info, offset, beside
        self._file = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
        needed = offset + info.frame_bytes * info.shape[0]
        if fresh and os.fstat(self._file).st_size < needed:
            os.ftruncate(self._file, needed)
        if fresh and hasattr(os, "posix_fallocate"):
            try:
                os.posix_fallocate(self._file, 0, needed)
            except OSError as error:
                if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):
                    os.close(self._file)
                    raise

    def write(self, index: int, frame: NDArray[Any]) -> None:
        """Write a frame at its position."""
        data = memoryview(self._info.to_stored(frame).data).cast("B")
        os.lseek(self._file, self._offset + index * self._info.frame_bytes, os.SEEK_SET)
        while len(data):
            data = data[os.write(self._file, data) :]

    def sync(self) -> None:
        """Return when all written data are on the disk."""
        os.fdatasync(self._file) if hasattr(os, "fdatasync") else os.fsync(self._file)

    def stored(self, index: int | None) -> Iterator[bytes]:
        """Bytes of a frame; for None those of the rest of the file, and of the files beside it."""
        size = self._info.frame_bytes
        if index is not None:
            yield from self._blocks(self._offset + index * size, size)
            return
        yield from self._blocks(0, self._offset)
        end = self._offset + self._info.shape[0] * size
        yield from self._blocks(end, os.fstat(self._file).st_size - end)
        for path in self._beside:
            yield path.read_bytes()

    def _blocks(self, start: int, size: int) -> Iterator[bytes]:
        """Blocks of up to 1 MiB: a damaged header may state any size."""
        while size > 0 and (block := os.pread(self._file, min(size, 1 << 20), start)):
            yield block
            start, size = start + len(block), size - len(block)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)
