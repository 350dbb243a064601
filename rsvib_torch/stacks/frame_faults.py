"""Frames that cannot be used, and why."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["frame_fault", "placeholder"]

_LEAST_PIXELS = 0.1  # of a frame must have been measured
_FLAT = 1e-7  # of the largest value


def frame_fault(frame: NDArray[Any], index: int, full_scale: float | None) -> str | None:
    """Why a frame cannot be used, or None.

    Args:
        frame: Pixels as stored.
        index: Number of the frame in the stack, for the message.
        full_scale: Count that means 1.0; not used for floats.
    """
    low, high = frame.min(), frame.max()
    if frame.dtype.kind != "f":
        if full_scale is not None and high > full_scale:
            return (
                f"counts reach {high}, beyond full_scale={full_scale:g}; state the count that means full scale "
                f"(frame {index})"
            )
    elif not np.isfinite(low) or not np.isfinite(high):
        infinite = np.isinf(frame)
        if infinite.any():
            place = tuple(int(i) for i in np.argwhere(infinite)[0])
            return f"frames must be finite, but pixel {(index, *place)} is {float(frame[place])}"
        missing = float(np.isnan(frame).mean())
        if 1.0 - missing < _LEAST_PIXELS:
            return f"frame {index} has only {1.0 - missing:.1%} of pixels that count"
        low, high = np.nanmin(frame), np.nanmax(frame)
    if float(high) - float(low) <= _FLAT * max(abs(float(high)), abs(float(low))):
        return f"frame {index} is constant: without detail there is nothing to register"
    return None


def placeholder(shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
    """What stands for a frame that cannot be read: NaN, or 0 where integers are kept."""
    kind = np.dtype(dtype)
    return np.full(shape, np.nan if kind.kind == "f" else 0, dtype=kind)
