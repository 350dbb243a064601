"""A work folder that is used by one process, and in which nothing is followed, changed or deleted that others made."""

import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from rsvib_torch.core.atomic import make_folder, nearest_folder, sync

try:
    import fcntl
except ImportError:  # without it two processes are not kept apart
    fcntl = None  # type: ignore[assignment]

__all__ = ["PrivateFolder"]

_LOCK = "lock"
_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # opening a named pipe must not wait for another process


class PrivateFolder:
    """A folder that is created, or opened if it belongs to the user, and locked until it is closed.

    The folder is opened once, and its content is reached through the open folder: a link, or another folder, that takes
    its name later is not used.

    Args:
        path: The folder.
        target: The file for which it is needed, for messages.

    Attributes:
        path: The folder, for messages.
        place: A path that always leads to the open folder, for libraries.

    Raises:
        BlockingIOError: If another process uses the folder.
        FileExistsError: If the name belongs to a link, a file, or a folder of another user.
        OSError: If the folder cannot be created.
    """

    def __init__(self, path: Path, target: Path) -> None:
        self.path, self._target, self._existing = path, target, nearest_folder(path)
        try:
            make_folder(path.parent)
            while not self._claim():
                pass  # a process that has ended meanwhile removed it
        except PermissionError as error:
            reason = error.strerror or error
            raise OSError(f"cannot write {target}: folder {target.parent} is not writable ({reason})") from error
        by_number = Path(f"/proc/self/fd/{self._folder}")  # of Linux
        self.place = by_number if by_number.is_dir() else path

    def _claim(self) -> bool:
        """Create or open the folder, and lock it; False if it was removed meanwhile."""
        try:
            os.mkdir(self.path, 0o700)
            sync(self.path.parent)
        except FileExistsError:
            pass
        try:
            self._folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | _SAFELY)
        except FileNotFoundError:
            return False
        except OSError as error:
            if stat.S_ISDIR(os.lstat(self.path).st_mode):
                raise
            kind = "a link" if self.path.is_symlink() else "not a folder"
            raise self._refusal(f"{self.path} is {kind}, which no run has made") from error
        try:
            if os.fstat(self._folder).st_uid != os.geteuid():
                raise self._refusal(f"{self.path} belongs to another user")
            self._locked_before = _LOCK in os.listdir(self._folder)
            self._lock = self.open(_LOCK, os.O_RDWR | os.O_CREAT)
        except FileNotFoundError:
            os.close(self._folder)
            return False
        except BaseException:
            os.close(self._folder)
            raise
        try:
            if fcntl is not None:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.close()
            raise BlockingIOError(f"cannot write {self._target}: another run is writing it") from error
        try:
            here = os.path.samestat(os.lstat(self.path), os.fstat(self._folder))
            locked = os.path.samestat(self._stat(_LOCK), os.fstat(self._lock))
        except FileNotFoundError:
            here = locked = False
        if not (here and locked):
            self.close()
        return here and locked

    def _refusal(self, reason: str) -> FileExistsError:
        return FileExistsError(f"cannot write {self._target}: {reason}; delete it, or choose another name")

    def _stat(self, name: str) -> os.stat_result:
        return os.stat(name, dir_fd=self._folder, follow_symlinks=False)

    def names(self) -> set[str]:
        """Names of the files and folders in the folder, except the lock."""
        return set(os.listdir(self._folder)) - {_LOCK}

    def open(self, name: str, flags: int) -> int:
        """Open a regular file without following links.

        Raises:
            FileExistsError: If the name belongs to anything else, or the file has another name as well.
            FileNotFoundError: If it does not exist.
        """
        try:
            file = os.open(name, flags | _SAFELY, 0o600, dir_fd=self._folder)
        except FileNotFoundError:
            raise
        except OSError as error:
            if self._is_plain(self._stat(name)):
                raise
            raise self._refusal(f"{self.path / name} is not a regular file") from error
        if not self._is_plain(os.fstat(file)):
            os.close(file)
            raise self._refusal(f"{self.path / name} is not a regular file of one name and of this user")
        return file

    @staticmethod
    def _is_plain(status: os.stat_result) -> bool:
        """Whether a file is a regular file of this user with one name, or removed."""
        return stat.S_ISREG(status.st_mode) and status.st_nlink <= 1 and status.st_uid == os.geteuid()

    @contextmanager
    def reading(self, name: str) -> Iterator[BinaryIO]:
        """Open a file for reading; see ``open``."""
        with os.fdopen(self.open(name, os.O_RDONLY), "rb") as file:
            yield file

    def write(self, name: str, blocks: Iterable[bytes]) -> None:
        """Write or replace a file as a whole; it is on the disk when the function returns."""
        part = f"{name}.part"
        self.delete([part])
        with os.fdopen(self.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb") as file:
            file.writelines(blocks)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, name, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        os.fsync(self._folder)

    def check(self) -> None:
        """Raise a ``FileExistsError`` if the folder contains a link, a device, or a file of another user."""
        folders = [self.place]
        while folders:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    status = entry.stat(follow_symlinks=False)
                    if entry.is_dir(follow_symlinks=False) and status.st_uid == os.geteuid():
                        folders.append(Path(entry.path))
                    elif not self._is_plain(status):
                        name = self.path / Path(entry.path).relative_to(self.place)
                        kind = "a link" if entry.is_symlink() else "not a regular file of one name and of this user"
                        raise self._refusal(f"{name} is {kind}, which no run has made")

    def delete(self, names: Iterable[str]) -> None:
        """Delete files, and folders with their content, if they exist; links are not followed."""
        for name in names:
            try:
                if stat.S_ISDIR(self._stat(name).st_mode):
                    shutil.rmtree(name, dir_fd=self._folder)
                else:
                    os.unlink(name, dir_fd=self._folder)
            except FileNotFoundError:
                continue

    def remove(self) -> None:
        """Remove the folder, if it is empty, and the empty folders above it that were created for it."""
        if self.names():
            self.delete([] if self._locked_before else [_LOCK])
            return
        self.delete([_LOCK])
        folder = self.path.absolute()
        try:
            if os.path.samestat(os.lstat(folder), os.fstat(self._folder)):
                folder.rmdir()
            while (folder := folder.parent) != self._existing:
                folder.rmdir()
        except OSError:
            pass  # used by others

    def close(self) -> None:
        """Release the folder."""
        os.close(self._lock)
        os.close(self._folder)
