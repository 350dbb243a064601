"""Atomic, durable writes: files and folders get their names when they are complete and on the disk.

``check_outputs`` is the check of all functions and commands that no output replaces an input.
"""

import errno
import fcntl
import glob
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from itertools import combinations
from pathlib import Path
from typing import Literal

from rsvib_torch.text import json_text

PART = ".part"  # ending of temporary folders: .NAME.########.part
_LONGEST_NAME = 255 - len("..12345678.part")  # bytes; of names of which temporary files have longer ones
Kind = Literal["file", "folder"]  # to write; a folder may contain other files
_Path = str | os.PathLike[str]


def nearest_folder(path: Path) -> Path:
    """The lowest existing folder above ``path``."""
    return next((folder for folder in path.absolute().parents if folder.exists()), path.absolute())


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


def make_folder(path: Path) -> None:
    """Create a folder, and those above it, if it does not exist; its name is on the disk when the function returns."""
    existing = nearest_folder(path)
    path.mkdir(parents=True, exist_ok=True)
    for folder in path.absolute().parents:
        sync(folder)
        if folder == existing:
            return


def remove_abandoned(path: Path) -> None:
    """Remove temporary folders of killed processes: the operating system has released their locks."""
    for folder in nearest_folder(path).glob(f".{glob.escape(path.name)}.{'?' * 8}{PART}"):
        with suppress(OSError), _locked(folder) as file:
            if os.fstat(file).st_uid == os.geteuid():
                shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _locked(folder: Path, *, wait: bool = False) -> Iterator[int]:
    """Open and lock a folder; ``wait`` until another process releases its lock, or raise an ``OSError``.

    A link, something else than a folder, and a file system without locks are refused.
    """
    file = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield file
    finally:
        os.close(file)


@contextmanager
def full_disk_named(path: Path, more: Callable[[], str] = str) -> Iterator[None]:
    """State the output, and what ``more`` returns, in errors of a full disk, or of files larger than permitted."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        match = re.search(r"errno = (\d+)", str(error))  # in a text of HDF5
        number = int(match[1]) if match else getattr(error, "errno", None)
        if "requested and" in str(error):  # NumPy does not state why an array is cut off
            number = errno.ENOSPC
        if number not in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
            raise
        raise OSError(number, f"{os.strerror(number)}{more()}", str(path)) from error


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """A temporary folder on the file system of ``path``, which errors of a full disk name.

    Those that killed processes left for it are removed.
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
        with full_disk_named(path):
            yield folder


def check_not_special(path: _Path) -> None:
    """Raise an ``OSError`` if a path exists and is neither a regular file nor a folder: it would be replaced by one."""
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise FileExistsError(f"cannot write {os.fspath(path)}: it is a device, pipe or socket; choose another name")


def check_target(path: Path, kind: Kind = "file", *, parent_exists: bool = True) -> None:
    """Raise an ``OSError`` with the reason if ``path`` must not be replaced by a file, or written into as a folder.

    ``kind`` is as in ``StackFormat``; ``parent_exists`` states whether the folder of a file must exist.
    """
    size = len(os.fsencode(path.name))
    if size > _LONGEST_NAME:
        raise OSError(f"cannot write {path.name[:40]}...: its name has {size} bytes, at most {_LONGEST_NAME} fit")
    check_not_special(path)
    if kind == "file":
        if path.is_dir():
            raise IsADirectoryError(f"cannot write {path}: it is a folder")
        if parent_exists and not path.absolute().parent.is_dir():
            raise FileNotFoundError(f"cannot write {path}: folder {path.absolute().parent} does not exist")
    elif path.exists() and not path.is_dir():
        raise NotADirectoryError(f"cannot write folder {path}: a file of that name exists")
    elif path.is_dir() and not os.access(path, os.W_OK | os.X_OK):
        raise PermissionError(f"cannot write into folder {path}: it is not writable")


