"""How the C library keeps memory: in one heap for all threads, and from one window to the next."""

import ctypes
import functools
import platform
from typing import Any

__all__ = ["keep_freed_memory", "share_one_heap"]

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of glibc's mallopt
_MMAP_FROM = 1 << 25  # bytes; as far as glibc goes by itself


def share_one_heap() -> bool:
    """Have the threads that start from now on take their memory from one heap, where the C library is glibc.

    It gives every thread a heap of its own, and keeps in it what the thread let go of. Pixels are read in one thread,
    computed on in others and written in yet another: each heap then grows to the worst moment of its own, and their
    sum goes on growing for hundreds of windows. The setting holds for the process, and cannot be taken back.

    Returns:
        Whether the C library took it.
    """
    return _set(_ARENA_MAX, 1)


def keep_freed_memory() -> bool:
    """Have this process keep freed memory for the next frames, as glibc does unless it is told otherwise.

    Dask tells the workers it starts to hand it back to the system at once: the pages of every large tensor are then
    asked for, and cleared, anew.

    Returns:
        Whether the C library took it.
    """
    return _set(_MMAP_THRESHOLD, _MMAP_FROM) and _set(_TRIM_THRESHOLD, 2 * _MMAP_FROM)


@functools.cache
def _glibc() -> Any:
    return ctypes.CDLL(None) if platform.libc_ver()[0] == "glibc" else None


def _set(parameter: int, value: int) -> bool:
    try:
        return _glibc() is not None and bool(_glibc().mallopt(parameter, value))
    except (AttributeError, OSError):
        return False
