"""What a run keeps on disk until it is complete: a header, and one line for every window that is safely written."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rsvib_torch.io.atomic import whole_file

try:
    import fcntl
except ImportError:  # systems without it do not keep two runs apart
    fcntl = None  # type: ignore[assignment]

__all__ = ["Journal", "describe_difference", "work_folder"]

_HEADER, _LINES, _LOCK = "run.json", "journal.jsonl", "lock"


def work_folder(sink: Path) -> Path:
    """Folder beside ``sink`` in which a run keeps its work."""
    return sink.with_name(f".{sink.name}.rsvib")


def describe_difference(old: Any, new: Any, path: str = "") -> str | None:
    """The first key in which two tables differ, with both values; None if they do not."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*new, *old]):
            found = describe_difference(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
            if found:
                return found
        return None
    return None if old == new else f"{path} was {_short(old)}, now it is {_short(new)}"


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


class Journal:
    """The work folder of a run. Only one process has it open at a time.

    Args:
        sink: What the run writes.

    Raises:
        OSError: If the folder cannot be made, or another process works in it.
    """

    def __init__(self, sink: Path) -> None:
        self.sink, self.folder = sink, work_folder(sink)
        self._made: Path | None = None  # the topmost folder that has to be made
        if not sink.parent.is_dir():
            self._made = sink.absolute().parent
            while not self._made.parent.is_dir():
                self._made = self._made.parent
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OSError(
                f"cannot write {sink}: folder {sink.parent} cannot be written to ({error.strerror})"
            ) from error
        self._lock = os.open(self.folder / _LOCK, os.O_CREAT | os.O_RDWR)
        try:
            if fcntl is not None:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise BlockingIOError(f"cannot write {sink}: another run is writing it") from error
        self._file: int | None = None
        self._open = True
        self.count = 0  # windows that are safely written
        self.written = 0  # frames of these

    def open(self, header: dict[str, Any], *, resume: bool) -> bool:
        """Begin a run, or go on with one.

        Args:
            header: Input, settings and versions of the run.
            resume: Whether to go on with one that was broken off.

        Returns:
            Whether there are windows that need not be done again.

        Raises:
            FileExistsError: If a run was broken off there, and is not to be resumed.
            ValueError: If its input, settings or versions were other ones, or its journal is damaged.
        """
        lines, end = self._whole_lines()
        if lines and not resume:
            raise FileExistsError(
                f"{self.sink}: a run was broken off here after {len(lines)} windows; resume it (--resume), or delete "
                f"{self.folder} to start over"
            )
        if lines:
            old = self._header()
            difference = describe_difference(old, json.loads(json.dumps(header)))
            if difference:
                raise ValueError(f"{self.sink}: cannot resume: {difference}; delete {self.folder} to start over")
            records = [json.loads(line) for line in lines]
            self.count, self.written = len(records), sum(record["written"] for record in records)
        else:
            for entry in self.folder.iterdir():
                if entry.name != _LOCK:
                    shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
            with whole_file(self.folder / _HEADER) as part:
                part.write_text(json.dumps(header), encoding="utf-8")
        self._file = os.open(self.folder / _LINES, os.O_CREAT | os.O_RDWR)
        os.ftruncate(self._file, end)
        os.lseek(self._file, 0, os.SEEK_END)
        return bool(lines)

    @property
    def has_lines(self) -> bool:
        """Whether a run has left windows here."""
        path = self.folder / _LINES
        return path.exists() and path.stat().st_size > 0

    def _header(self) -> Any:
        try:
            return json.loads((self.folder / _HEADER).read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{self.folder / _HEADER} is damaged; delete {self.folder} to start over") from error

    def _whole_lines(self) -> tuple[list[bytes], int]:
        """Complete lines of the journal, and where they end: a process that is killed may leave half of one."""
        path = self.folder / _LINES
        data = path.read_bytes() if path.exists() else b""
        lines = data.splitlines(keepends=True)
        if lines and not lines[-1].endswith(b"\n"):
            lines.pop()
        for number, line in enumerate(lines):
            try:
                right = json.loads(line)["window"] == number
            except (ValueError, KeyError, TypeError):
                right = False
            if not right:
                raise ValueError(f"{path}: line {number + 1} is damaged; delete {self.folder} to start over")
        return lines, sum(len(line) for line in lines)

    def add(self, record: dict[str, Any]) -> None:
        """Note a window whose frames are on the disk."""
        assert self._file is not None
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        while line:  # a disk that is almost full takes a part of it
            line = line[os.write(self._file, line) :]
        os.fsync(self._file)
        self.count += 1
        self.written += record["written"]

    def forget(self) -> None:
        """Keep nothing of the run: it cannot come to anything."""
        assert self._file is not None
        os.ftruncate(self._file, 0)
        self.count = self.written = 0

    def records(self) -> Iterator[dict[str, Any]]:
        """Records of all windows."""
        with (self.folder / _LINES).open("rb") as file:
            for line in file:
                yield json.loads(line)

    def close(self) -> None:
        """Let go of the folder; it stays for a run that goes on, unless there is nothing in it to keep."""
        if self._open and self.count == 0 and not self.has_lines:
            self.remove()
        self._let_go()

    def _let_go(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None
        if self._open:
            os.close(self._lock)
            self._open = False

    def remove(self) -> None:
        """Remove the folder, and those above it that were made for it and are empty."""
        (self.folder / _LINES).unlink(missing_ok=True)  # first: without it there is nothing to go on with
        shutil.rmtree(self.folder, ignore_errors=True)
        self._let_go()
        folder = self.folder.absolute().parent
        while self._made is not None and folder != self._made.parent:
            try:
                folder.rmdir()
            except OSError:
                break
            folder = folder.parent
