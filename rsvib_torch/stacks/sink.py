"""The stack that a run writes: in its place at once, or kept window by window until all are there."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.atomic import move_into_place
from rsvib_torch.io.formats import FrameWriter, StackFormat
from rsvib_torch.io.stack_info import StackInfo

__all__ = ["Sink"]


class Sink:
    """Frames of a run on their way into a file.

    Where the format lets frames be put in any order and their number is known, they go to their place at once. Else
    those of every window wait in a file of their own.

    Args:
        path: The stack to write.
        folder: Folder for the work; what is in it is found again by a run that goes on.
        form: Format of the stack.
        info: What it will hold; the number of frames is the largest that there can be.
        sure: Whether there will be so many frames.
        compression: As in ``write_stack``.
        fresh: Whether to begin, or to go on.
    """

    def __init__(
        self,
        path: Path,
        folder: Path,
        form: StackFormat,
        info: StackInfo,
        *,
        sure: bool,
        compression: str | None,
        fresh: bool,
    ) -> None:
        self._path, self._form, self._info, self._compression = path, form, info, compression
        self._part, self._staged = folder / path.name, folder / "windows"
        self._writer: FrameWriter | None = None
        if form.create is not None and compression is None and sure:
            if self._part.exists() or fresh:
                self._writer = form.create(self._part, info, fresh)
        elif fresh:
            self._staged.mkdir()

    def put(self, window: int, first: int, frames: list[NDArray[Any]]) -> None:
        """Write the frames of a window, and see that they are on the disk.

        Args:
            window: Number of the window.
            first: Number of its first frame in the file.
            frames: Pixels as stored.
        """
        if self._writer is not None:
            for index, frame in enumerate(frames, start=first):
                self._writer.write(index, frame)
            self._writer.sync()
        elif frames:
            part = self._staged / f"{window:06d}.part"
            with part.open("wb") as file:
                stack = np.stack(frames)
                np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(stack))
                file.write(stack.data)  # np.save does not say why it cannot
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, self._staged / f"{window:06d}.npy")

    def _kept(self) -> Iterator[NDArray[Any]]:
        for file in sorted(self._staged.glob("*.npy")):
            yield from np.load(file, allow_pickle=False)

    def finish(self, count: int) -> None:
        """Give the stack its name; may be called again after it was broken off.

        Args:
            count: Frames that were written.
        """
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        elif self._staged.is_dir():
            self._assemble(count)
        if self._part.exists():  # else it had its name already when the run was broken off
            move_into_place(self._part, self._path, self._form.kind, self._form.companions)

    def _assemble(self, count: int) -> None:
        times = self._info.frame_times if count == self._info.shape[0] else None
        info = replace(self._info, shape=(count, *self._info.shape[1:]), frame_times=times)
        shutil.rmtree(self._part) if self._part.is_dir() else self._part.unlink(missing_ok=True)
        if self._form.write_all is not None and (self._compression is not None or self._form.create is None):
            self._form.write_all(self._part, info, self._kept(), self._compression)
        else:
            assert self._form.create is not None
            writer = self._form.create(self._part, info, True)
            for index, frame in enumerate(self._kept()):
                writer.write(index, frame)
            writer.sync()
            writer.close()
        done = self._staged.with_name("windows.done")
        os.replace(self._staged, done)  # half a folder must not be taken for a whole one
        shutil.rmtree(done)

    def close(self) -> None:
        """Let go of the file."""
        if self._writer is not None:
            self._writer.close()
