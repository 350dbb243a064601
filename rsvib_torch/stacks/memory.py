"""How many windows may be worked on at once in the memory that there is."""

import os
import re

import numpy as np

from rsvib_torch.stacks.info import StackInfo

__all__ = ["available_memory", "parse_memory", "windows_at_once"]

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}
# Peaks measured on windows of 8 frames of 1024 x 1024 px, rounded up: the process with its libraries, and bytes a
# pixel (and channel) of a window that is detected, restored and judged.
_PROCESS, _PIXEL = 450 * 10**6, 75


def parse_memory(text: str | float) -> int:
    """Bytes that a text like ``"2GB"``, ``"500 MB"`` or ``"1.5GiB"`` says.

    Raises:
        ValueError: If it says none.

    Example:
        >>> parse_memory("2GB"), parse_memory("1.5 GiB"), parse_memory(4096)
        (2000000000, 1610612736, 4096)
    """
    found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([KMGT]I?)?B?\s*", str(text).upper())
    size = 0 if found is None else int(float(found[1]) * _UNITS[found[2] or ""])
    if size <= 0:
        raise ValueError(f"memory must be like '2GB' or '500MB', got {text!r}")
    return size


def available_memory() -> int | None:
    """Bytes of memory that are free, where the system tells."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def windows_at_once(info: StackInfo, window: int, *, memory: int | None, most: int) -> int:
    """Windows to work on at once, so that the process keeps to its memory.

    Args:
        info: The stack.
        window: Frames of a window.
        memory: Bytes for the whole process; None for four fifths of what is free.
        most: Windows that there are processors for.

    Raises:
        ValueError: If not even one window fits into the memory that was stated.
    """
    pixels = min(window, info.shape[0]) * int(np.prod(info.shape[1:], dtype=object))
    waiting = 2 * pixels * np.dtype(info.dtype).itemsize  # read ahead, and to be written
    busy = pixels * _PIXEL + waiting
    limit = memory
    if limit is None:
        free = available_memory()
        limit = None if free is None else int(0.8 * free)
    if limit is None:
        return most
    count = (limit - _PROCESS - waiting) // busy
    if count < 1 and memory is not None:
        needed = _PROCESS + waiting + busy
        raise ValueError(
            f"memory of {memory / 1e9:.2g} GB is too little: a window of {min(window, info.shape[0])} frames of "
            f"{info.shape[-2]} x {info.shape[-1]} px takes about {needed / 1e9:.2g} GB; allow more, or smaller windows"
        )
    return int(max(1, min(most, count)))
