"""Files and folders that appear whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

__all__ = ["check_writable", "place", "whole_file", "whole_folder", "workplace"]


def _nearest_folder(path: Path) -> Path:
    """The folder in which ``path``, or the first missing folder above it, would be made."""
    parent = path.absolute().parent
    while not parent.exists() and parent != parent.parent:
        parent = parent.parent
    return parent


@contextmanager
def workplace(path: Path) -> Iterator[Path]:
    """A temporary folder on the file system of ``path``, gone afterwards."""
    parent = _nearest_folder(path)
    try:
        work = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=parent))
    except OSError as error:
        raise OSError(f"cannot write {path}: folder {parent} is not writable ({error.strerror})") from error
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


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
