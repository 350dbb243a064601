"""Memory planning: how many windows can be processed at once in the available memory."""

import os
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from rsvib_torch.io.stack_info import StackInfo

__all__ = ["available_memory", "memory_needed", "parse_memory", "windows_at_once"]

# bytes; of the process with its libraries, and of a window independent of its size; peaks measured by
# scripts/benchmark.py --only memory, rounded up
_PROCESS_BYTES, _WINDOW_BYTES = 450 * 10**6, 80 * 10**6
# bytes per pixel and channel of a window that is detected, restored and judged; same measurement
_PIXEL_BYTES = {"dewarp": 55, "banded": 55, "exact": 68, "richardson-lucy": 105, "edges": 80}


def parse_memory(text: str | float) -> int:
    """Number of bytes of a text like ``"2GB"``, ``"500 MB"`` or ``"1.5GiB"``.

    Raises:
        ValueError: If it is not a positive size.

    Example:
        >>> parse_memory("2GB"), parse_memory("1.5 GiB"), parse_memory(4096)
        (2000000000, 1610612736, 4096)
    """
    match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*(?:([KMGT])(I?))?B?\s*", str(text).upper())
    size = 0
    if match is not None:
        number, prefix, binary = match.groups()
        size = int(float(number) * (1024 if binary else 1000) ** (" KMGT".index(prefix) if prefix else 0))
    if size <= 0:
        raise ValueError(f"memory must be like '2GB' or '500MB', got {text!r}")
    return size


def available_memory() -> int | None:
    """Free memory in bytes; None if the system does not report it."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def memory_needed(info: StackInfo, window: int, restoration: Mapping[str, Any] | None, count: int = 1) -> int:
    """Memory of the process in bytes while ``count`` windows are processed; arguments as in ``windows_at_once``."""
    if restoration is None:
        pixel_bytes = min(_PIXEL_BYTES.values())
    elif restoration.get("prior", "gaussian") != "gaussian":  # other priors need at most as much as "edges"
        pixel_bytes = _PIXEL_BYTES["edges"]
    else:
        pixel_bytes = _PIXEL_BYTES.get(restoration.get("method", "exact"), max(_PIXEL_BYTES.values()))
    pixels = min(window, info.shape[0]) * int(np.prod(info.shape[1:], dtype=object))
    queued = 2 * pixels * np.dtype(info.dtype).itemsize  # frames read ahead, and frames to be written
    return _PROCESS_BYTES + queued + count * (_WINDOW_BYTES + pixels * pixel_bytes + queued)


def windows_at_once(
    info: StackInfo, window: int, *, memory: int | None, most: int, restoration: Mapping[str, Any] | None
) -> int:
    """Number of windows that can be processed at once.

    Args:
        info: The stack.
        window: Frames per window.
        memory: Limit for the process in bytes; None for 80 % of the free memory.
        most: Number of processors.
        restoration: Options of ``restore``; None for detection only.

    Raises:
        ValueError: If a stated limit is too small for one window.
    """
    process, one = (memory_needed(info, window, restoration, count) for count in (0, 1))
    free = available_memory()
    if memory is None and free is None:
        return most
    limit = memory if memory is not None else int(0.8 * (free or 0))
    count = (limit - process) // (one - process)
    if count < 1 and memory is not None:
        raise ValueError(
            f"memory of {memory / 1e9:.2g} GB is too little: a window of {min(window, info.shape[0])} frames of "
            f"{info.shape[-2]} x {info.shape[-1]} px takes about {one / 1e9:.2g} GB; allow more, "
            "or smaller windows"
        )
    return int(max(1, min(most, count)))
