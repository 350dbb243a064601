"""One heap for all threads, so that memory does not creep up with the number of windows."""

import ctypes
import platform

__all__ = ["share_one_heap"]

_ARENA_MAX = -8  # of glibc's mallopt


def share_one_heap() -> bool:
    """Have the threads that start from now on take their memory from one heap, where the C library is glibc.

    It gives every thread a heap of its own, and keeps in it what the thread let go of. Pixels are read in one thread,
    computed on in others and written in yet another: each heap then grows to the worst moment of its own, and their
    sum goes on growing for hundreds of windows. The setting holds for the process, and cannot be taken back.

    Returns:
        Whether the C library took it.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    try:
        return bool(ctypes.CDLL(None).mallopt(_ARENA_MAX, 1))
    except (AttributeError, OSError):
        return False
