"""Reading of files that a user names: only regular ones, and as many bytes as they state and the memory permits."""

import re
import resource
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil


def size_text(count: int) -> str:
    """A number of bytes with its unit."""
    for unit, factor in (("GB", 10**9), ("MB", 10**6)):
        if count >= factor:
            return f"{count / factor:.3g} {unit}"
    return f"{count / 1000:.3g} KB"


def free_memory(root: Path = Path("/")) -> int:
    """Memory in bytes that this process can allocate in addition to what it has: the smallest of all limits.

    Files in the page cache count as free, as the system drops them when memory is needed.
    """
    return max(0, min([int(psutil.virtual_memory().available), *_free_in_groups(root), *_free_addresses()]))


def check_fits(what: str, needed: int, remedy: str) -> None:
    """Raise a ``ValueError``, from ``what`` to ``remedy``, if ``needed`` bytes more exceed the free memory."""
    free = free_memory()
    if needed > free:
        raise ValueError(f"{what} need {size_text(needed)} of memory, of which {size_text(free)} are free; {remedy}")


def _free_addresses() -> Iterator[int]:
    """Free parts of address space and data segment, if they are limited (``ulimit -v``, ``-d``, some batch systems)."""
    used = psutil.Process().memory_info()
    for name, kind in (("vms", resource.RLIMIT_AS), ("data", resource.RLIMIT_DATA)):
        limit = resource.getrlimit(kind)[0]
        if limit != resource.RLIM_INFINITY:
            yield limit - int(getattr(used, name, 0))


def _free_in_groups(root: Path) -> Iterator[int]:
    """Free memory of the control group of this process and of those above it, if they have a limit.

    Those of version 2 (https://docs.kernel.org/admin-guide/cgroup-v2.html); version 1 is no longer supported by Linux
    distributions.
    """
    top = root / "sys/fs/cgroup"
    group = top / _text(root / "proc/self/cgroup").strip().rpartition("::/")[2]
    group = group if group.is_dir() else top  # of another namespace: only the top is visible
    for place in (group, *(above for above in group.parents if above.is_relative_to(top))):
        cached = re.findall(r"^inactive_file (\d+)$", _text(place / "memory.stat"), re.MULTILINE)
        used = _text(place / "memory.current").strip()
        for limit in (_text(place / name).strip() for name in ("memory.max", "memory.high")):
            if used.isdecimal() and limit.isdecimal():  # not "max"
                yield int(limit) - int(used) + sum(map(int, cached))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


Table = dict[str, Any]  # values by name, as files and options have them

_MAX_BYTES = 10**7  # of a TOML file; start times of 500,000 frames
_MAX_DEPTH = 100  # parts of a key; the deepest key of a configuration file has 3


def check_regular(path: Path) -> None:
    """Raise an error if a path is neither a regular file nor a folder: reading others can wait or go on forever."""
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise ValueError(f"{path}: expected a regular file, this is a pipe, socket or device")


def read_text(path: Path, *, at_most: int) -> str:
    """Text of a regular file in UTF-8 of at most a number of bytes."""
    check_regular(path)
    with path.open("rb") as file:
        size = path.stat().st_size  # 0 for files of /proc, some of which have no end
        if size > at_most:
            raise ValueError(f"{path}: {size_text(size)} are too large; expected at most {size_text(at_most)}")
        return file.read(size).decode("utf-8")


def read_toml(path: Path) -> Table:
    """The tables of a TOML file."""
    try:
        text = read_text(path, at_most=_MAX_BYTES)
        # the parser takes quadratic time for nested keys; lists of numbers have as many commas as points
        if any(line.count(".") > line.count(",") + _MAX_DEPTH for line in text.splitlines() if line[:1] != "#"):
            raise ValueError(f"a key has more than {_MAX_DEPTH} parts")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a TOML file: {error}") from error
