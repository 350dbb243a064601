"""How many windows may be worked on at once in the memory that there is."""

import os
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from rsvib_torch.stacks.info import StackInfo

__all__ = ["available_memory", "parse_memory", "windows_at_once"]

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}
# Bytes a pixel of a window's frames (and channel), peaks measured with scripts/benchmarks/streaming.py; the process
# itself, with its libraries, comes on top.
_PROCESS = 500 * 10**6
_DETECTION = {"direct": 60.0, "bands": 40.0}
_RESTORATION = {"exact": 60.0, "banded": 60.0, "dewarp": 30.0, "richardson-lucy": 60.0}


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


def window_bytes(
    info: StackInfo, window: int, detection: Mapping[str, Any], restoration: Mapping[str, Any] | None
) -> tuple[int, int]:
    """Peak memory of one window that is worked on, and of one that waits."""
    pixels = min(window, info.shape[0]) * int(np.prod(info.shape[1:], dtype=object))
    waiting = pixels * np.dtype(info.dtype).itemsize
    factor = _DETECTION.get(str(detection.get("method", "direct")), max(_DETECTION.values()))
    if restoration is not None:
        most = max(_RESTORATION.values())
        factor = max(factor, _RESTORATION.get(str(restoration.get("method", "exact")), most))
    return int(pixels * factor) + 2 * waiting, waiting


def windows_at_once(
    info: StackInfo,
    window: int,
    detection: Mapping[str, Any],
    restoration: Mapping[str, Any] | None,
    *,
    memory: int | None,
    most: int,
) -> int:
    """Windows to work on at once, so that the process keeps to its memory.

    Args:
        info: The stack.
        window: Frames of a window.
        detection: Options of detection.
        restoration: Options of restoration.
        memory: Bytes for the whole process; None for four fifths of what is free.
        most: Windows that there are processors for.

    Raises:
        ValueError: If not even one window fits into the memory that was stated.
    """
    busy, waiting = window_bytes(info, window, detection, restoration)
    limit = memory
    if limit is None:
        free = available_memory()
        limit = None if free is None else int(0.8 * free)
    if limit is None:
        return most
    count = (limit - _PROCESS - 2 * waiting) // (busy + 2 * waiting)
    if count < 1 and memory is not None:
        needed = _PROCESS + busy + 4 * waiting
        raise ValueError(
            f"memory of {memory / 1e9:.2g} GB is too little: a window of {min(window, info.shape[0])} frames of "
            f"{info.shape[-2]} x {info.shape[-1]} px takes about {needed / 1e9:.2g} GB; allow more, or smaller windows"
        )
    return int(max(1, min(most, count)))
