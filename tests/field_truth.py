"""Frames of a camera that rolls and zooms, independent of the package: SciPy splines in two dimensions, float64.

A pixel p sees the scene position s with ``p - c = (s - c) + (X - theta y + zeta x, Y + theta x + zeta y)``, where c is
the centre of the frame and (x, y) = s - c. Every pixel is sampled at its own position and time.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from rsvib_torch import SensorTiming, Vibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FieldMotion:
    """One tone for each of x (px), y (px), roll (rad) and zoom."""

    amplitude: tuple[float, float, float, float] = (2.0, 3.0, 2e-3, 1e-3)
    frequency: tuple[float, float, float, float] = (90.0, 61.0, 70.0, 53.0)
    phase: tuple[float, float, float, float] = (0.3, 1.1, 2.0, 0.7)

    def components(self, times: Array) -> list[Array]:
        tones = zip(self.amplitude, self.frequency, self.phase, strict=True)
        return [a * np.sin(2 * np.pi * f * times + p) for a, f, p in tones]

    def vibration(self, axes: int = 4) -> Vibration:
        return Vibration(self.amplitude[:axes], self.frequency[:axes], self.phase[:axes])


def take_field_frames(
    scene: Array, timing: SensorTiming, motion: FieldMotion, size: tuple[int, int], num_frames: int = 2, nodes: int = 12
) -> Array:
    """Frames (T, H, W) in image orientation, centred on the scene."""
    height, width = size
    top, left = ((whole - part) / 2 for whole, part in zip(scene.shape, size, strict=True))
    coefficients = spline_filter(scene, 5)
    row, column = np.mgrid[:height, :width].astype(float)
    line, lines = (row, height) if timing.scan_axis == -2 else (column, width)
    line = lines - 1 - line if timing.readout_direction == "reverse" else line
    moments, weights = np.polynomial.legendre.leggauss(nodes)
    frames = np.zeros((num_frames, height, width))
    for frame in range(num_frames):
        starts = frame * timing.frame_period + line * timing.row_time
        for moment, weight in zip(0.5 * (moments + 1), 0.5 * weights, strict=True):
            x, y, roll, zoom = motion.components(starts + moment * timing.exposure_time)
            right, down = column - 0.5 * (width - 1) - x, row - 0.5 * (height - 1) - y
            scale = 1 + zoom
            seen_x = (scale * right + roll * down) / (scale**2 + roll**2)
            seen_y = (scale * down - roll * right) / (scale**2 + roll**2)
            places = [seen_y + 0.5 * (height - 1) + top, seen_x + 0.5 * (width - 1) + left]
            frames[frame] += weight * map_coordinates(coefficients, places, order=5, prefilter=False, mode="mirror")
    return frames
