"""Atomic, durable writes: files and folders get their names when they are complete and on the disk."""

import errno
import fcntl
import glob
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from rsvib_torch.core.text import json_text

PART = ".part"  # ending of temporary folders: .NAME.########.part
_ADDED = len("..12345678.part")  # bytes that names of temporary files have in addition


def nearest_folder(path: Path) -> Path:
    """The lowest existing folder above ``path``."""
    parent = path.absolute().parent
    while not parent.exists() and parent != parent.parent:
        parent = parent.parent
    return parent


def sync(path: Path) -> None:
    """Return when the content of a file, or the names in a folder, are on the disk: a power loss does not undo them."""
    try:
        file = os.open(path, os.O_RDONLY)
    except PermissionError:
        if path.is_dir():  # a folder in which files may be created but not listed
            return
        raise
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():  # file systems without this function
            raise
    finally:
        os.close(file)


def sync_tree(path: Path) -> None:
    """``sync`` a file, or a folder with everything in it."""
    for folder, _, names in os.walk(path, topdown=False):
        for name in names:
            sync(Path(folder, name))
        sync(Path(folder))
    if path.is_file():
        sync(path)


def make_folder(path: Path) -> None:
    """Create a folder, and those above it, if it does not exist; its name is on the disk when the function returns."""
    existing = nearest_folder(path)
    path.mkdir(parents=True, exist_ok=True)
    folder = path.absolute().parent
    while True:
        sync(folder)
        if folder in (existing, folder.parent):
            return
        folder = folder.parent


def remove_abandoned(path: Path) -> None:
    """Remove temporary folders of killed processes: the operating system has released their locks."""
    for folder in nearest_folder(path).glob(f".{glob.escape(path.name)}.{'?' * 8}{PART}"):
        with suppress(OSError), _locked(folder) as file:
            if os.fstat(file).st_uid == os.geteuid():
                shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _locked(folder: Path, *, wait: bool = False) -> Iterator[int]:
    """Open and lock a folder; ``wait`` until another process releases its lock.

    Raises:
        OSError: If it is a link or not a folder, another process has locked it, or the file system has no locks.
    """
    file = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield file
    finally:
        os.close(file)


def error_of_full_disk(error: Exception) -> int | None:
    """Number of the error of the system if a disk is full, or a file larger than permitted; otherwise None."""
    stated = re.search(r"errno = (\d+)", str(error))  # in a text of HDF5
    number = int(stated[1]) if stated else getattr(error, "errno", None)
    if "requested and" in str(error):  # NumPy does not state why an array is cut off
        number = errno.ENOSPC
    return number if number in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT) else None


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """A temporary folder on the file system of ``path``; those that killed processes left for it are removed.

    Raises:
        OSError: With the name of ``path``, if the disk is full.
    """
    parent = nearest_folder(path)
    remove_abandoned(path)
    with ExitStack() as opened:
        folder = None
        while folder is None or not folder.is_dir():  # another process may remove it before it is locked
            try:
                folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=PART, dir=parent))
            except OSError as error:
                raise OSError(f"cannot write {path}: folder {parent} is not writable ({error.strerror})") from error
            with suppress(OSError):  # file systems without locks
                opened.enter_context(_locked(folder, wait=True))
        opened.callback(shutil.rmtree, folder, ignore_errors=True)
        try:
            yield folder
        except (OSError, RuntimeError) as error:
            number = error_of_full_disk(error)
            if number is None:
                raise
            raise OSError(number, os.strerror(number), str(path)) from error


def check_name(path: Path) -> None:
    """Raise an ``OSError`` if the name of a file to be written is too long, with those that belong to it."""
    longest = os.pathconf(nearest_folder(path), "PC_NAME_MAX") - _ADDED if hasattr(os, "pathconf") else 255 - _ADDED
    size = len(os.fsencode(path.name))
    if size > longest:
        raise OSError(f"cannot write {path.name[:40]}...: its name has {size} bytes, at most {longest} are possible")


