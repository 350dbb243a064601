"""Frames of a camera that rolls and zooms, independent of the package: SciPy splines in two dimensions, float64.

A pixel p sees the scene position s with ``p - c = (s - c) + (X - theta y + zeta x, Y + theta x + zeta y)``, where c is
the centre of the frame and (x, y) = s - c. Every pixel is sampled at its own position and time. With a lens, rays are
rotated by SciPy and projected by OpenCV instead.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from benchmarks.independent_camera import Array, exposed
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial.transform import Rotation

from rsvib_torch import SensorTiming, Vibration


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

    def seen(self, right: Array, down: Array, times: Array) -> tuple[Array, Array]:
        """Scene positions that pixels see, both in px from the centre of the frame."""
        x, y, roll, zoom = self.components(times)
        right, down, scale = right - x, down - y, 1 + zoom
        square = scale**2 + roll**2
        return (scale * right + roll * down) / square, (scale * down - roll * right) / square


@dataclass(frozen=True)
class LensMotion(FieldMotion):
    """The same for a rotation of a camera with a focal length and a lens; without zoom."""

    focal_length: float = 400.0
    principal_point: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def project(self, rays: Array) -> Array:
        (x, y), f = self.principal_point, self.focal_length
        matrix = np.array([[f, 0, x], [0, f, y], [0, 0, 1]])
        return cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, np.array(self.distortion))[0][:, 0]

    def rays(self, points: Array) -> Array:
        rays = np.c_[(points - self.principal_point) / self.focal_length, np.ones(len(points))]
        for _ in range(12):  # a fixed point: the distortion moves points by less than a tenth
            rays[:, :2] -= (self.project(rays) - points) / self.focal_length
        return rays

    def seen(self, right: Array, down: Array, times: Array) -> tuple[Array, Array]:
        x, y, theta, _ = self.components(times)
        moved = np.stack([-y / self.focal_length, x / self.focal_length, theta], -1).reshape(-1, 3)  # of the scene
        rays = self.rays(np.stack([right, down], -1).reshape(-1, 2))
        seen = self.project(Rotation.from_rotvec(-moved).apply(rays)).reshape(*right.shape, 2)
        return seen[..., 0], seen[..., 1]


def pixel_starts(timing: SensorTiming, size: tuple[int, int], num_frames: int) -> Array:
    """Exposure starts (T, H, W) of pixels in image orientation, s."""
    lines = size[timing.scan_axis]
    line = np.arange(lines)[:: -1 if timing.readout_direction == "reverse" else 1]
    of_line = np.broadcast_to(line[:, None] if timing.scan_axis == -2 else line, size)
    return np.arange(num_frames)[:, None, None] * timing.frame_period + of_line * timing.row_time


def take_field_frames(
    scene: Array, timing: SensorTiming, motion: FieldMotion, size: tuple[int, int], num_frames: int = 2, nodes: int = 6
) -> Array:
    """Frames (T, H, W) in image orientation, centred on the scene."""
    middle = [(length - 1) / 2 for length in scene.shape]
    coefficients = spline_filter(scene, 5)
    down, right = np.mgrid[: size[0], : size[1]] - (np.array(size)[:, None, None] - 1) / 2

    def seen_at(times: Array) -> Array:
        x, y = motion.seen(right, down, times)
        places = [y + middle[0], x + middle[1]]
        return map_coordinates(coefficients, places, order=5, prefilter=False, mode="mirror")

    starts = pixel_starts(timing, size, num_frames)
    return np.stack([exposed(seen_at, of_frame, timing.exposure_time, nodes) for of_frame in starts])
