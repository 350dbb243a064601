"""A second simulated camera for the counts of confident wrong answers: NumPy and SciPy, float64.

A scene is given on a grid ``FINER`` times finer than the pixels. Gaussian optics and the square pixel are applied on
this grid, and the pixels are sampled from it by cubic splines at the scene position that each of them sees, so that
detail above the Nyquist frequency aliases as on a sensor. The motion is any function of time: translation, roll and
zoom. It shares no code with the package.

A pixel position p sees the scene position s with p - c = (1 + zoom) R(roll) (s - c) + (x, y), c being the centre of the
frame. Positions are in px, the origin is the centre of the first pixel of the frame.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from benchmarks.independent_camera import Array, exposed
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter, uniform_filter

Motion = Callable[[Array], Array]  # times (...) in s -> (4, ...): x and y in px, roll in rad, zoom

FINER = 4  # points of the scene per px and axis
# px of the scene beyond the frame on each side; the camera moves by at most 25 px, and layers that move further
# continue with mirrored content
MARGIN = 44
OPTICS = 0.4  # px, standard deviation of the optics; the MTF of optics and pixel at the Nyquist frequency is 0.29
# nodes of an exposure: minimum, per px of its path, maximum; the rms error of a chart is below 2e-5 up to 74 px
NODES = (5, 2.0, 160)


@dataclass(frozen=True, eq=False)
class Layer:
    """A scene, or a part of it in front of others, that moves by itself."""

    # spline coefficients (rows, columns) on the fine grid, of the light of the layer times its cover
    light: NDArray[np.float32]
    # those of the share of light from behind that the layer blocks; None for a layer that blocks all
    cover: NDArray[np.float32] | None = None
    velocity: tuple[float, float] = (0.0, 0.0)  # motion of the layer over the scene, (x, y) in px/s


def fine_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of the scene of a frame."""
    return FINER * (height + 2 * MARGIN), FINER * (width + 2 * MARGIN)


def seen_by_pixels(fine: Array, optics: float = OPTICS) -> NDArray[np.float32]:
    """Spline coefficients of a fine scene after optics and the mean over a pixel."""
    return np.asarray(spline_filter(uniform_filter(gaussian_filter(fine, FINER * optics), FINER), 3), np.float32)


def layer(fine: Array, cover: Array | None = None, velocity: tuple[float, float] = (0.0, 0.0)) -> Layer:
    """A layer of a fine scene and of its cover, 0 to 1."""
    if cover is None:
        return Layer(seen_by_pixels(fine), None, velocity)
    return Layer(seen_by_pixels(fine * cover), seen_by_pixels(cover), velocity)


def _sampled(coefficients: NDArray[np.float32], row: Array, column: Array) -> Array:
    """Values at positions in px."""
    # pixel 0 covers the points 0 ... 3 with centre 1.5; ``uniform_filter`` of even size has its centre half a point
    # before its index
    places = [FINER * (place + MARGIN) + 0.5 * FINER for place in (row, column)]
    return np.asarray(map_coordinates(coefficients, places, np.float64, order=3, mode="mirror", prefilter=False))


def seen_positions(
    motion: Motion, times: Array, row: Array, column: Array, size: tuple[int, int]
) -> tuple[Array, Array]:
    """Scene positions (rows, columns) that are seen at pixel positions; all arguments broadcast."""
    x, y, roll, zoom = motion(times)
    middle = [0.5 * (n - 1) for n in size]
    down, right = (row - middle[0] - y) / (1.0 + zoom), (column - middle[1] - x) / (1.0 + zoom)
    cos, sin = np.cos(roll), np.sin(roll)
    return middle[0] + cos * down - sin * right, middle[1] + cos * right + sin * down


def longest_path(motion: Motion, starts: Array, exposure: float, size: tuple[int, int], fastest: float = 0.0) -> float:
    """Length in px of the longest path of a point of the frame within an exposure."""
    x, y, roll, zoom = motion(starts.ravel()[:, None] + np.linspace(0.0, exposure, 65))
    turned = 0.5 * np.hypot(*size) * np.hypot(np.diff(roll), np.diff(zoom))
    return float((np.hypot(np.diff(x), np.diff(y)) + turned).sum(-1).max()) + fastest * exposure


def take_frames(layers: Sequence[Layer], motion: Motion, starts: Array, exposure: float, width: int) -> Array:
    """Frames (T, H, W) without noise of a scene and what is in front of it, with exposure starts (T, H) in s."""
    size = (starts.shape[1], width)
    fastest = max(float(np.hypot(*part.velocity)) for part in layers)
    least, for_a_px, most = NODES
    path = longest_path(motion, starts, exposure, size, fastest)
    count = int(min(most, least + np.ceil(for_a_px * path))) if path > 0 else 1
    row, column = np.arange(float(size[0]))[:, None], np.arange(float(width))[None, :]

    def seen_at(times: Array) -> Array:
        down, right = seen_positions(motion, times, row, column, size)
        light = np.zeros(size)
        for part in layers:
            at = (down - part.velocity[1] * times, right - part.velocity[0] * times)
            if part.cover is not None:
                light *= 1.0 - _sampled(part.cover, *at)
            light += _sampled(part.light, *at)
        return light

    return np.stack([exposed(seen_at, of_rows[:, None], exposure, count) for of_rows in starts])


def row_displacement(motion: Motion, starts: Array, exposure: float, width: int) -> Array:
    """Displacement (2, T, H) in px, axes (x, y): the mean over the columns of a row and its exposure."""
    row, column = np.arange(float(starts.shape[1])), np.array(0.5 * (width - 1))

    def moved_at(times: Array) -> Array:
        down, right = seen_positions(motion, times, row, column, (starts.shape[1], width))
        return np.stack([column - right, row - down])

    return exposed(moved_at, starts, exposure, NODES[2])


def standing(x: float = 0.0, y: float = 0.0) -> Motion:
    """The motion of a camera that is displaced by a constant."""
    return lambda times: np.stack([np.full(times.shape, value) for value in (x, y, 0.0, 0.0)])