def check_not_special(path: str | os.PathLike[str]) -> None:
    """Raise an ``OSError`` if a path exists and is neither a regular file nor a folder: it would be replaced by one.

    Example:
        >>> check_not_special(os.devnull)
        Traceback (most recent call last):
        ...
        FileExistsError: cannot write /dev/null: it is a device, pipe or socket; choose another name
    """
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise FileExistsError(f"cannot write {os.fspath(path)}: it is a device, pipe or socket; choose another name")


def check_kind(path: Path, *, folder: bool = False) -> None:
    """Raise an ``OSError`` if something exists at ``path`` that a file, or a folder, must not replace."""
    check_not_special(path)
    if folder and path.exists() and not path.is_dir():
        raise NotADirectoryError(f"cannot write folder {path}: a file of that name exists")
    if not folder and path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder")


def _check_file_target(path: Path, *, parent_exists: bool = True) -> None:
    check_kind(path)
    if parent_exists and not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: folder {path.absolute().parent} does not exist")


def _check_folder_target(path: Path) -> None:
    check_kind(path, folder=True)
    if path.is_dir() and not os.access(path, os.W_OK | os.X_OK):
        raise PermissionError(f"cannot write into folder {path}: it is not writable")


def check_writable(path: Path, *, folder: bool = False) -> None:
    """Raise an ``OSError`` with the reason if ``path`` cannot be written; creates nothing."""
    (_check_folder_target if folder else _check_file_target)(path)
    with temporary_folder(path):
        pass


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file under a temporary name with its ending; it gets its name when the block ends without exception."""
    target = Path(path)
    _check_file_target(target)
    with temporary_folder(target) as folder:
        part = folder / target.name
        yield part
        sync(part)
        _replace(part, target)
        sync(target.absolute().parent)


def write_json(path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
    """Write a table as JSON with one key per line, atomically.

    Raises:
        OSError: If the file cannot be written.
    """
    with whole_file(path) as part:
        part.write_text(json_text(content) + "\n", encoding="utf-8")


@contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write files into a temporary folder; they are moved when the block ends without an exception.

    The folder and those above it are created. An existing folder keeps its other files; files of the same names are
    replaced.
    """
    target = Path(path)
    _check_folder_target(target)
    with temporary_folder(target) as folder:
        part = folder / "new"
        part.mkdir()
        yield part
        _move_files(part, target)


def _move_files(part: Path, target: Path) -> None:
    files = sorted(part.iterdir())
    for file in files:
        _check_file_target(target / file.name, parent_exists=False)
        sync(file)
    make_folder(target)
    for file in files:
        os.replace(file, target / file.name)
    sync(target)


def move_into_place(
    part: Path, target: Path, kind: Literal["file", "folder", "tree"] = "file", companions: tuple[str, ...] = ()
) -> None:
    """Rename a complete stack, which is on the disk, from its temporary name ``part``.

    It may be repeated after an interruption, and the new name is on the disk when the function returns. An existing
    file or tree is replaced, an existing folder keeps its other files; ``kind`` and ``companions`` are those of
    ``StackFormat``.
    """
    for name in (target, *(target.with_name(target.name + ending) for ending in companions)):
        check_not_special(name)
    for ending in companions:
        companion = part.with_name(part.name + ending)
        if companion.exists():
            os.replace(companion, target.with_name(target.name + ending))
    if kind == "folder" and target.is_dir():
        _move_files(part, target)
        part.rmdir()
    elif kind == "tree" and target.is_dir():
        old = part.with_name(f"{part.name}.old")
        os.replace(target, old)
        os.replace(part, target)
        old.unlink() if old.is_symlink() else shutil.rmtree(old)
    else:
        _replace(part, target)
    sync(target.absolute().parent)


def _replace(part: Path, target: Path) -> None:
    """Rename a file; an existing one is replaced, and its permissions are kept."""
    if target.is_file() and part.is_file():
        part.chmod(stat.S_IMODE(target.stat().st_mode))
    os.replace(part, target)
