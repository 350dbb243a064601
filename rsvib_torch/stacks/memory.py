"""How many windows may be worked on at once in the memory that there is."""

import inspect
import os
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.restoration import restore

__all__ = ["available_memory", "memory_needed", "parse_memory", "windows_at_once"]

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}
# Peaks measured by scripts/benchmark.py --only memory, rounded up: the process with its libraries, what a window takes
# whatever its size, and bytes a pixel (and channel) of a window that is detected, restored and judged.
_PROCESS, _WINDOW = 450 * 10**6, 80 * 10**6
_PIXEL = {"dewarp": 55, "banded": 55, "exact": 68, "richardson-lucy": 105}
_EDGES = 80  # with prior="edges"
_METHOD = inspect.signature(restore).parameters["method"].default


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


def _pixel_bytes(restoration: Mapping[str, Any] | None) -> int:
    """Bytes a pixel that restoring with these options takes; detection and the verdict take as much as the least."""
    if restoration is None:
        return min(_PIXEL.values())
    if restoration.get("prior") == "edges":
        return _EDGES
    return _PIXEL.get(restoration.get("method", _METHOD), max(_PIXEL.values()))


def _needs(info: StackInfo, window: int, restoration: Mapping[str, Any] | None) -> tuple[int, int]:
    """Bytes of the process without windows, and of each window that is worked on."""
    pixels = min(window, info.shape[0]) * int(np.prod(info.shape[1:], dtype=object))
    waiting = 2 * pixels * np.dtype(info.dtype).itemsize  # read ahead, and to be written
    return _PROCESS + waiting, _WINDOW + pixels * _pixel_bytes(restoration) + waiting


def memory_needed(info: StackInfo, window: int, restoration: Mapping[str, Any] | None, count: int = 1) -> int:
    """Bytes that the process takes while ``count`` windows are worked on; see ``windows_at_once``."""
    rest, busy = _needs(info, window, restoration)
    return rest + count * busy


def windows_at_once(
    info: StackInfo, window: int, *, memory: int | None, most: int, restoration: Mapping[str, Any] | None
) -> int:
    """Windows to work on at once, so that the process keeps to its memory.

    Args:
        info: The stack.
        window: Frames of a window.
        memory: Bytes for the whole process; None for four fifths of what is free.
        most: Windows that there are processors for.
        restoration: Options of ``restore``; None where frames are not restored.

    Raises:
        ValueError: If not even one window fits into the memory that was stated.
    """
    rest, busy = _needs(info, window, restoration)
    limit = memory
    if limit is None:
        free = available_memory()
        limit = None if free is None else int(0.8 * free)
    if limit is None:
        return most
    count = (limit - rest) // busy
    if count < 1 and memory is not None:
        raise ValueError(
            f"memory of {memory / 1e9:.2g} GB is too little: a window of {min(window, info.shape[0])} frames of "
            f"{info.shape[-2]} x {info.shape[-1]} px takes about {(rest + busy) / 1e9:.2g} GB; allow more, "
            "or smaller windows"
        )
    return int(max(1, min(most, count)))
