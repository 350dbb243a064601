"""Steady videos: a smooth path near the path of the camera, and the margins that the frames lose."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from torch import Tensor

from rsvib_torch.motion.camera import largest_in_frame
from rsvib_torch.numerics.tables import Array, table, tensor

Pixels = TypeVar("Pixels", Tensor, Array)


@dataclass(frozen=True)
class Margins:
    """Rows and columns (px) to cut from the frames so that no extrapolated pixel remains."""

    top: int
    bottom: int
    left: int
    right: int

    def cut(self, images: Pixels) -> Pixels:
        """Images (..., H, W) without the margins; height and width remain even, as video encoders require.

        Raises:
            ValueError: If nothing remains.
        """
        height, width = images.shape[-2:]
        rows, columns = height - self.top - self.bottom, width - self.left - self.right
        if rows < 2 or columns < 2:
            raise ValueError(
                f"the margins {self} leave nothing of frames of {height} x {width} px: the image moves too far; use "
                "border='mirror', or a shorter --steady"
            )
        rows, columns = rows - rows % 2, columns - columns % 2
        return images[..., self.top : self.top + rows, self.left : self.left + columns]


_HALVINGS = 5  # of the time over which the path is averaged, where the frame would be moved too far


def steady_shifts(
    times: Array, apart: Callable[[int, slice], Array], duration: float, size: tuple[int, int], limit: float
) -> Array:
    """(N, 4), places of a camera less those of a smooth path along its path, which keeps slow motion.

    Each place of the smooth path is the value of a straight line that fits the path around it, with the weights of a
    Hann window whose width at half of its height is ``duration``: oscillations of that period vanish. Where the frame
    would be moved by more than ``limit``, the window is shorter.

    Args:
        times: (N,) s, increasing.
        apart: (n, 4) path from the place of a frame to those of others: x, y (px), roll (rad), zoom.
        duration: s; 0: the path itself.
        size: (height, width) of the frames in px.
        limit: Largest displacement of a corner of the frame, in parts of its width (x) and height (y).

    Example:
        >>> times = np.arange(90) / 30.0
        >>> shaken = np.stack([20 * times + np.sin(2 * np.pi * 3 * times), 0 * times, 0 * times, 0 * times], -1)
        >>> apart = lambda number, others: shaken[others] - shaken[number]
        >>> steady = shaken - steady_shifts(times, apart, 1 / 3, (480, 640), 0.1)
        >>> bool(np.abs(steady[20:-20, 0] - 20 * times[20:-20]).max() < 0.01)
        True
    """
    if duration == 0 or len(times) < 3:
        return np.zeros((len(times), 4))
    # 1. The path with shorter and shorter windows; the last level is the path itself.
    levels = [-_local_lines(times, apart, duration / 2**level) for level in range(_HALVINGS + 1)]
    levels.append(np.zeros_like(levels[0]))
    far = [largest_displacement(level, size) for level in levels]
    # 2. The longest window of every frame that keeps the limit; it changes slowly along the video.
    needed = np.argmax(np.array(far) <= limit, axis=0).astype(np.float64)
    around = 2 * math.ceil(duration * (len(times) - 1) / (times[-1] - times[0])) + 1
    needed = uniform_filter1d(maximum_filter1d(needed, around), around, mode="nearest")
    # 3. Between two levels, their mean.
    first = np.minimum(needed.astype(int), len(levels) - 2)
    share, stacked, every = (needed - first)[:, None], np.stack(levels), np.arange(len(times))
    return (1 - share) * stacked[first, every] + share * stacked[first + 1, every]


def _local_lines(times: Array, apart: Callable[[int, slice], Array], duration: float) -> Array:
    """Values of straight lines that fit the path around every place, with the weights of a Hann window."""
    lines = np.empty((len(times), 4))
    firsts, ends = np.searchsorted(times, times - duration), np.searchsorted(times, times + duration, "right")
    for number, (first, end) in enumerate(zip(firsts, ends, strict=True)):
        places, delay = apart(number, slice(first, end)), times[first:end] - times[number]
        weight = np.cos(0.5 * math.pi * delay / duration) ** 2 + 1e-9
        weight /= weight.sum()
        mean, centre = weight @ places, weight @ delay
        spread = weight @ (delay - centre) ** 2
        slope = (weight * (delay - centre)) @ places / spread if spread > 0 else 0.0
        lines[number] = mean - centre * slope
    return lines


def largest_displacement(shift: Array, size: tuple[int, int]) -> Array:
    """(N,) displacement of the corners of a frame by components (N, 4), in parts of its width or height."""
    height, width = size
    parts: Array = table(largest_in_frame(tensor(np.abs(shift)), width, height)) / np.array([width, height])
    return parts.max(-1)
