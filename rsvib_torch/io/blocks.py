"""Stacks whose frames are stored together: several frames are decoded at once, and each only once."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.stack_format import FrameReader
from rsvib_torch.io.stack_info import StackInfo, readable_frame


class BlockReader(FrameReader):
    """Frames that are read in blocks; a block is kept until its last frame has been read.

    Args:
        path: The stack.
        info: What its file states.
        together: Frames of a block.
        more_bytes: Memory that reading a block needs besides its pixels.
    """

    def __init__(self, path: Path, info: StackInfo, together: int, more_bytes: int = 0) -> None:
        self._path, self._together = path, min(together, info.shape[0])
        block_bytes = self._together * info.frame_bytes if self._together > 1 else 0
        self.info = replace(info, decoding_bytes=block_bytes + more_bytes)
        self._first = 0
        self._block: NDArray[Any] | None = None

    @abstractmethod
    def read_block(self, first: int, last: int) -> NDArray[Any]:
        """Frames ``first`` to ``last`` (exclusive), (N, H, W) or (N, C, H, W)."""

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        if self._block is None or not self._first <= index < self._first + len(self._block):
            self._block = None  # before the next block is allocated
            self._first = index - index % self._together
            last = min(self._first + self._together, self.info.shape[0])
            with readable_frame(self._path, index):
                self._block = self.read_block(self._first, last)
        alone = self._together == 1  # otherwise a view would keep the block in memory
        frame = np.array(self._block[index - self._first], self.info.dtype, order="C", copy=None if alone else True)
        if index == self._first + len(self._block) - 1:
            self._block = None
        return frame


class ArrayReader(BlockReader):
    """Frames of an array of HDF5 or Zarr, which is decoded in chunks.

    Args:
        path: The stack.
        info: What its file states.
        array: The array, (T, ...) or a single frame.
        chunk_frames: Frames of a chunk.
        more_bytes: As in ``BlockReader``.
        close: Closes its file.
    """

    def __init__(
        self,
        path: Path,
        info: StackInfo,
        array: Any,
        chunk_frames: int,
        more_bytes: int,
        close: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(path, info, chunk_frames, more_bytes)
        self._array, self._close = array, close

    def read_block(self, first: int, last: int) -> NDArray[Any]:
        """Frames ``first`` to ``last`` (exclusive), (N, H, W) or (N, C, H, W)."""
        frames = np.asarray(self._array[first:last] if self._array.ndim > 2 else self._array[...][None])
        return np.moveaxis(frames, -1, 1) if self.info.stored_axes == "THWC" else frames

    def close(self) -> None:
        """Close the file."""
        self._block = None
        self._close()
