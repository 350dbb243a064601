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
from pathlib import Path
from typing import IO, Literal

import numpy as np

from rsvib_torch.checks.arguments import check_fields
from rsvib_torch.files import atomic
from rsvib_torch.files.atomic import check_outputs, nearest_folder, sync
from rsvib_torch.files.free_memory import size_text
from rsvib_torch.files.reading import Table
from rsvib_torch.io.stack_writing import stack_files
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import RunOptions
from rsvib_torch.results.presentation import Summarised, plain_values
from rsvib_torch.results.result_files import decode
from rsvib_torch.stacks.job import WindowResult
from rsvib_torch.stacks.manifest import StackManifest, read_manifest, stack_manifest
from rsvib_torch.stacks.windows import WindowRecord
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
        self._windows: dict[int, bytes] = {}  # finished: record and hashes of the files as JSON
        self._digest = b""  # of the last line of the journal
        atomic.make_folder(self.path.parent)
        while not self._open():
            pass
        with ExitStack() as opened:
            opened.callback(os.close, self._folder)
            names = self._checked_names()
            self._journal = opened.enter_context(self._file(_JOURNAL, "a+b"))
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

    def _file(self, name: str, mode: Literal["rb", "x+b", "a+b"]) -> IO[bytes]:
        """Open a file of the folder, wherever the folder is now, and never through a link."""
        return open(name, mode, opener=lambda name, flags: os.open(name, flags | _SAFELY, 0o600, dir_fd=self._folder))

    def _read_journal(self, header: Table, names: Iterable[str], *, resume: bool) -> None:
        """Find the windows whose files are as they were written; a journal without windows begins anew."""
        start_over = f"delete {self.path} to start over"
        damaged = ValueError(f"{self.path / _JOURNAL} is damaged; {start_over}")
        stored, end = None, 0
        self._journal.seek(0)
        for line in self._journal:
            if not line.endswith(b"\n") or b"\0" in line:  # it was not yet on the disk
                break
            digest, _, body = line[:-1].partition(b" ")
            if digest != _keyed(body, self._digest):
                raise damaged
            if end == 0:
                stored = json.loads(body)
            else:
                self._windows[json.loads(body)["record"]["window"]] = body
            self._digest, end = digest, end + len(line)
        if end == 0 and set(names) > {_JOURNAL}:
            raise damaged
        if not self._windows:
            end, self._digest = 0, b""
        elif not resume:
            raise FileExistsError(
                f"{self.sink}: a run was interrupted here after {self.count} windows; resume it (--resume), or "
                f"{start_over}"
            )
        elif difference := _difference(stored, header):
            raise ValueError(f"{self.sink}: cannot resume: {difference}; {start_over}")
        self._journal.truncate(end)
        if not self._windows:
            self._append(header)
            os.fsync(self._folder)
        for window, body in list(self._windows.items()):
            whole = False  # whether its files are those that were written
            with suppress(OSError):
                whole = all(self._digest_of(name) == digest for name, digest in json.loads(body)["files"].items())
            if not whole:
                del self._windows[window]

    def _append(self, entry: Mapping[str, object]) -> bytes:
        """Write a line of the journal, which is on the disk when the function returns, and return it as JSON."""
        body = json.dumps(entry).encode()
        self._digest = _keyed(body, self._digest)
        self._journal.write(self._digest + b" " + body + b"\n")
        self._journal.flush()
        os.fsync(self._journal.fileno())
        return body

    def _digest_of(self, name: str, *, synchronised: bool = False) -> str:
        with self.open(name) as file:
            if synchronised:
                os.fsync(file.fileno())
            return hashlib.file_digest(file, _blake2b).hexdigest()  # type: ignore[arg-type]

    def create(self, name: str) -> IO[bytes]:
        """A new file of a window, whose name begins with the number of the window in six digits."""
        with suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._folder)
        return self._file(name, "x+b")

    def open(self, name: str) -> IO[bytes]:
        """A file of the folder for reading."""
        return self._file(name, "rb")

    def add(self, record: WindowRecord, names: Sequence[str] = (), array: Array | None = None) -> None:
        """Enter the record of a window with its closed files, and an array, which becomes the last of them.

        It is on the disk when the function returns.
        """
        names = list(names)
        with disk_errors_named(self):
            if array is not None:
                names.append(f"{record.window:06d}.npy")
                with self.create(names[-1]) as file:
                    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
                    file.write(array.data)  # errors of np.save do not contain the reason
            digests = {name: self._digest_of(name, synchronised=True) for name in names}
            os.fsync(self._folder)  # their names
            self._windows[record.window] = self._append({"record": plain_values(record), "files": digests})

    def __contains__(self, window: int) -> bool:
        return window in self._windows

    @property
    def count(self) -> int:
        """Number of finished windows."""
        return len(self._windows)

    @property
    def written(self) -> int:
        """Number of their frames."""
        return sum(entry["record"]["written"] for entry in self._entries())

    def _entries(self) -> Iterator[Table]:
        return (json.loads(self._windows[window]) for window in sorted(self._windows))

    def records(self) -> Iterator[WindowRecord]:
        """Records of the finished windows in order."""
        return (decode(WindowRecord, entry["record"], _JOURNAL) for entry in self._entries())

    def files(self) -> Iterator[str]:
        """Names of the files of the finished windows in order."""
        return (name for entry in self._entries() for name in entry["files"])

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
    compute: Callable[[RunFolder], Table],
    write: Callable[[RunFolder], None],
) -> StackReport:
    """Compute the windows of a run that are not finished, and write the output and its manifest; neither is an input.

    ``compute`` adds the missing windows to the folder and returns further fields of the manifest; ``write`` writes the
    output from the folder.
    """
    start = time.perf_counter()
    path = sink.with_name(f"{sink.name}.manifest.json") if options.manifest is None else Path(options.manifest)
    check_outputs([*stack_files(sink), work_folder(sink), path], inputs)

    def report(manifest: StackManifest, resumed: int) -> StackReport:
        records = manifest.windows
        return StackReport(
            frames=sum(record.written for record in records),
            windows=len(records),
            restored=sum(record.frames == "restored" for record in records),
            failed=sum(record.error is not None for record in records),
            bad_frames=len(manifest.bad_frames),
            resumed=resumed,
            seconds=time.perf_counter() - start,
            first=None,
            manifest=path,
            not_kept=manifest.not_kept,
        )

    if options.resume and not work_folder(sink).exists() and sink.exists() and path.exists():
        complete = read_manifest(path)
        difference = _difference({name: getattr(complete, name) for name in header}, header)
        if difference:
            raise ValueError(f"{sink}: cannot resume: {difference}; omit resume to replace the output")
        for written in (sink, path):
            atomic.remove_abandoned(written)
        return report(complete, len(complete.windows))
    folder = RunFolder(sink, header, resume=options.resume)
    try:
        resumed = folder.count
        results = compute(folder)
        with disk_errors_named(folder):
            atomic.make_folder(path.parent)
            manifest = stack_manifest(header, folder.records(), **results)
            with atomic.whole_file(path) as part:
                manifest.save(part)
                write(folder)
            sync(path.absolute().parent)  # the temporary folder is gone as well
        folder.remove()
        return report(manifest, resumed)
    finally:
        folder.close()
