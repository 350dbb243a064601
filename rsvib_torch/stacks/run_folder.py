"""A run that writes an output from windows, and is resumed if it was interrupted.

Finished windows are in a folder beside the output. A window consists of files of pixels and a line of the journal, with
its record and the hashes of its files. The line is written when the files and their names are on the disk, so that a
window with a line is finished. Every line begins with a hash of itself and of the line before: a journal that somebody
has edited is refused. Files are opened relative to the open folder, and only new files are written: a link in the place
of the folder or of a file is never followed, and nothing that others made is changed.
"""

import errno
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

import numpy as np

from rsvib_torch.checks.arguments import check_fields
from rsvib_torch.files import atomic
from rsvib_torch.files.atomic import check_outputs, nearest_folder, sync
from rsvib_torch.files.free_memory import size_text
from rsvib_torch.files.reading import Table
from rsvib_torch.io.stack_writing import stack_files
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import RunOptions
from rsvib_torch.results.presentation import Summarised
from rsvib_torch.stacks.job import WindowResult
from rsvib_torch.stacks.manifest import manifest_text, read_manifest
from rsvib_torch.text import number_of, one_line

_JOURNAL = "journal"
_NAMES = re.compile(rf"{_JOURNAL}|\d{{6,}}\.(npy|mkv|mp4|mov|m4v)")  # of the files that a run makes
_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # opening a named pipe must not wait for another process
_blake2b = partial(hashlib.blake2b, digest_size=16)


def work_folder(sink: Path) -> Path:
    """Work folder of a run that writes ``sink``."""
    return sink.with_name(f".{sink.name}.rsvib")


