"""Steady videos: a smooth path near the path of the camera, and the margins that the frames lose."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.linalg import solveh_banded
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


_ROUNDS = 100  # of the weights of frames; hands and pans of 112 frames took 1 to 52


def steady_shifts(
    times: Array,
    path: Array,
    duration: float,
    size: tuple[int, int],
    limit: float,
    of_frames: Callable[[Array], Array] = np.asarray,
) -> Array:
    """(N, 4), places of a camera less those of a smooth path along its path, which keeps slow motion.

    The displacements s from the path to the smooth path minimise ``sum_n w_n |s_n|^2 + (T / pi)^4 |a_n|^2``, with the
    duration T and the acceleration a of the smooth path (Whittaker, Proc. Edinburgh Math. Soc. 41, 63, 1922). With
    weights of 1, a sixteenth of an oscillation of the period T remains, and half of one of twice that period. The
    weights of frames that would be moved by more than ``limit`` are larger: like the multipliers of a constraint, they
    rise until these frames are moved by the limit.

    Args:
        times: (N,) s, increasing.
        path: (N, A) places in px or other units, in axes that are the same for all frames.
        duration: s; 0: the path itself.
        size: (height, width) of the frames in px.
        limit: Largest displacement of a corner of the frame, in parts of its width (x) and height (y).
        of_frames: x, y (px), roll (rad) and zoom (N, 4) in the axes of every frame by displacements (N, A).

    Example:
        >>> times = np.arange(90) / 30.0
        >>> shaken = np.stack([20 * times + np.sin(2 * np.pi * 3 * times), 0 * times, 0 * times, 0 * times], -1)
        >>> steady = shaken - steady_shifts(times, shaken, 0.5, (480, 640), 0.1)
        >>> bool(np.abs(steady[30:-30, 0] - 20 * times[30:-30]).max() < 0.02)
        True
    """
    if duration == 0 or len(times) < 3:
        return of_frames(np.zeros_like(path))
    # 1. Accelerations by three neighbouring frames, times (T / pi)^2: of the path, and by displacements.
    before, after = np.diff(times)[:-1], np.diff(times)[1:]
    columns = np.stack([after, -before - after, before]) / (before * after * (before + after))
    columns *= 2 * (min(duration, times[-1] - times[0]) / math.pi) ** 2
    parts = [slice(early, early + len(times) - 2) for early in range(3)]
    bent = sum(column[:, None] * path[part] for column, part in zip(columns, parts, strict=True))
    # 2. Normal equations, whose matrix is a band.
    right, band = np.zeros_like(path), np.zeros((3, len(times)))
    for early, part in enumerate(parts):
        right[part] -= columns[early][:, None] * bent
        for late in range(early, 3):
            band[late - early, part] += columns[early] * columns[late]
    # 3. Weights that keep the limit.
    weights = np.ones(len(times))
    for _ in range(_ROUNDS):
        shifts = of_frames(-solveh_banded(band + np.outer((1, 0, 0), weights), right, lower=True))
        far = largest_displacement(shifts, size) / limit
        if far.max() < 1.01:
            break
        weights = np.maximum(1.0, weights * far**2)
    return shifts


def largest_displacement(shift: Array, size: tuple[int, int]) -> Array:
    """(N,) displacement of the corners of a frame by components (N, 4), in parts of its width or height."""
    height, width = size
    parts: Array = table(largest_in_frame(tensor(np.abs(shift)), width, height)) / np.array([width, height])
    return parts.max(-1)
