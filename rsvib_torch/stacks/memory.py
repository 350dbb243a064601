"""Memory planning: how many windows can be processed at once in the available memory."""

import ctypes
import os
import re
from contextlib import suppress
from functools import partial

import numpy as np
import psutil

from rsvib_torch.files.reading import check_fits, free_memory, size_text
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.options import OptionTable, StackOptions
from rsvib_torch.restoration.priors import PRIOR_BYTES
from rsvib_torch.text import quoted

# bytes; of the process with its libraries, and of a window independent of its size; peaks measured by
# scripts/benchmark.py --only streaming, rounded up
_PROCESS_BYTES, _WINDOW_BYTES = 450 * 10**6, 80 * 10**6
# bytes per pixel and channel of a window that is detected, restored and judged; same measurement
_PIXEL_BYTES = {"dewarp": 55, "banded": 55, "exact": 68, "richardson-lucy": 105}
_MOSAIC_BYTES, _MOSAIC_FRAME_BYTES = 750 * 10**6, 1000  # more for a mosaic: of a window, per pixel of a frame
_FINER = 4  # times that with scale=2; 3.5 measured for windows of 4 frames of 512 px, see scripts/attacks/memory.py


def share_one_heap() -> None:
    """Let all threads that start from now on allocate from one heap of the GNU C library; others are left as they are.

    Frames are read, computed and written by different threads, whose own heaps would grow for hundreds of windows
    (after 1000 frames 1.55 GB instead of 1.36 GB, ``docs/stacks.md``).
    """
    arena_max = -8  # parameter of mallopt
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(arena_max, 1)


def memory_limit(memory: str | float | None) -> int:
    """Limit for the memory of the process in bytes: of a text like ``"2GB"``, ``"500 MB"`` or ``"1.5GiB"``.

    Without one, it is three quarters of what the process has and can get.
    """
    if memory is None:
        return int(0.75 * (psutil.Process().memory_info().rss + free_memory()))
    match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*(?:([KMGT])(I?))?B?\s*", str(memory).upper())
    number, prefix, binary = ("0", None, None) if match is None else match.groups()
    size = int(float(number) * (1024 if binary else 1000) ** (" KMGT".index(prefix or " ")))
    if size <= 0:
        raise ValueError(f"memory must be like '2GB' or '500MB', got {quoted(memory)}")
    return size


def memory_needed(
    info: StackInfo, window: int, restoration: OptionTable, count: int = 1, *, on_gpu: bool = False
) -> int:
    """Memory of the process in bytes while ``count`` windows are processed; without ``restoration`` detection only."""
    if on_gpu:
        pixel_bytes = 8  # frames and result as float32; the rest is in the memory of the GPU
    elif restoration is None:
        pixel_bytes = min(_PIXEL_BYTES.values())
    else:
        pixel_bytes = _PIXEL_BYTES.get(restoration.get("method", "exact"), max(_PIXEL_BYTES.values()))
        pixel_bytes += 0 if restoration.get("prior", "gaussian") == "gaussian" else PRIOR_BYTES
    mosaic = restoration is not None and restoration.get("mosaic") is not None and not on_gpu
    if mosaic or (restoration is not None and restoration.get("scale", 1) != 1):  # mosaics are solved on the finer grid
        pixel_bytes *= _FINER
    frame, stored = int(np.prod(info.shape[1:], dtype=object)), np.dtype(info.dtype).itemsize
    pixels = min(window, info.shape[0]) * frame
    queued = 2 * pixels * stored  # frames read ahead, and frames to be written
    more = _MOSAIC_BYTES + _MOSAIC_FRAME_BYTES * info.shape[-2] * info.shape[-1] if mosaic else 0
    once = _PROCESS_BYTES + info.decoding_bytes + queued
    return once + count * (_WINDOW_BYTES + pixels * pixel_bytes + queued + more)


def windows_at_once(info: StackInfo, options: StackOptions) -> int:
    """Number of windows that can be processed at once within the memory of the machine.

    It is at most ``workers``: by default the number of processors, or 1 on a GPU. The error about too little memory
    states the required size and the largest window that fits.
    """
    window, memory, workers, on_gpu = options.window, options.memory, options.workers, options.device != "cpu"
    if workers is None:
        processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = 1 if on_gpu else processors
    limit = memory_limit(memory)
    needed = partial(memory_needed, info, restoration=options.restoration, on_gpu=on_gpu)
    process, one = needed(window, count=0), needed(window)
    count = (limit - process) // (one - process)
    if count < 1:
        origin = "" if memory is not None else " (three quarters of the memory that is free or used by this process)"
        frames = min(window, info.shape[0])
        fitting = next((smaller for smaller in range(frames - 1, 1, -1) if needed(smaller) <= limit), None)
        remedy = "process smaller frames"
        if fitting is not None:
            remedy = f"process at most {fitting} frames at once (--window)"
        elif info.decoding_bytes > info.frame_bytes:
            decoding = f"{size_text(info.decoding_bytes)} are needed to decode frames that the file stores together"
            remedy = f"store each frame separately: {decoding}"
        raise ValueError(
            f"memory of {size_text(limit)}{origin} is too little: a window of {frames} frames of {info.shape[-2]} x "
            f"{info.shape[-1]} px takes about {size_text(one)}; allow more (--memory), or {remedy}"
        )
    return int(min(workers, count))


def check_stack_fits(info: StackInfo, *, on_gpu: bool) -> None:
    """Raise a ``ValueError`` if a stack that is detected as a whole does not fit into the free memory."""
    what = f"{info.path or 'the frames'}: {info.shape[0]} frames of {info.shape[-2]} x {info.shape[-1]} px"
    needed = memory_needed(info, info.shape[0], None, on_gpu=on_gpu) - psutil.Process().memory_info().rss
    remedy = "process them in windows (rsvib run)"
    check_fits(f"{what}, processed together,", needed, remedy)