def _difference(old: object, new: object, path: str = "") -> str | None:
    """The first key in which two tables differ, with both values; None if they are equal."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*new, *old]):
            difference = _difference(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
            if difference:
                return difference
        return None
    texts = (one_line(json.dumps(value), 60) for value in (old, new))
    return None if old == new else "{} was {}, now it is {}".format(path, *texts)


def check_space(path: Path, needed: int) -> None:
    """Raise an ``OSError`` if the disk of a file to be written has less than ``needed`` free bytes."""
    free = shutil.disk_usage(nearest_folder(path)).free
    if needed > free:
        reason = f"{os.strerror(errno.ENOSPC)}: a run needs {size_text(needed)}, {size_text(free)} are free"
        raise OSError(errno.ENOSPC, reason, str(path))


class RunFolder:
    """The work folder of a run, locked until it is closed.

    A run is resumed only if its ``header`` is unchanged: input, settings and versions. A folder that no run has made,
    or in which another run writes, is refused.
    """

    def __init__(self, sink: Path, header: Mapping[str, object], *, resume: bool) -> None:
        self.sink, self.path, self._above = sink, work_folder(sink), nearest_folder(sink)
        self._windows: dict[int, tuple[int, int, int]] = {}  # finished: place and size of the line; frames
        self._digest = b""  # of the last line of the journal
        atomic.make_folder(self.path.parent)
        while not self._open():
            pass
        with ExitStack() as opened:
            opened.callback(os.close, self._folder)
            names = self._checked_names()
            flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | _SAFELY
            self._journal = os.open(_JOURNAL, flags, 0o600, dir_fd=self._folder)
            opened.callback(os.close, self._journal)
            self._read_journal(dict(header), names, resume=resume)
            self._opened = opened.pop_all()

    def _open(self) -> bool:
        """Open the folder, which is created if it does not exist, and lock it; False if it was removed meanwhile."""
        with ExitStack() as opened:
            try:
                with suppress(FileExistsError):
                    self.path.mkdir(0o700)
                    sync(self.path.parent)
                self._folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | _SAFELY)
                opened.callback(os.close, self._folder)
                if os.fstat(self._folder).st_uid != os.geteuid():
                    raise self._refusal("it belongs to another user")
                fcntl.flock(self._folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except FileNotFoundError:
                return False
            except BlockingIOError as error:
                raise BlockingIOError(f"cannot write {self.sink}: another run is writing it") from error
            except OSError as error:
                if error.errno in (errno.ELOOP, errno.ENOTDIR):
                    raise self._refusal("it is a link" if self.path.is_symlink() else "it is not a folder") from error
                if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):  # as those of some clusters
                    raise
                text = f"the file system has no locks ({error.strerror}): start no other run with this output"
                warnings.warn(f"{self.path}: {text}", stacklevel=2)
            keeps = self._has_its_name()  # otherwise another process has removed it
            if keeps:
                opened.pop_all()
            return keeps

    def _has_its_name(self) -> bool:
        with suppress(FileNotFoundError):
            return os.path.samestat(os.lstat(self.path), os.fstat(self._folder))
        return False

    def _refusal(self, reason: str, name: str = "") -> FileExistsError:
        return FileExistsError(
            f"cannot write {self.sink}: {self.path / name} was not made by a run, {reason}; move it elsewhere, or "
            f"delete {self.path} to start over"
        )

    def _checked_names(self) -> list[str]:
        """Names in the folder; a ``FileExistsError`` if there is anything in it that no run has made."""
        names = sorted(os.listdir(self._folder))
        if names and _JOURNAL not in names:
            raise self._refusal(f"it has no {_JOURNAL}")
        for name in names:
            status = os.stat(name, dir_fd=self._folder, follow_symlinks=False)
            if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1 or status.st_uid != os.geteuid():
                raise self._refusal("it is not a regular file of one name and of this user", name)
            if not _NAMES.fullmatch(name):
                raise self._refusal("it has another name than files of a run", name)
        return names

    def _read_journal(self, header: Table, names: Iterable[str], *, resume: bool) -> None:
        """Find the windows whose files are as they were written; a journal without windows begins anew."""
        start_over = f"delete {self.path} to start over"
        stored, end = None, 0
        with self.open(_JOURNAL) as lines:
            for line in lines:
                if not line.endswith(b"\n") or b"\0" in line:  # it was not yet on the disk
                    break
                digest, _, body = line[:-1].partition(b" ")
                if digest != _keyed(body, self._digest):
                    raise ValueError(f"{self.path / _JOURNAL} is damaged; {start_over}")
                entry = json.loads(body)
                if end == 0:
                    stored = entry
                else:
                    self._windows[entry["record"]["window"]] = end, len(line), entry["record"]["written"]
                self._digest, end = digest, end + len(line)
        if end == 0 and set(names) > {_JOURNAL}:
            raise ValueError(f"{self.path / _JOURNAL} is damaged; {start_over}")
        if not self._windows:
            end, self._digest = 0, b""
        elif not resume:
            raise FileExistsError(
                f"{self.sink}: a run was interrupted here after {self.count} windows; resume it (--resume), or "
                f"{start_over}"
            )
        elif difference := _difference(stored, header):
            raise ValueError(f"{self.sink}: cannot resume: {difference}; {start_over}")
        os.ftruncate(self._journal, end)
        if not self._windows:
            self._append(header)
            os.fsync(self._folder)
        for window in list(self._windows):
            whole = False  # whether its files are those that were written
            with suppress(OSError):
                whole = all(self._digest_of(name) == digest for name, digest in self._entry(window)["files"].items())
            if not whole:
                del self._windows[window]

    def _entry(self, window: int) -> Table:
        """The line of a window, which is not kept in memory."""
        place, size, _ = self._windows[window]
        entry: Table = json.loads(os.pread(self._journal, size, place).partition(b" ")[2])
        return entry

    def _append(self, entry: Mapping[str, object]) -> tuple[int, int]:
        """Write a line of the journal, which is on the disk when the function returns; its place and size."""
        body = json.dumps(entry).encode()
        self._digest = _keyed(body, self._digest)
        line = self._digest + b" " + body + b"\n"
        place, remaining = os.fstat(self._journal).st_size, memoryview(line)
        while remaining:
            remaining = remaining[os.write(self._journal, remaining) :]
        os.fsync(self._journal)
        return place, len(line)

    def _digest_of(self, name: str, *, synchronised: bool = False) -> str:
        with self.open(name) as file:
            if synchronised:
                os.fsync(file.fileno())
            return hashlib.file_digest(file, _blake2b).hexdigest()

    def create(self, name: str) -> BinaryIO:
        """A new file of a window, whose name begins with the number of the window in six digits."""
        with suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._folder)
        return os.fdopen(os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | _SAFELY, 0o600, dir_fd=self._folder), "w+b")

    def open(self, name: str) -> BufferedReader:
        """A file of the folder for reading."""
        return os.fdopen(os.open(name, os.O_RDONLY | _SAFELY, dir_fd=self._folder), "rb")

    def add(self, record: Table, names: Sequence[str] = (), array: Array | None = None) -> None:
        """Enter the ``WindowRecord`` of a window with its closed files, and an array, which becomes the last of them.

        It is on the disk when the function returns.
        """
        names = list(names)
        with disk_errors_named(self):
            if array is not None:
                names.append(f"{record['window']:06d}.npy")
                with self.create(names[-1]) as file:
                    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
                    file.write(array.data)  # errors of np.save do not contain the reason
            digests = {name: self._digest_of(name, synchronised=True) for name in names}
            os.fsync(self._folder)  # their names
            self._windows[record["window"]] = *self._append({"record": record, "files": digests}), record["written"]

    def __contains__(self, window: int) -> bool:
        return window in self._windows

    @property
    def count(self) -> int:
        """Number of finished windows."""
        return len(self._windows)

    @property
    def written(self) -> int:
        """Number of their frames."""
        return sum(frames for *_, frames in self._windows.values())

    def records(self) -> Iterator[Table]:
        """Records of the finished windows in order."""
        return (self._entry(window)["record"] for window in sorted(self._windows))

    def files(self) -> Iterator[str]:
        """Names of the files of the finished windows in order."""
        return (name for window in sorted(self._windows) for name in self._entry(window)["files"])

    def remove(self) -> None:
        """Remove the folder, and the empty folders above it that were created for it.

        It is renamed first: if the process is killed meanwhile, ``temporary_folder`` removes the rest later.
        """
        hidden = self.path.with_name(f".{self.sink.name}.{secrets.token_hex(4)}{atomic.PART}")
        self._windows.clear()
        if self._has_its_name():
            self.path.rename(hidden)
            sync(hidden.parent)
            shutil.rmtree(hidden, ignore_errors=True)
        with suppress(OSError):  # folders that others use
            folder = self.path.absolute().parent
            while folder != self._above:
                folder.rmdir()
                folder = folder.parent

    def close(self) -> None:
        """Release the folder; it is removed if it contains no finished window."""
        with self._opened:
            if not self._windows:
                self.remove()


def _keyed(body: bytes, key: bytes) -> bytes:
    """Digest of a line of the journal; the key is that of the line before."""
    return _blake2b(body, key=key).hexdigest().encode()


@contextmanager
def disk_errors_named(folder: RunFolder) -> Iterator[None]:
    """Add the name of the output and the number of finished windows to errors of the disk."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        number = atomic.error_of_full_disk(error) or getattr(error, "errno", None)
        if number is None and not isinstance(error, OSError):
            raise
        kept = f"; {folder.count} windows are complete, resume the run to continue" if folder.count else ""
        # the words of the system: libraries add long descriptions
        reason = os.strerror(number) if number else " ".join(str(error).split())
        raise OSError(number, f"{reason}{kept}", str(folder.sink)) from error


