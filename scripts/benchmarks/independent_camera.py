"""Simulated frames of a vibrating rolling-shutter camera, independent of the package: NumPy, float64.

The scene is a periodic, band-limited function. It is interpolated densely by Fourier transforms along both axes: a
phase ramp along rows, and across rows zero padding to eight times as many, between which a polynomial of eight points
is exact to 1e-6. The mean over an exposure is computed by Gauss-Legendre quadrature; equidistant times would require
hundreds of samples for long exposures.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FINER = 8  # interpolated rows per row of the scene
POINTS = 8  # of the polynomial between interpolated rows
MOMENTS = (8, 4.0)  # nodes of an exposure: minimum, and per px of the longest possible path


@dataclass(frozen=True)
class Shake:
    """The motion: tones of each axis (x, y), arrays (2, K), and an image motion in px/s, (2,)."""

    amplitude: Array
    frequency: Array
    phase: Array
    image_motion: Array

    def displacement(self, times: Array) -> Array:
        """Displacement (2, ...) in px."""
        flat = times.reshape(1, 1, -1)
        tones = self.amplitude[..., None] * np.sin(2 * np.pi * self.frequency[..., None] * flat + self.phase[..., None])
        return (tones.sum(1) + self.image_motion[:, None] * flat[0]).reshape(2, *times.shape)

    def reach(self, duration: float) -> Array:
        """Largest displacement (2,) in px within a duration from the time origin."""
        return self.amplitude.sum(1) + np.abs(self.image_motion) * duration

    def longest_path(self, duration: float) -> float:
        """Upper bound of the path in px within a duration, from the largest speed or from the range of every period."""
        cycles = np.minimum(np.pi * self.frequency * duration, 2.0 + 4.0 * self.frequency * duration)
        return float((2 * self.amplitude * cycles).sum(1).max() + np.abs(self.image_motion).max() * duration)


def closed(scene: Array, rim: int) -> Array:
    """The scene faded to its mean over ``rim`` px at all borders, so that it is periodic without a discontinuity."""
    faded = scene - scene.mean()
    for axis, size in enumerate(scene.shape):
        place = np.minimum(np.arange(size) + 0.5, size - 0.5 - np.arange(size))
        fade = 0.5 - 0.5 * np.cos(np.pi * np.clip(place / rim, 0.0, 1.0))
        faded = faded * (fade[:, None] if axis == 0 else fade)
    return faded + scene.mean()


def fine_rows(scene: Array, finer: int = FINER) -> NDArray[np.complex128]:
    """Spectra along rows (``finer`` times H, U) of the scene, interpolated across rows."""
    along = np.fft.rfft(scene, axis=1)
    spectrum = np.fft.fftshift(np.fft.fft(along, axis=0), axes=0)
    height = len(scene)
    padded = np.zeros((finer * height, along.shape[1]), dtype=complex)
    first = (finer * height) // 2 - height // 2
    padded[first : first + height] = spectrum
    return np.fft.ifft(np.fft.ifftshift(padded, axes=0), axis=0) * finer


def polynomial_weights(fraction: Array) -> Array:
    """Lagrange weights (..., ``POINTS``) of the points around a position ``fraction`` behind the middle one."""
    points = np.arange(POINTS) - (POINTS // 2 - 1)
    weights = np.ones((*fraction.shape, POINTS))
    for i, own in enumerate(points):
        for other in np.delete(points, i):
            weights[..., i] *= (fraction - other) / (own - other)
    return weights


def exposure_moments(shake: Shake, duration: float) -> tuple[Array, Array]:
    """Quadrature nodes of an exposure, as fractions of it, and their weights."""
    least, for_a_px = MOMENTS
    nodes, weights = np.polynomial.legendre.leggauss(least + int(np.ceil(for_a_px * shake.longest_path(duration))))
    return 0.5 * (nodes + 1), 0.5 * weights


def take_frames(
    scene: Array,
    shake: Shake,
    *,
    row_time: float,
    exposure_rows: float,
    frame_rows: float,
    num_frames: int,
    size: tuple[int, int],
    points: int = 1,
    between: int = FINER,
) -> Array:
    """Frames (T, H, W) without noise, centred on a periodic scene of ``points`` per px along both axes.

    Rows are interpolated from ``between`` rows per row of the scene.
    """
    rows = fine_rows(scene, between)
    top, left = ((whole - points * part) // 2 for whole, part in zip(scene.shape, size, strict=True))
    u = np.fft.rfftfreq(scene.shape[1]) * points  # cycles per px
    frames = np.zeros((num_frames, *size))
    moments, shares = exposure_moments(shake, exposure_rows * row_time)
    for p in range(num_frames):
        total = np.zeros((size[0], len(u)), dtype=complex)
        for moment, share in zip(moments, shares, strict=True):
            place = p * frame_rows + np.arange(size[0]) + moment * exposure_rows
            x, y = shake.displacement(place * row_time)
            source = (top + points * (np.arange(size[0]) - y)) * between
            cell = np.floor(source).astype(int)
            weights = polynomial_weights(source - cell)
            row = np.zeros_like(total)
            for i in range(POINTS):
                row += weights[:, i, None] * rows[(cell + i - (POINTS // 2 - 1)) % len(rows)]
            total += share * row * np.exp(-2j * np.pi * x[:, None] * u)
        frames[p] = np.fft.irfft(total, n=scene.shape[1], axis=1)[:, left : left + points * size[1] : points]
    return frames
