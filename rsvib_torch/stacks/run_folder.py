"""The finished windows of a run, in a folder beside its output, from which an interrupted run is resumed.

A window consists of files of pixels and a marker: a file with the record of the window and the hashes of its files. The
marker gets its name after all of them are on the disk, so that a window with a marker is finished. Files are opened
relative to the open folder, and only new files are written: a link in the place of the folder or of a file is never
followed, and nothing that others made is changed.
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
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from rsvib_torch.core.atomic import PART, error_of_full_disk, make_folder, nearest_folder, sync
from rsvib_torch.core.free_memory import size_text
from rsvib_torch.core.text import one_line

_HEADER = "run.json"
_NAMES = re.compile(
    r"run\.json(\.part)?|\d{6,}\.(done|done\.part|npy|mkv|mp4|mov|m4v)"
)  # of the files that a run makes
_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # opening a named pipe must not wait for another process


def work_folder(sink: Path) -> Path:
    """Work folder of a run that writes ``sink``."""
    return sink.with_name(f".{sink.name}.rsvib")


def describe_difference(old: Any, new: Any, path: str = "") -> str | None:
    """The first key in which two tables differ, with both values; None if they are equal."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*new, *old]):
            difference = describe_difference(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
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

    Args:
        sink: The output of the run.
        header: Input, settings and versions of the run: it is resumed only if they are unchanged.
        resume: Whether to continue an interrupted run.

    Raises:
        BlockingIOError: If another run writes the same output.
        FileExistsError: If there is an interrupted run and ``resume`` is False, or the folder was not made by a run.
        OSError: If the folder cannot be created.
        ValueError: If the header differs from that of the run to resume, or a marker was changed.
    """

    def __init__(self, sink: Path, header: Mapping[str, Any], *, resume: bool) -> None:
        self.sink, self.path, self._above = sink, work_folder(sink), nearest_folder(sink)
        content = json.dumps(header).encode()
        self._key = hashlib.blake2b(content, digest_size=32).digest()
        self._written: dict[int, int] = {}  # number of frames of each finished window
        make_folder(self.path.parent)
        while not self._open():
            pass
        try:
            names = self._checked_names()
            windows = sorted(int(name[:-5]) for name in names if name.endswith(".done"))
            if windows:
                self._check_resumable(content, len(windows), resume=resume)
                self._find_finished(windows)
            else:
                for name in names:
                    self._delete(name)
                self._write(_HEADER, content)
        except BaseException:
            os.close(self._folder)
            raise

    def _open(self) -> bool:
        """Open the folder, which is created if it does not exist, and lock it; False if it was removed meanwhile."""
        try:
            with suppress(FileExistsError):
                self.path.mkdir(0o700)
                sync(self.path.parent)
            self._folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | _SAFELY)
        except FileNotFoundError:
            return False
        except OSError as error:
            if not os.path.lexists(self.path) or stat.S_ISDIR(os.lstat(self.path).st_mode):
                raise
            raise self._refusal("it is a link" if self.path.is_symlink() else "it is not a folder") from error
        try:
            if os.fstat(self._folder).st_uid != os.geteuid():
                raise self._refusal("it belongs to another user")
            self._lock()
            if self._has_its_name():
                return True
        except BlockingIOError as error:
            os.close(self._folder)
            raise BlockingIOError(f"cannot write {self.sink}: another run is writing it") from error
        except BaseException:
            os.close(self._folder)
            raise
        os.close(self._folder)  # another process has removed it
        return False

    def _lock(self) -> None:
        """Lock the folder; a warning if the file system has no locks, as those of some clusters."""
        try:
            fcntl.flock(self._folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                raise
            warnings.warn(
                f"{self.path}: the file system has no locks ({error.strerror}): start no other run with this output",
                stacklevel=2,
            )

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
        if not {_HEADER, f"{_HEADER}.part"}.intersection(names) and names:
            raise self._refusal(f"it has no {_HEADER}")
        for name in names:
            status = os.stat(name, dir_fd=self._folder, follow_symlinks=False)
            if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1 or status.st_uid != os.geteuid():
                raise self._refusal("it is not a regular file of one name and of this user", name)
            if not _NAMES.fullmatch(name):
                raise self._refusal("it has another name than files of a run", name)
        return names

    def _check_resumable(self, header: bytes, count: int, *, resume: bool) -> None:
        """Raise an error if a run of ``count`` finished windows must not be continued with this header."""
        start_over = f"delete {self.path} to start over"
        if not resume:
            raise FileExistsError(
                f"{self.sink}: a run was interrupted here after {count} windows; resume it (--resume), or {start_over}"
            )
        with self.open(_HEADER) as file:
            stored = file.read()
        if stored != header:
            try:
                difference = describe_difference(json.loads(stored), json.loads(header))
            except (ValueError, RecursionError):
                difference = None
            if difference is None:
                raise ValueError(f"{self.path / _HEADER} is damaged; {start_over}")
            raise ValueError(f"{self.sink}: cannot resume: {difference}; {start_over}")

    def _find_finished(self, windows: Iterable[int]) -> None:
        """Find the windows whose files are as they were written, and remove the markers of the others."""
        entries = [(self._entry(window)["record"]["written"], window) for window in windows]  # before any change
        for written, window in entries:
            if self._is_whole(window):
                self._written[window] = written
            else:
                self._delete(_marker(window))

    def _is_whole(self, window: int) -> bool:
        """Whether the files of a window are those that were written."""
        try:
            return all(self._digest_of(name) == digest for name, digest in self._entry(window)["files"].items())
        except OSError:
            return False

    def _digest_of(self, name: str, *, synchronised: bool = False) -> str:
        with self.open(name) as file:
            if synchronised:
                os.fsync(file.fileno())
            digest = hashlib.blake2b(digest_size=16)
            for block in iter(lambda: file.read(1 << 20), b""):
                digest.update(block)
            return digest.hexdigest()

    def _entry(self, window: int) -> dict[str, Any]:
        """Content of the marker of a window.

        Raises:
            ValueError: If it is not what this run wrote.
        """
        with self.open(_marker(window)) as file:
            body, _, checksum = file.read().rpartition(b"\n")
        if checksum == self._checksum(body):
            entry: dict[str, Any] = json.loads(body)
            if entry["record"]["window"] == window:
                return entry
        raise ValueError(f"{self.path / _marker(window)} is damaged; delete {self.path} to start over")

    def _checksum(self, body: bytes) -> bytes:
        return hashlib.blake2b(body, key=self._key, digest_size=16).hexdigest().encode()

    def _delete(self, name: str) -> None:
        with suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._folder)

    def create(self, name: str) -> BinaryIO:
        """A new file of a window, whose name begins with the number of the window in six digits."""
        self._delete(name)
        return os.fdopen(os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | _SAFELY, 0o600, dir_fd=self._folder), "w+b")

    def open(self, name: str) -> BinaryIO:
        """A file of the folder for reading."""
        return os.fdopen(os.open(name, os.O_RDONLY | _SAFELY, dir_fd=self._folder), "rb")

    def add(self, record: Mapping[str, Any], names: Iterable[str]) -> None:
        """Enter the ``WindowRecord`` of a window with its closed files; it is on the disk when the function returns."""
        digests = {name: self._digest_of(name, synchronised=True) for name in names}
        os.fsync(self._folder)  # their names
        body = json.dumps({"record": record, "files": digests}, allow_nan=False).encode()
        self._write(_marker(record["window"]), body + b"\n" + self._checksum(body))
        self._written[record["window"]] = record["written"]

    def _write(self, name: str, content: bytes) -> None:
        """Write a file, which gets its name when its content is on the disk."""
        with self.create(f"{name}.part") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(f"{name}.part", name, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        os.fsync(self._folder)

    def __contains__(self, window: int) -> bool:
        return window in self._written

    @property
    def count(self) -> int:
        """Number of finished windows."""
        return len(self._written)

    @property
    def written(self) -> int:
        """Number of their frames."""
        return sum(self._written.values())

    def records(self) -> Iterator[dict[str, Any]]:
        """Records of the finished windows in order."""
        for window in sorted(self._written):
            yield self._entry(window)["record"]

    def files(self) -> Iterator[str]:
        """Names of the files of the finished windows in order."""
        for window in sorted(self._written):
            yield from self._entry(window)["files"]

    def remove(self) -> None:
        """Remove the folder, and the empty folders above it that were created for it.

        It is renamed first: if the process is killed meanwhile, ``temporary_folder`` removes the rest later.
        """
        hidden = self.path.with_name(f".{self.sink.name}.{secrets.token_hex(4)}{PART}")
        self._written.clear()
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
        try:
            if not self._written:
                self.remove()
        finally:
            os.close(self._folder)


def _marker(window: int) -> str:
    return f"{window:06d}.done"


@contextmanager
def disk_errors_named(folder: RunFolder) -> Iterator[None]:
    """Add the name of the output and the number of finished windows to errors of the disk."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        number = error_of_full_disk(error) or getattr(error, "errno", None)
        if number is None and not isinstance(error, OSError):
            raise
        kept = f"; {folder.count} windows are complete, resume the run to continue" if folder.count else ""
        # the words of the system: libraries add long descriptions
        reason = os.strerror(number) if number else " ".join(str(error).split())
        raise OSError(number, f"{reason}{kept}", str(folder.sink)) from error