@dataclass(frozen=True, eq=False, repr=False)
class StackReport(Summarised):
    """Summary of a run.

    Attributes:
        frames: Number of frames written, including those of an interrupted run that was resumed.
        windows: Number of windows of the stack.
        restored: Number of windows whose frames were restored.
        failed: Number of windows in which detection or restoration failed.
        bad_frames: Number of frames that could not be used.
        resumed: Number of windows that were complete before.
        seconds: Duration of the run.
        first: Result of the first window, if it was computed in this process.
        manifest: Path of the manifest.
        not_kept: Metadata of the input that the output does not contain.

    Example:
        >>> import rsvib_torch as rsv
        >>> report = rsv.process_stack("frames.tif", "restored.tif", timing)  # doctest: +SKIP
        >>> report.frames, report.windows, report.restored, report.failed  # doctest: +SKIP
        (200, 28, 28, 0)
    """

    frames: int
    windows: int
    restored: int
    failed: int
    bad_frames: int
    resumed: int
    seconds: float
    first: WindowResult | None
    manifest: Path
    not_kept: tuple[str, ...]

    def __post_init__(self) -> None:
        check_fields(self)

    def summary(self) -> str:
        """Numbers of frames and windows, and the time."""
        lines = [f"{number_of(self.frames, 'frame')} in {number_of(self.windows, 'window')}, {self.restored} restored"]
        if self.frames and not self.resumed:
            lines[0] += f", {self.seconds / self.frames:.2g} s per frame"
        if self.resumed:
            lines.append(f"windows complete before this run: {self.resumed}")
        see = f"see {self.manifest.name}"
        if self.failed:
            lines.append(f"detection or restoration failed in {number_of(self.failed, 'window')}: {see}")
        if self.bad_frames:
            lines.append(f"{number_of(self.bad_frames, 'frame')} could not be used: {see}")
        return "\n".join(lines)


