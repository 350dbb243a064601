"""The output of a run while it is incomplete: a work folder beside it with a journal and the frames written so far.

A run that was killed continues from the journal: frames are on the disk before their window is entered.
"""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.atomic import move_into_place, nearest_folder, whole_file
from rsvib_torch.io.files import write_frames
from rsvib_torch.io.formats import FrameWriter, StackFormat
from rsvib_torch.io.stack_info import StackInfo

try:
    import fcntl
except ImportError:  # without it two runs are not kept apart
    fcntl = None  # type: ignore[assignment]

__all__ = ["Journal", "Sink", "describe_difference", "disk_errors_named", "work_folder"]


def work_folder(sink: Path) -> Path:
    """Work folder of a run that writes ``sink``."""
    return sink.with_name(f".{sink.name}.rsvib")


def describe_difference(old: Any, new: Any, path: str = "") -> str | None:
    """The first key in which two tables differ, with both values; None if they are equal."""

    def shortened(value: Any) -> str:
        text = json.dumps(value)
        return text if len(text) <= 60 else f"{text[:57]}..."

    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*new, *old]):
            difference = describe_difference(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
            if difference:
                return difference
        return None
    return None if old == new else f"{path} was {shortened(old)}, now it is {shortened(new)}"


class Journal:
    """The work folder of a run, locked while it is open: a header and one line for every window that was written.

    Args:
        sink: The output of the run.

    Attributes:
        count: Number of windows that were written.
        written: Number of their frames.

    Raises:
        OSError: If the folder cannot be created, or another process uses it.
    """

    def __init__(self, sink: Path) -> None:
        self.sink, self.folder = sink, work_folder(sink)
        self.count = self.written = 0
        self._header, self._lines = self.folder / "run.json", self.folder / "journal.jsonl"
        self._existing = nearest_folder(sink)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OSError(f"cannot write {sink}: folder {sink.parent} is not writable ({error.strerror})") from error
        self._lock_path = self.folder / "lock"
        self._lock: int | None = os.open(self._lock_path, os.O_CREAT | os.O_RDWR)
        self._file: int | None = None
        try:
            if fcntl is not None:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise BlockingIOError(f"cannot write {sink}: another run is writing it") from error

    def open(self, header: dict[str, Any], *, resume: bool) -> bool:
        """Begin a run, or resume one.

        Args:
            header: Input, settings and versions of the run.
            resume: Whether to continue an interrupted run.

        Returns:
            Whether an interrupted run is continued.

        Raises:
            FileExistsError: If there is an interrupted run and ``resume`` is False.
            ValueError: If its input, settings or versions differ, or its journal is damaged.
        """
        lines = self._complete_lines()
        if lines and not resume:
            raise FileExistsError(
                f"{self.sink}: a run was interrupted here after {len(lines)} windows; resume it (--resume), or delete "
                f"{self.folder} to start over"
            )
        if lines:
            try:
                old = json.loads(self._header.read_text(encoding="utf-8"))
            except ValueError as error:
                raise ValueError(f"{self._header} is damaged; delete {self.folder} to start over") from error
            difference = describe_difference(old, json.loads(json.dumps(header)))
            if difference:
                raise ValueError(f"{self.sink}: cannot resume: {difference}; delete {self.folder} to start over")
            self.count, self.written = len(lines), sum(json.loads(line)["written"] for line in lines)
        else:
            for entry in self.folder.iterdir():
                if entry != self._lock_path:
                    shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
            with whole_file(self._header) as part:
                part.write_text(json.dumps(header), encoding="utf-8")
        self._file = os.open(self._lines, os.O_CREAT | os.O_RDWR)
        os.ftruncate(self._file, sum(len(line) for line in lines))
        os.lseek(self._file, 0, os.SEEK_END)
        return bool(lines)

    @property
    def has_lines(self) -> bool:
        """Whether an interrupted run has left windows here."""
        return self._lines.exists() and self._lines.stat().st_size > 0

    def _complete_lines(self) -> list[bytes]:
        """Lines of the journal; the last one is incomplete and ignored if the process was killed while writing it."""
        lines = self._lines.read_bytes().splitlines(keepends=True) if self._lines.exists() else []
        if lines and not lines[-1].endswith(b"\n"):
            lines.pop()
        for number, line in enumerate(lines):
            try:
                valid = json.loads(line)["window"] == number
            except (ValueError, KeyError, TypeError):
                valid = False
            if not valid:
                raise ValueError(f"{self._lines}: line {number + 1} is damaged; delete {self.folder} to start over")
        return lines

    def add(self, record: dict[str, Any]) -> None:
        """Enter a window whose frames are on the disk."""
        assert self._file is not None
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        while line:  # an almost full disk accepts a part of it
            line = line[os.write(self._file, line) :]
        os.fsync(self._file)
        self.count += 1
        self.written += record["written"]

    def clear(self) -> None:
        """Remove all windows of a run that failed."""
        assert self._file is not None
        os.ftruncate(self._file, 0)
        self.count = self.written = 0

    def records(self) -> Iterator[dict[str, Any]]:
        """Records of all windows."""
        with self._lines.open("rb") as file:
            for line in file:
                yield json.loads(line)

    def close(self) -> None:
        """Release the folder; it is removed if it contains no window."""
        if self._lock is not None and self.count == 0 and not self.has_lines:
            self.remove()
        self._release()

    def _release(self) -> None:
        for file in (self._file, self._lock):
            if file is not None:
                os.close(file)
        self._file = self._lock = None

    def remove(self) -> None:
        """Remove the folder, and the empty folders above it that were created for it."""
        self._lines.unlink(missing_ok=True)  # first: without it there is nothing to resume
        shutil.rmtree(self.folder, ignore_errors=True)
        self._release()
        folder = self.folder.absolute().parent
        while folder != self._existing:
            try:
                folder.rmdir()
            except OSError:
                break
            folder = folder.parent


@contextmanager
def disk_errors_named(journal: Journal) -> Iterator[None]:
    """Add the name of the output and the number of complete windows to errors of the disk."""
    try:
        yield
    except OSError as error:
        kept = f"; {journal.count} windows are complete, resume the run to continue" if journal.count else ""
        # the system's own words: libraries add long descriptions
        reason = os.strerror(error.errno) if error.errno else " ".join(str(error).split())
        raise OSError(error.errno, f"{reason}{kept}", str(journal.sink)) from error


class Sink:
    """The stack that a run writes, under a temporary name in the work folder until it is complete.

    If the format can be written in any order and the number of frames is known, frames are written at their final
    positions. Otherwise the frames of each window are stored in a file (staged) and the stack is written at the end.

    Args:
        path: The stack to write.
        folder: Work folder.
        form: Format of the stack.
        info: Its content, with the largest possible number of frames.
        staged: Whether the number of frames is unknown.
        compression: As in ``write_stack``.
        fresh: Whether to begin, or to continue.
    """

    def __init__(
        self,
        path: Path,
        folder: Path,
        form: StackFormat,
        info: StackInfo,
        *,
        staged: bool,
        compression: str | None,
        fresh: bool,
    ) -> None:
        self._path, self._form, self._info, self._compression = path, form, info, compression
        self._part, self._stage = folder / path.name, folder / "windows"
        self._writer: FrameWriter | None = None
        if form.create is not None and compression is None and not staged:
            if self._part.exists() or fresh:
                self._writer = form.create(self._part, info, fresh)
        elif fresh:
            self._stage.mkdir()

    def put(self, window: int, first: int, frames: list[NDArray[Any]]) -> None:
        """Write the frames of a window; they are on the disk when the function returns.

        Args:
            window: Number of the window.
            first: Index of its first frame in the output.
            frames: Pixels as stored.
        """
        if self._writer is not None:
            for index, frame in enumerate(frames, start=first):
                self._writer.write(index, frame)
            self._writer.sync()
        elif frames:
            part = self._stage / f"{window:06d}.part"
            with part.open("wb") as file:
                stack = np.ascontiguousarray(np.stack(frames))  # channels may be stored last
                np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(stack))
                file.write(stack.data)  # errors of np.save do not contain the reason
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, self._stage / f"{window:06d}.npy")

    def finish(self, count: int) -> None:
        """Give the stack its name; may be repeated after an interruption.

        Args:
            count: Number of frames that were written.
        """
        if self._writer is not None:
            self.close()
        elif self._stage.is_dir():
            shutil.rmtree(self._part) if self._part.is_dir() else self._part.unlink(missing_ok=True)
            write_frames(
                self._form, self._part, self._info.with_frames(count), self._staged_frames(), self._compression
            )
            done = self._stage.with_name("windows.done")
            os.replace(self._stage, done)  # a partly deleted folder must not be used again
            shutil.rmtree(done)
        if self._part.exists():  # otherwise it had its name already when the run was interrupted
            move_into_place(self._part, self._path, self._form.kind, self._form.companions)

    def _staged_frames(self) -> Iterator[NDArray[Any]]:
        for file in sorted(self._stage.glob("*.npy")):
            yield from np.load(file, allow_pickle=False)

    def close(self) -> None:
        """Close the file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
