"""A rotating rolling-shutter camera in NumPy and OpenCV, independent of the package.

Attitude w = (pitch, yaw, roll) in rad, one tone each; a ray r of the camera at rest appears at R(-w) r.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from rsvib_torch import Camera, SensorTiming, Vibration


@dataclass(frozen=True)
class TrueCamera:
    """Displacement amplitudes in px (x, y) and rad (roll) of a camera with a focal length in px."""

    focal_length: float
    size: tuple[int, int]
    timing: SensorTiming
    amplitude: tuple[float, float, float] = (3.0, 5.0, 1e-3)
    frequency: tuple[float, float, float] = (90.0, 61.0, 70.0)
    phase: tuple[float, float, float] = (0.3, 1.1, 2.0)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    principal_point: tuple[float, float] = (0.0, 0.0)

    @property
    def camera(self):
        return Camera(self.focal_length, self.principal_point, self.distortion)

    def vibration(self, camera=True):
        return Vibration(self.amplitude, self.frequency, self.phase, camera=self.camera if camera else None)

    def components(self, times):
        """X, Y in px and theta in rad at times."""
        tones = zip(self.amplitude, self.frequency, self.phase, strict=True)
        return np.stack([a * np.sin(2 * np.pi * f * times + p) for a, f, p in tones], -1)

    def attitude(self, times):
        x, y, roll = np.moveaxis(self.components(times), -1, 0)
        return np.stack([y / self.focal_length, -x / self.focal_length, -roll], -1)

    def mean_attitude(self, row, frame=0):
        """Attitude of an image row, mean over its exposure, by Gauss-Legendre quadrature."""
        row = self.size[0] - 1 - row if self.timing.readout_direction == "reverse" else row
        start = frame * self.timing.frame_period + row * self.timing.row_time
        nodes, weights = np.polynomial.legendre.leggauss(12)
        times = start + 0.5 * (nodes + 1) * self.timing.exposure_time
        return 0.5 * weights @ self.attitude(times)

    @property
    def matrix(self):
        height, width = self.size
        cx, cy = 0.5 * (width - 1) + self.principal_point[0], 0.5 * (height - 1) + self.principal_point[1]
        return np.array([[self.focal_length, 0, cx], [0, self.focal_length, cy], [0, 0, 1.0]])

    def rest_ray(self, x, y):
        """Ray of the camera at rest through a pixel position."""
        f, (cx, cy) = self.focal_length, self.matrix[:2, 2]
        ray = np.array([(x - cx) / f, (y - cy) / f, 1.0])
        for _ in range(60):
            there = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))[0]
            ray[:2] += (np.array([x, y]) - there.ravel()) / f
        return ray

    def place(self, ray, frame=0, moving=True):
        """Position (x, y) of a ray of the rest axes in a frame: the row at which it is exposed, by iteration."""
        y = 0.5 * self.size[0]
        for _ in range(30 if moving else 1):
            turned = cv2.Rodrigues(-self.mean_attitude(y, frame))[0] @ ray if moving else ray
            x, y = cv2.projectPoints(turned[None], np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))[
                0
            ].ravel()
        return np.array([x, y])
