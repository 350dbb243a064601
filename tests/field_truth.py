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
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    fisheye: bool = False

    def project(self, rays: Array, scale: float = 1.0) -> Array:
        """Points (N, 2) of rays (N, 3), for a focal length that is larger by a factor."""
        (x, y), f = self.principal_point, scale * self.focal_length
        camera = np.array([[f, 0, x], [0, f, y], [0, 0, 1]]), np.array(self.distortion)
        of_lens = cv2.fisheye.projectPoints if self.fisheye else cv2.projectPoints
        return of_lens(rays[:, None], np.zeros(3), np.zeros(3), *camera)[0][:, 0]

    def rays(self, points: Array) -> Array:
        """Rays (N, 3) through points (N, 2)."""
        rays = np.c_[(points - self.principal_point) / self.focal_length, np.ones(len(points))]
        if self.fisheye:
            precise, lens = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-15), np.array(self.distortion)
            rays[:, None, :2] = cv2.fisheye.undistortPoints(rays[:, None, :2], np.eye(3), lens, criteria=precise)
            return rays
        for _ in range(30):  # a fixed point: each step leaves less than a third of the error
            rays[:, :2] -= (self.project(rays) - points) / self.focal_length
        return rays

    def turned(self, points: Array, components: Array, scale: float = 1.0) -> Array:
        """Points (N, 2) where content appears that is rotated by components (N, 3): x (px), y (px) and roll (rad)."""
        x, y, theta = np.moveaxis(np.asarray(components), -1, 0)
        moved = np.stack([-y / self.focal_length, x / self.focal_length, theta], -1)
        return self.project(Rotation.from_rotvec(moved).apply(self.rays(points)), scale)

    def seen(self, right: Array, down: Array, times: Array) -> tuple[Array, Array]:
        components = np.stack(self.components(times)[:3], -1).reshape(-1, 3)
        seen = self.turned(np.stack([right, down], -1).reshape(-1, 2), -components).reshape(*right.shape, 2)
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
