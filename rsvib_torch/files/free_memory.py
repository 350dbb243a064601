"""Memory that this process can still use: of the machine, and of its control groups (containers, batch systems)."""

import re
import resource
from collections.abc import Iterator
from pathlib import Path

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
