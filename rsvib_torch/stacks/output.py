"""The output of a run while it is incomplete: a work folder beside it with a journal and the frames written so far.

A run that was killed continues from the journal: frames are on the disk before their window is entered, with a hash by
which they are recognised when the run is resumed.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.atomic import move_into_place, sync
from rsvib_torch.core.validation import read_json
from rsvib_torch.io.stack_format import FrameWriter, StackFormat
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.stack_writing import write_frames
from rsvib_torch.stacks.private_folder import PrivateFolder

__all__ = ["Journal", "Sink", "describe_difference", "digest_of_file", "disk_errors_named", "work_folder"]


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


_STORED = ("position", "digests", "head")  # keys of an entry of the journal besides those of ``WindowRecord``
_CHECKSUM = b', "checksum": "'
_MAX_LINE = 1 << 28  # bytes of a line; an entry of a window of a million frames has 40 MB


class Journal:
    """The work folder of a run, locked while it is open: a header and one line for every window that was written.

    Every line has a checksum that depends on the header as well.

    Args:
        sink: The output of the run.
        companions: Endings of further files of the output, as in ``StackFormat``.

    Attributes:
        folder: The work folder.
        count: Number of windows that were written.
        written: Number of their frames.
        has_lines: Whether an interrupted run has left windows here.

    Raises:
        OSError: If the folder cannot be created, another process uses it, or no run has made it.
    """

    def __init__(self, sink: Path, companions: tuple[str, ...] = ()) -> None:
        self.sink, self.count, self.written = sink, 0, 0
        parts = [sink.name, f"{sink.name}.old", *(f"{sink.name}{ending}" for ending in companions), "windows"]
        # in the order of their removal: without a journal nothing is resumed, without a header nothing is removed
        self._names = ["journal.jsonl", "journal.jsonl.part", *parts, "run.json.part", "run.json"]
        self._lines: dict[int, int] = {}  # position of the line of each window
        self._file: int | None = None
        self.folder = PrivateFolder(work_folder(sink), sink)
        try:
            self.has_lines = self._length() > 0
        except BaseException:
            self.folder.close()
            raise

    def _length(self) -> int:
        try:
            with self.folder.reading("journal.jsonl") as file:
                return file.seek(0, os.SEEK_END)
        except FileNotFoundError:
            return 0

    def open(self, header: dict[str, Any], *, resume: bool) -> bool:
        """Begin a run, or resume one.

        Args:
            header: Input, settings and versions of the run.
            resume: Whether to continue an interrupted run.

        Returns:
            Whether an interrupted run is continued.

        Raises:
            FileExistsError: If there is an interrupted run and ``resume`` is False, or files that no run has made.
            ValueError: If its input, settings or versions differ, or its journal is damaged.
        """
        if self.has_lines and not resume:
            with self.folder.reading("journal.jsonl") as file:
                count = sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b""))
            raise FileExistsError(
                f"{self.sink}: a run was interrupted here after {count} windows; resume it (--resume), or delete "
                f"{self.folder.path} to start over"
            )
        foreign = self._foreign_name()
        if foreign is not None:
            raise FileExistsError(
                f"cannot write {self.sink}: {self.folder.path / foreign} was not made by a run; move it elsewhere, or "
                f"delete {self.folder.path} to start over"
            )
        end = 0
        if self.has_lines:
            self._compare(header)
            self.folder.check()
            end = self._scan()
        if not self._lines:
            self.has_lines = False
            self.folder.delete(self._names)
            self.folder.write("run.json", [json.dumps(header).encode()])
            self.folder.write("journal.jsonl", [])
            self._key = self._read_key()
        self._file = self.folder.open("journal.jsonl", os.O_RDWR)
        os.ftruncate(self._file, end)
        return bool(self._lines)

    def _foreign_name(self) -> str | None:
        """A file or folder in the work folder that no run has made; None if there is none."""
        names = self.folder.names()
        return min(names - set(self._names) if self._marked(names) else names, default=None)

    @staticmethod
    def _marked(names: set[str]) -> bool:
        """Whether a run has made the folder with these names: its header is written first and deleted last."""
        return "run.json" in names or names <= {"run.json.part"}

    def _read_key(self) -> bytes:
        with self.folder.reading("run.json") as file:
            return hashlib.blake2b(file.read(), digest_size=32).digest()

    def _compare(self, header: dict[str, Any]) -> None:
        """Raise a ``ValueError`` if the header of the interrupted run is damaged or differs."""
        path, remedy = self.folder.path / "run.json", f"delete {self.folder.path} to start over"
        try:
            self._key = self._read_key()
            old = read_json(self.folder.place / "run.json", "header of a run")
            difference = describe_difference(old, json.loads(json.dumps(header)))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} is damaged; {remedy}") from error
        if difference:
            raise ValueError(f"{self.sink}: cannot resume: {difference}; {remedy}")

    def _scan(self) -> int:
        """Find the lines of all windows, and return the end of the last one.

        The last line is ignored if the process or the machine stopped while it was written.
        """
        end = 0
        with self.folder.reading("journal.jsonl") as file:
            for number in range(1, 1 << 62):
                line = file.readline(_MAX_LINE)
                entry = self._entry(line)
                if entry is None or entry["window"] in self._lines:
                    last = len(line) < _MAX_LINE and not file.read(1)
                    if last and (not line.endswith(b"\n") or b"\0" in line):
                        break
                    raise ValueError(
                        f"{self.folder.path / 'journal.jsonl'}: line {number} is damaged; delete {self.folder.path} "
                        "to start over"
                    )
                self._lines[entry["window"]] = end
                self.count += 1
                self.written += entry["written"]
                end += len(line)
        return end

    def _line(self, entry: dict[str, Any]) -> bytes:
        body = json.dumps(entry, allow_nan=False).encode()[:-1]
        return body + _CHECKSUM + self._checksum(body) + b'"}\n'

    def _checksum(self, body: bytes) -> bytes:
        return hashlib.blake2b(body, key=self._key, digest_size=16).hexdigest().encode()

    def _entry(self, line: bytes) -> dict[str, Any] | None:
        """The content of a line; None if it is damaged."""
        body, _, rest = line.rpartition(_CHECKSUM)
        if rest != self._checksum(body) + b'"}\n':
            return None
        entry: dict[str, Any] = json.loads(body + b"}")
        return entry

    def __contains__(self, window: int) -> bool:
        return window in self._lines

    def add(self, record: dict[str, Any], stored: dict[str, Any]) -> None:
        """Enter a window.

        Args:
            record: Content of its ``WindowRecord``.
            stored: Where its frames are on the disk, as from ``Sink.put``.
        """
        assert self._file is not None
        line = self._line({**record, **stored})
        position = os.lseek(self._file, 0, os.SEEK_END)
        while line:  # an almost full disk accepts a part of it
            line = line[os.write(self._file, line) :]
        os.fsync(self._file)
        self._lines[record["window"]] = position
        self.count += 1
        self.written += record["written"]

    def drop(self, windows: Iterable[int]) -> None:
        """Remove windows whose frames are damaged."""
        dropped = set(windows)
        if not dropped:
            return
        kept = [entry for entry in self.entries() if entry["window"] not in dropped]
        lines = [self._line(entry) for entry in kept]
        self.folder.write("journal.jsonl", lines)
        assert self._file is not None
        os.close(self._file)
        self._file = self.folder.open("journal.jsonl", os.O_RDWR)
        self._lines, end = {}, 0
        for entry, line in zip(kept, lines, strict=True):
            self._lines[entry["window"]] = end
            end += len(line)
        self.count, self.written = len(kept), sum(entry["written"] for entry in kept)

    def clear(self) -> None:
        """Remove all windows of a run that failed."""
        assert self._file is not None
        os.ftruncate(self._file, 0)
        self._lines.clear()
        self.count = self.written = 0
        self.has_lines = False

    def entries(self) -> Iterator[dict[str, Any]]:
        """Records of all windows in order, with the values of ``Sink.put``."""
        with self.folder.reading("journal.jsonl") as file:
            for window in sorted(self._lines):
                file.seek(self._lines[window])
                entry = self._entry(file.readline(_MAX_LINE))
                assert entry is not None  # the folder is locked
                yield entry

    def records(self) -> Iterator[dict[str, Any]]:
        """Records of all windows in order."""
        for entry in self.entries():
            yield {key: value for key, value in entry.items() if key not in _STORED}

    def close(self) -> None:
        """Release the folder; it is removed if it contains no window."""
        if self.count == 0 and not self.has_lines:
            self.remove()
        if self._file is not None:
            os.close(self._file)
            self._file = None
        self.folder.close()

    def remove(self) -> None:
        """Remove everything that a run has made."""
        if self._marked(self.folder.names()):
            self.folder.delete(self._names[:1])
            sync(self.folder.place)
            self.folder.delete(self._names[1:-1])
            sync(self.folder.place)
            self.folder.delete(self._names[-1:])
        self.folder.remove()
        self.has_lines, self.count = False, 0


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


def _digest(blocks: Iterable[bytes]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for block in blocks:
        digest.update(block)
    return digest.hexdigest()


def digest_of_file(path: Path) -> str:
    """Hash of the content of a file."""
    with path.open("rb") as file:
        return _digest(iter(lambda: file.read(1 << 20), b""))


def _digest_on_disk(writer: FrameWriter | None, index: int | None) -> str | None:
    """Hash of the bytes of a frame, or for None of everything else; None if they cannot be read."""
    if writer is None or not hasattr(writer, "stored"):  # formats of users may lack it
        return None
    try:
        return _digest(writer.stored(index))
    except OSError:
        return None


class Sink:
    """The stack that a run writes, under a temporary name in the work folder until it is complete.

    If the format can be written in any order and the number of frames is known, frames are written at their final
    positions. Otherwise the frames of each window are stored in a file (staged) and the stack is written at the end.
    Call ``begin`` or ``resume`` first.

    Args:
        path: The stack to write.
        folder: Work folder.
        form: Format of the stack.
        info: Its content, with the largest possible number of frames.
        staged: Whether the number of frames is unknown.
        compression: As in ``write_stack``.
    """

    def __init__(
        self,
        path: Path,
        folder: PrivateFolder,
        form: StackFormat,
        info: StackInfo,
        *,
        staged: bool,
        compression: str | None,
    ) -> None:
        self._path, self._form, self._info, self._compression = path, form, info, compression
        self._folder, self._part, self._stage = folder, folder.place / path.name, folder.place / "windows"
        self._create = None if staged or compression is not None else form.create
        self._writer: FrameWriter | None = None
        self._head: str | None = None
        self._moved = False  # whether an interrupted run has already given the stack its name

    def begin(self) -> None:
        """Begin an empty stack."""
        self._delete_part()
        if self._create is None:
            self._stage.mkdir(exist_ok=True)
        else:
            self._writer = self._create(self._part, self._info, True)
            self._writer.sync()
            self._head = _digest_on_disk(self._writer, None)
        sync(self._folder.place)

    def _delete_part(self) -> None:
        self._folder.delete([self._path.name, *(self._path.name + ending for ending in self._form.companions)])

    def resume(self, entries: Iterable[dict[str, Any]], *, complete: bool) -> list[int]:
        """Continue an interrupted run.

        Args:
            entries: Those of the journal.
            complete: Whether these are all windows.

        Returns:
            Numbers of the windows whose frames are not on the disk as they were written.
        """
        if self._create is None:
            self._stage.mkdir(exist_ok=True)
            return [entry["window"] for entry in entries if entry["digests"] != self._staged_digests(entry["window"])]
        for ending in self._form.companions:  # the run may have stopped between the files of the output
            moved, companion = (path.with_name(path.name + ending) for path in (self._path, self._part))
            if moved.is_file() and not companion.exists():
                shutil.copyfile(moved, companion)
        self._writer, moved_there = self._open(self._part), None
        if self._writer is None or self._form.kind == "folder":  # the output has its name, or some of its files do
            moved_there = self._open(self._path)
        places = [(writer, _digest_on_disk(writer, None)) for writer in (self._writer, moved_there)]
        self._head = places[0][1]
        damaged, entered = [], []
        for entry in entries:
            entered.append(entry["window"])
            for index, digest in enumerate(entry["digests"], start=entry["position"]):
                held = (head == entry["head"] and _digest_on_disk(writer, index) == digest for writer, head in places)
                if digest is None or not any(held):
                    damaged.append(entry["window"])
                    break
        if moved_there is not None:
            moved_there.close()
        self._moved = complete and self._writer is None and not damaged
        if not self._moved and (self._writer is None or len(damaged) == len(entered)):
            self.close()
            self.begin()
            return entered if self._form.kind != "folder" else damaged
        return damaged

    def _open(self, path: Path) -> FrameWriter | None:
        """A stack in the output's format; None if it does not exist or cannot be opened."""
        assert self._create is not None
        if path.is_symlink() or not path.exists():
            return None
        try:
            return self._create(path, self._info, False)
        except Exception:  # decoders raise many kinds of exceptions if a header is damaged
            return None

    def put(self, window: int, position: int, frames: list[NDArray[Any]]) -> dict[str, Any]:
        """Write the frames of a window; they are on the disk when the function returns.

        Args:
            window: Number of the window.
            position: Index of its first frame in the output.
            frames: Pixels as stored.

        Returns:
            Where the frames are, with their hashes: values of the entry in the journal.
        """
        if self._writer is not None:
            indices = range(position, position + len(frames))
            for index, frame in zip(indices, frames, strict=True):
                self._writer.write(index, frame)
            self._writer.sync()
            digests = [_digest_on_disk(self._writer, index) for index in indices]
            return {"position": position, "digests": digests, "head": self._head}
        if frames:
            part = self._staged(window).with_suffix(".part")
            with part.open("wb") as file:
                stack = np.ascontiguousarray(np.stack(frames))  # channels may be stored last
                np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(stack))
                file.write(stack.data)  # errors of np.save do not contain the reason
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, self._staged(window))
            sync(self._stage)
        return {"position": position, "digests": self._staged_digests(window), "head": None}

    def _staged(self, window: int) -> Path:
        return self._stage / f"{window:06d}.npy"

    def _staged_digests(self, window: int) -> list[str]:
        """Hash of the file of a window; empty if it has none."""
        try:
            return [digest_of_file(self._staged(window))]
        except OSError:
            return []

    def finish(self, count: int) -> None:
        """Give the stack its name; may be repeated after an interruption.

        Args:
            count: Number of frames that were written.
        """
        if self._moved:
            return
        if self._create is None:
            self._delete_part()
            write_frames(
                self._form, self._part, self._info.with_frames(count), self._staged_frames(), self._compression
            )
        self.close()
        move_into_place(self._part, self._path, self._form.kind, self._form.companions)

    def _staged_frames(self) -> Iterator[NDArray[Any]]:
        for file in sorted(self._stage.glob("*.npy")):
            yield from np.load(file, allow_pickle=False)

    def close(self) -> None:
        """Close the file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
