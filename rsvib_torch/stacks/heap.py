"""Settings of the GNU C library's memory allocator that limit the memory and the time of long runs."""

import ctypes
from contextlib import suppress

# parameters of mallopt
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_LARGEST_DYNAMIC = 1 << 25  # bytes; the upper limit of the default, dynamic threshold


def share_one_heap(*, keep_freed: bool = False) -> None:
    """Let all threads that start from now on allocate from one heap; other C libraries are left as they are.

    Frames are read, computed and written by different threads, whose own heaps would grow for hundreds of windows
    (after 1000 frames 1.55 GB instead of 1.36 GB, ``docs/stacks.md``). Freed memory is kept for the next frames, or
    returned to the system at once, as Dask workers do, which takes 40 % of the CPU time of a run.
    """
    settings = {_ARENA_MAX: 1}
    if keep_freed:
        settings |= {_MMAP_THRESHOLD: _LARGEST_DYNAMIC, _TRIM_THRESHOLD: 2 * _LARGEST_DYNAMIC}
    with suppress(AttributeError, OSError):
        for parameter, value in settings.items():
            ctypes.CDLL(None).mallopt(parameter, value)
