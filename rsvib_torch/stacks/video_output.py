"""The output of ``process_video`` while it is incomplete: parts of the video in the work folder of the run."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.atomic import move_into_place, sync
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.video_parts import PartWriter, PlaneReader, join_parts
from rsvib_torch.stacks.output import digest_of_file
from rsvib_torch.stacks.private_folder import PrivateFolder

__all__ = ["PartSink"]


class PartSink:
    """Parts of a video in the folder ``windows`` of a work folder, each with the frame that it ends with.

    Args:
        path: The video to write.
        folder: Work folder.
        info: Content of the video.
        planes: As in ``PartWriter``.
    """

    def __init__(self, path: Path, folder: PrivateFolder, info: StackInfo, planes: PlaneReader | None) -> None:
        self._path, self._folder, self._info, self._planes = path, folder, info, planes
        self._stage, self._part = folder.place / "windows", folder.place / path.name
        self._writer: PartWriter | None = None

    def _names(self, part: int) -> tuple[Path, Path]:
        """Names of a part and of the frame that it ends with."""
        name = f"{part:06d}"
        return self._stage / f"{name}{self._path.suffix}", self._stage / f"{name}.npy"

    def resume(self, entries: Iterable[dict[str, Any]]) -> list[int]:
        """Continue a run; returns the numbers of the parts that are not on the disk as they were written.

        Args:
            entries: Those of the journal; none for a new run.
        """
        self._stage.mkdir(exist_ok=True)
        return [entry["window"] for entry in entries if entry["digests"] != self._digests(entry["window"])]

    def _digests(self, part: int) -> list[str]:
        try:
            return [digest_of_file(path) for path in self._names(part)]
        except OSError:
            return []

    def last_frame(self, part: int) -> NDArray[Any] | None:
        """The frame that a part ends with; None for the part before the first one."""
        return None if part < 0 else np.load(self._names(part)[1], allow_pickle=False)

    def write(self, part: int, frame: NDArray[Any]) -> None:
        """Encode the next frame of a part."""
        if self._writer is None:
            self._writer = PartWriter(self._names(part)[0], self._path, self._info, self._planes)
        self._writer.write(frame)

    def finish_part(self, part: int, last: NDArray[Any]) -> dict[str, Any]:
        """Finish a part; it is on the disk when the function returns.

        Args:
            part: Its number.
            last: Its last frame, before it was cut.

        Returns:
            Values of its entry in the journal.
        """
        assert self._writer is not None
        self._writer.close()
        self._writer = None
        video, frame = self._names(part)
        np.save(frame, last)
        for path in (video, frame):
            with path.open("rb") as file:
                os.fsync(file.fileno())
        sync(self._stage)
        return {"position": 0, "digests": self._digests(part), "head": None}

    def finish(self, parts: Sequence[int]) -> None:
        """Join the parts and give the video its name."""
        self._folder.delete([self._path.name])
        join_parts(self._part, self._info, [self._names(part)[0] for part in parts])
        with self._part.open("rb") as file:
            os.fsync(file.fileno())
        move_into_place(self._part, self._path)

    def close(self) -> None:
        """Close files."""
        if self._writer is not None:
            self._writer.abandon()
            self._writer = None