def check_writable(path: Path, kind: Kind = "file") -> None:
    """Raise an ``OSError`` with the reason if ``path`` cannot be written; creates nothing."""
    check_target(path, kind)
    with temporary_folder(path):
        pass


@contextmanager
def whole(path: _Path, kind: Kind = "file", *, parent_exists: bool = True) -> Iterator[Path]:
    """Write a file or folder under a temporary name; it gets its name when the block ends without an exception.

    It is on the disk then. An existing file is replaced; an existing folder keeps its other files. The block creates
    the file, or writes into the folder, that has the temporary name. ``kind`` is as in ``StackFormat``; the folder of a
    file must exist if ``parent_exists``, other folders are created.
    """
    target = Path(path)
    check_target(target, kind, parent_exists=parent_exists)
    with temporary_folder(target) as folder:
        part = folder / target.name
        if kind == "folder":
            part.mkdir()
        yield part
        for place, _, names in os.walk(folder, topdown=False):
            for name in (*names, ""):
                sync(Path(place, name))
        make_folder(target.parent)
        if kind == "folder" and target.is_dir():
            moves = [(file, target / file.name) for file in sorted(part.iterdir())]
        else:
            moves = [(part, target)]
        for made, final in moves:
            check_target(final, "file" if made.is_file() else "folder", parent_exists=False)
        for made, final in moves:
            if final.is_file():
                made.chmod(stat.S_IMODE(final.stat().st_mode))
            os.replace(made, final)
        if kind == "folder":
            sync(target)
        sync(target.absolute().parent)


def write_json(path: _Path, content: Mapping[str, object]) -> None:
    """Write a table as JSON with one key per line, atomically."""
    with whole(path) as part:
        part.write_text(json_text(content) + "\n", encoding="utf-8")


def _places(path: _Path) -> set[Path]:
    """Absolute path of a file, with the link followed or not if it is one."""
    path = Path(path).absolute()
    return {Path(os.path.realpath(path)), Path(os.path.realpath(path.parent), path.name)}


def _same_file(path: _Path, other: _Path) -> bool:
    with suppress(OSError):  # one of them does not exist
        return os.path.samefile(path, other)
    return False


def _relation(path: _Path, other: _Path) -> str:
    """How a file to write is related to one that this would change; empty if it is not."""
    places, others = _places(path), _places(other)
    if _same_file(path, other) or not places.isdisjoint(others):
        return "is"
    if any(not places.isdisjoint(place.parents) for place in others):
        return "contains"
    return "lies inside" if any(not others.isdisjoint(place.parents) for place in places) else ""


def check_outputs(outputs: Iterable[_Path], inputs: Iterable[_Path], *, folder: _Path | None = None) -> None:
    """Raise an error if an output would replace or change an input, another output, or a device.

    An output must not be an input under any name (another path, a link, a hard link), lie inside an input folder, or
    contain an input. The ``folder`` of the outputs may contain an input file, but not an input folder.
    """
    outputs, inputs = list(outputs), list(inputs)
    for output in outputs:
        check_not_special(output)
    for source in inputs:
        places = [(f"cannot write {output}", output, "name") for output in outputs]
        if folder is not None and (os.path.isdir(source) or _relation(folder, source) != "contains"):
            places.insert(0, (f"cannot write into {folder}", folder, "folder"))
        for problem, place, remedy in places:
            relation, member = _relation(place, source), None
            if not relation and os.path.isfile(place):  # others are no file of a folder, which may have many
                members = (Path(above, name) for above, _, names in os.walk(source) for name in names)
                member = next((one for one in members if _same_file(one, place)), None)
            if relation or member:
                found = f"{relation} the input {source}" if relation else f"is the same file as {member} of the input"
                raise ValueError(f"{problem}: it {found}; choose another {remedy}")
    for one, other in combinations(outputs, 2):
        if relation := _relation(one, other):
            raise ValueError(f"cannot write {one} and {other}: the first {relation} the second; choose two names")
