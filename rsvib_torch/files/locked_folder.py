"""A folder of files that one process at a time uses, until it is complete, and that a later process can continue.

Files are opened relative to the open folder, and only new files are written: a link in the place of the folder or of a
file is never followed, and nothing that others made is changed. Tables begin with a hash of themselves: one that was
written incompletely, or changed, is not read.
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
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import IO, Literal

from rsvib_torch.files.atomic import PART, make_folder, nearest_folder, sync
from rsvib_torch.files.reading import Table

_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # opening a named pipe must not wait for another process
_blake2b = partial(hashlib.blake2b, digest_size=16)


def key_of(content: object) -> bytes:
    """Key of the hashes of tables that belong to a content."""
    return _blake2b(json.dumps(content, sort_keys=True).encode()).digest()


class LockedFolder:
    """A folder beside the file ``sink`` that is computed in it, locked until it is closed.

    It is created if it does not exist. One that another process uses, that belongs to another user, or that has files
    with other ``names`` is refused.
    """

    def __init__(self, path: Path, sink: Path, names: re.Pattern[str]) -> None:
        self.path, self.sink, self._above = path, sink, nearest_folder(sink)
        make_folder(path.parent)
        with ExitStack() as opened:
            try:
                with suppress(FileExistsError):
                    path.mkdir(0o700)
                    sync(path.parent)
                self._folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | _SAFELY)
                opened.callback(os.close, self._folder)
                self._lock()
            except (FileNotFoundError, BlockingIOError) as error:
                raise BlockingIOError(f"cannot write {sink}: another run is writing it") from error
            except OSError as error:
                if error.errno not in (errno.ELOOP, errno.ENOTDIR):
                    raise
                raise self._refusal("it is a link" if path.is_symlink() else "it is not a folder") from error
            self.names = sorted(os.listdir(self._folder))
            for name in self.names:
                status = os.stat(name, dir_fd=self._folder, follow_symlinks=False)
                if not (names.fullmatch(name) and stat.S_ISREG(status.st_mode)):
                    raise self._refusal("it has another name than files of a run, or is no regular file", name)
            self._opened = opened.pop_all()

    def _lock(self) -> None:
        """Lock the folder, which must be that of this user; a ``BlockingIOError`` if another process uses it."""
        if os.fstat(self._folder).st_uid != os.geteuid():
            raise self._refusal("it belongs to another user")
        try:
            fcntl.flock(self._folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):  # as those of some clusters
                raise
            text = f"the file system has no locks ({error.strerror}): start no other run with this output"
            warnings.warn(f"{self.path}: {text}", stacklevel=2)
        if not self._has_its_name():
            raise BlockingIOError  # another process has just ended

    def _has_its_name(self) -> bool:
        with suppress(FileNotFoundError):
            return os.path.samestat(os.lstat(self.path), os.fstat(self._folder))
        return False

    def _refusal(self, reason: str, name: str = "") -> FileExistsError:
        return FileExistsError(
            f"cannot write {self.sink}: {self.path / name} was not made by a run, {reason}; move it elsewhere, or "
            f"delete {self.path} to start over"
        )

    def open(self, name: str, mode: Literal["rb", "x+b"] = "rb") -> IO[bytes]:
        """Open a file of the folder, wherever the folder is now, and never through a link."""
        return open(name, mode, opener=lambda name, flags: os.open(name, flags | _SAFELY, 0o600, dir_fd=self._folder))

    def create(self, name: str) -> IO[bytes]:
        """A new file, in place of one of this name."""
        with suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._folder)
        return self.open(name, "x+b")

    def write_table(self, name: str, content: Mapping[str, object], key: bytes = b"") -> None:
        """Write a table with its hash; it is on the disk when the function returns."""
        body = json.dumps(content).encode()
        with self.create(name) as file:
            file.write(_blake2b(body, key=key).hexdigest().encode() + b" " + body)
            file.flush()
            os.fsync(file.fileno())
        os.fsync(self._folder)

    def read_table(self, name: str, key: bytes = b"") -> Table | None:
        """The table in a file; None if the file is not as it was written, or with another key."""
        with suppress(OSError), self.open(name) as file:
            digest, _, body = file.read().partition(b" ")
            if digest == _blake2b(body, key=key).hexdigest().encode():
                content: Table = json.loads(body)
                return content
        return None

    def digest(self, name: str, *, synchronised: bool = False) -> str:
        """Hash of the content of a file, which is on the disk then if ``synchronised``."""
        with self.open(name) as file:
            if synchronised:
                os.fsync(file.fileno())
            return hashlib.file_digest(file, _blake2b).hexdigest()  # type: ignore[arg-type]

    def remove(self) -> None:
        """Remove the folder, and the empty folders above it that were created for it.

        It is renamed first: if the process is killed meanwhile, ``temporary_folder`` removes the rest later.
        """
        hidden = self.path.with_name(f".{self.sink.name}.{secrets.token_hex(4)}{PART}")
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
        """Release the folder."""
        self._opened.close()
