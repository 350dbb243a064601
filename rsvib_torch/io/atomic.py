"""Files and folders that appear whole or not at all."""

import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

try:
    import fcntl
except ImportError:  # systems without it keep what a killed process leaves
    fcntl = None  # type: ignore[assignment]

__all__ = ["check_writable", "place", "whole_file", "whole_folder", "workplace"]

_ENDING = ".part"
_DRAWN = "?" * 8  # characters that ``tempfile`` puts between


def _nearest_folder(path: Path) -> Path:
    """The folder in which ``path``, or the first missing folder above it, would be made."""
    parent = path.absolute().parent
    while not parent.exists() and parent != parent.parent:
        parent = parent.parent
    return parent


def _remove_abandoned(parent: Path, name: str) -> None:
    """Remove the temporary folders of processes that were killed: nobody has their lock any more."""
    for folder in parent.glob(f".{glob.escape(name)}.{_DRAWN}{_ENDING}"):
        try:
            file = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
        except OSError:
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            pass  # in use
        finally:
            os.close(file)


def _made_and_locked(parent: Path, name: str) -> tuple[Path, int | None]:
    """A new temporary folder and its lock, where the file system knows locks; the system opens it with the process."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=f".{name}.", suffix=_ENDING, dir=parent))
        if fcntl is None:
            return folder, None
        try:
            file = os.open(folder, os.O_RDONLY)
        except FileNotFoundError:
            continue  # another process took it for abandoned
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError:
            os.close(file)
            return folder, None
        if folder.is_dir():
            return folder, file
        os.close(file)


@contextmanager
def workplace(path: Path) -> Iterator[Path]:
    """A temporary folder on the file system of ``path``, gone afterwards; what killed processes left there goes too."""
    parent = _nearest_folder(path)
    if fcntl is not None:
        _remove_abandoned(parent, path.name)
    try:
        work, lock = _made_and_locked(parent, path.name)
    except OSError as error:
        raise OSError(f"cannot write {path}: folder {parent} is not writable ({error.strerror})") from error
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _check_file_place(path: Path, *, parent_exists: bool = True) -> None:
    if path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder")
    if parent_exists and not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: folder {path.absolute().parent} does not exist")


def _check_folder_place(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(f"cannot write folder {path}: a file of that name is there")
    if path.is_dir() and not os.access(path, os.W_OK | os.X_OK):
        raise PermissionError(f"cannot write into folder {path}: it is not writable")


def check_writable(path: Path, *, folder: bool = False) -> None:
    """Raise an ``OSError`` that says why if ``path`` could not be written; leaves nothing behind.

    Args:
        path: File, or folder, to be written later.
        folder: Whether it will be a folder.
    """
    (_check_folder_place if folder else _check_file_place)(path)
    with workplace(path):
        pass


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path to write to; the file gets its own name only when all went well.

    Args:
        path: The file to write; its folder must exist. An existing file is replaced.

    Yields:
        A path with the same file ending in the same folder.

    Raises:
        OSError: If the folder does not exist or is not writable.
    """
    target = Path(path)
    _check_file_place(target)
    with workplace(target) as work:
        part = work / target.name
        yield part
        os.replace(part, target)


@contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary folder to write into; its files get their place only when all went well.

    A folder that exists keeps its other files; files of the same names are replaced.

    Args:
        path: The folder to write; it is made, with the folders above it, if it does not exist.

    Yields:
        A temporary folder on the same file system.

    Raises:
        OSError: If the folder cannot be made or written to.
    """
    target = Path(path)
    _check_folder_place(target)
    with workplace(target) as work:
        part = work / "new"
        part.mkdir()
        yield part
        files = sorted(part.iterdir())
        for file in files:
            _check_file_place(target / file.name, parent_exists=False)
        target.mkdir(parents=True, exist_ok=True)
        for file in files:
            os.replace(file, target / file.name)


def place(
    part: Path, target: Path, kind: Literal["file", "folder", "tree"] = "file", companions: tuple[str, ...] = ()
) -> None:
    """Give what was written under a temporary name its own; may be called again after it was broken off.

    Args:
        part: What was written; a name on the file system of ``target``.
        target: Where it belongs. A file or tree there is replaced, a folder keeps its other files.
        kind: As in ``StackFormat``.
        companions: As in ``StackFormat``.
    """
    for ending in companions:
        beside = part.with_name(part.name + ending)
        if beside.exists():
            os.replace(beside, target.with_name(target.name + ending))
    if kind == "folder" and target.is_dir():
        for file in sorted(part.iterdir()):
            _check_file_place(target / file.name, parent_exists=False)
        for file in sorted(part.iterdir()):
            os.replace(file, target / file.name)
        part.rmdir()
        return
    if kind == "tree" and target.is_dir():
        old = part.with_name(f"{part.name}.old")
        os.replace(target, old)
        os.replace(part, target)
        shutil.rmtree(old)
        return
    os.replace(part, target)