def run_to_file(
    sink: Path,
    options: RunOptions,
    header: Table,
    *,
    inputs: Iterable[Path],
    windows: int,
    compute: Callable[[RunFolder], Table],
    write: Callable[[RunFolder], None],
) -> StackReport:
    """Compute the windows of a run that are not finished, and write the output and its manifest; neither is an input.

    ``compute`` adds the missing windows to the folder and returns further keys of the manifest, among them the metadata
    that are ``not_kept``; ``write`` writes the output from the folder.
    """
    start = time.perf_counter()
    manifest = sink.with_name(f"{sink.name}.manifest.json") if options.manifest is None else Path(options.manifest)
    check_outputs([*stack_files(sink), work_folder(sink), manifest], inputs)

    def report(windows_done: Iterable[Table], resumed: int, lost: Sequence[str]) -> StackReport:
        records = list(windows_done)
        return StackReport(
            frames=sum(record["written"] for record in records),
            windows=windows,
            restored=sum(record["frames"] == "restored" for record in records),
            failed=sum(record["error"] is not None for record in records),
            bad_frames=sum(len(record["bad_frames"]) for record in records),
            resumed=resumed,
            seconds=time.perf_counter() - start,
            first=None,
            manifest=manifest,
            not_kept=tuple(lost),
        )

    if options.resume and not work_folder(sink).exists() and sink.exists() and manifest.exists():
        complete = read_manifest(manifest)
        difference = _difference({name: getattr(complete, name) for name in header}, header)
        if difference:
            raise ValueError(f"{sink}: cannot resume: {difference}; omit resume to replace the output")
        for path in (sink, manifest):
            atomic.remove_abandoned(path)
        return report(map(vars, complete.windows), windows, complete.not_kept)
    folder = RunFolder(sink, header, resume=options.resume)
    try:
        resumed = folder.count
        results = compute(folder)
        with disk_errors_named(folder):
            atomic.make_folder(manifest.parent)
            with atomic.whole_file(manifest) as part:
                part.write_text(manifest_text(header, folder.records(), **results), encoding="utf-8")
                write(folder)
            sync(manifest.absolute().parent)  # the temporary folder is gone as well
        summary = report(folder.records(), resumed, results["not_kept"])
        folder.remove()
        return summary
    finally:
        folder.close()
