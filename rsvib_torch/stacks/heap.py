"""Settings of the GNU C library's memory allocator that limit the memory and the time of long runs."""

import ctypes
import functools
import platform
from typing import Any


def share_one_heap() -> bool:
    """Let all threads that start from now on allocate from one heap; whether the C library has accepted the setting.

    By default every thread has its own heap and keeps freed memory in it. Frames are read, computed and written by
    different threads, and the sum of their heaps grows for hundreds of windows (after 1000 frames 1.55 GB instead of
    1.36 GB, ``docs/stacks.md``).
    """
    arena_max = -8  # parameter M_ARENA_MAX of mallopt
    return _set(arena_max, 1)


def keep_freed_memory() -> bool:
    """Let this process keep freed memory for the next frames; whether the C library has accepted the setting.

    Dask workers return it to the system at once, so that the pages of every large tensor are requested and cleared
    again: 40 % of the CPU time of a run (``docs/stacks.md``).
    """
    trim_threshold, mmap_threshold = -1, -3  # parameters M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of mallopt
    largest_dynamic = 1 << 25  # bytes; the upper limit of the default, dynamic threshold
    return _set(mmap_threshold, largest_dynamic) and _set(trim_threshold, 2 * largest_dynamic)


@functools.cache
def _glibc() -> Any:
    return ctypes.CDLL(None) if platform.libc_ver()[0] == "glibc" else None


def _set(parameter: int, value: int) -> bool:
    try:
        return _glibc() is not None and bool(_glibc().mallopt(parameter, value))
    except (AttributeError, OSError):
        return False
