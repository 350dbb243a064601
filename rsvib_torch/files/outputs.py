"""Outputs must not replace inputs: one check of paths for all functions and commands that write files."""

import os
from collections.abc import Iterable
from contextlib import suppress
from itertools import combinations
from pathlib import Path

from rsvib_torch.files.atomic import check_not_special

_Path = str | os.PathLike[str]


def _places(path: _Path) -> set[Path]:
    """Absolute path of a file, with the link followed or not if it is one."""
    path = Path(path).absolute()
    return {Path(os.path.realpath(path)), Path(os.path.realpath(path.parent), path.name)}


def _inside(path: _Path, folder: _Path) -> bool:
    return any(place != above and place.is_relative_to(above) for place in _places(path) for above in _places(folder))


def _identity(path: _Path) -> tuple[int, int] | None:
    """Device and number of a file or folder, which all its names share; None if it does not exist."""
    with suppress(OSError):
        status = os.stat(path)
        return status.st_dev, status.st_ino
    return None


def _same(path: _Path, other: _Path) -> bool:
    identity = _identity(path)
    return (identity is not None and identity == _identity(other)) or not _places(path).isdisjoint(_places(other))


def _conflict(output: _Path, source: _Path) -> str | None:
    """Why writing a file would change an input; None if it does not."""
    if _same(output, source):
        return f"it is the same file as the input {source}"
    if _inside(source, output):
        return f"it contains the input {source}"
    if not os.path.isdir(source):
        return None
    if _inside(output, source):
        return f"it lies inside the input folder {source}"
    identity = _identity(output)
    if identity is not None and not os.path.isdir(output):
        for member in (Path(place, name) for place, _, names in os.walk(source) for name in names):
            if _identity(member) == identity:
                return f"it is the same file as {member} of the input"
    return None


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
        if folder is not None and (os.path.isdir(source) or not _inside(source, folder)):
            places.append((f"cannot write into {folder}", folder, "folder"))
        for problem, place, remedy in places:
            reason = _conflict(place, source)
            if reason is not None:
                raise ValueError(f"{problem}: {reason}; choose another {remedy}")
    for one, other in combinations(outputs, 2):
        if _same(one, other) or _inside(one, other) or _inside(other, one):
            reason = "they are the same file" if _same(one, other) else "one lies inside the other"
            raise ValueError(f"cannot write {one} and {other}: {reason}; choose two names")
