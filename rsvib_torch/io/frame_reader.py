"""An open stack, whose frames are read in any order."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.numerics.tables import Array
from rsvib_torch.text import one_line


class FrameError(ValueError):
    """One frame of a stack cannot be read; the other frames may be readable."""


class FrameReader:
    """Frames that ``read(index)`` returns, (H, W) or (C, H, W)."""

    def __init__(
        self, path: Path, info: StackInfo, read: Callable[[int], Array], close: Callable[[], None] = lambda: None
    ) -> None:
        self.path, self.info, self._read, self._close = path, info, read, close

    def frame(self, index: int) -> Array:
        """Pixels of a frame as stored: (H, W) or (C, H, W), in ``info.dtype``; ``FrameError`` if it is damaged."""
        try:
            return np.ascontiguousarray(self._read(index), self.info.dtype)
        except (MemoryError, FrameError, FileNotFoundError):
            raise
        except Exception as error:  # decoders raise errors of many types
            raise FrameError(f"{self.path}: frame {index} cannot be read: {one_line(error)}") from error

    def close(self) -> None:
        """Close the file, if it is open between frames."""
        self._close()


def contiguous_reader(
    path: Path, info: StackInfo, offset: int, dtype: np.dtype, *, channels_last: bool = False
) -> FrameReader:
    """Reader of frames of a ``dtype`` with its byte order that lie one after another in a file from an ``offset`` on.

    Files are read instead of mapped into memory: if a mapped file shrinks, the access ends the process. A file that
    holds less than half of the frames is refused; others are reported when they are read.
    """
    size, held = info.frame_bytes, max(0, path.stat().st_size - offset)
    if held // size < 0.5 * info.shape[0]:
        raise ValueError(f"truncated: the header states {size * info.shape[0]} bytes of pixels, the file holds {held}")
    file = path.open("rb")

    def read(index: int) -> Array:
        start, pixels = offset + index * size, np.empty(0, dtype)
        if start + size <= os.fstat(file.fileno()).st_size:  # before memory is allocated
            file.seek(start)
            pixels = np.fromfile(file, dtype, size // dtype.itemsize)
        if pixels.nbytes < size:
            raise FrameError(f"{path}: truncated: frame {index} lies beyond the end of the file")
        if channels_last:
            return np.moveaxis(pixels.reshape(*info.shape[2:], info.shape[1]), -1, 0)
        return pixels.reshape(info.shape[1:])

    return FrameReader(path, info, read, file.close)


def part_reader(reader: FrameReader, start: int, end: int | None) -> FrameReader:
    """Reader of frames ``start`` to ``end`` (exclusive; None for the last) of an open stack."""
    info, count = reader.info, reader.info.shape[0]
    last = count if end is None else end
    if not start < last <= count:
        reader.close()
        raise ValueError(
            f"{info.path}: frames {start}:{'' if end is None else end} of a stack of {count} frames; expected "
            f"START:END with START < END <= {count}"
        )
    numbers = None if info.frame_numbers is None else info.frame_numbers[start:last]
    part = replace(
        info,
        shape=(last - start, *info.shape[1:]),
        frame_times=None if info.frame_times is None else info.frame_times[start:last],
        frame_numbers=None if numbers is None else tuple(number - numbers[0] for number in numbers),
        files=None if info.files is None else info.files[start:last],
        path=None,  # the sound of a video is not that of a part
    )

    return FrameReader(reader.path, part, lambda index: reader.frame(start + index), reader.close)


_LARGEST_RATIO = 8800  # of pixels to stored bytes: deflate reaches 1032, and PNG files may have 1 bit per byte


def check_held(pixels: int, stored: int) -> None:
    """Raise a ``ValueError`` if bytes of pixels cannot be in a number of stored bytes, before memory is allocated."""
    if pixels > _LARGEST_RATIO * stored:
        raise ValueError(f"its header states {pixels} bytes of pixels, which {stored} bytes cannot hold")


@contextmanager
def readable_stack(path: Path, kind: str) -> Iterator[None]:
    """Convert any exception of a decoder of a ``kind`` of files into a ``ValueError``, except a missing permission."""
    if not path.is_dir():
        path.open("rb").close()
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: not a readable {kind} stack: {one_line(error)}") from error
