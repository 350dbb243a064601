"""Simulated frames of a vibrating rolling-shutter camera, independent of the package: NumPy, float64.

The scene is a periodic, band-limited function. It is interpolated densely by Fourier transforms along both axes: a
phase ramp along rows, and across rows zero padding to eight times as many, between which a polynomial of eight points
is exact to 1e-6. The mean over an exposure is computed by Gauss-Legendre quadrature; equidistant times would require
hundreds of samples for long exposures.

For cameras that alias, the scene has several points per px: optics (a Gaussian) and pixels (squares) are factors on its
spectrum, and the frames sample the result at the pixels.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BETWEEN = 8  # interpolated rows per row of the scene
POINTS_PER_PX = 4  # of the scenes of cameras that alias
ALIASING = {"points": POINTS_PER_PX, "between": 4}  # options of take_frames for them
POINTS = 8  # of the polynomial between interpolated rows
MOMENTS = (8, 4.0)  # nodes of an exposure: minimum, and per px of the longest possible path


class Timing(Protocol):
    """Times of a camera in s: of a row, 0 for a global shutter; of an exposure; from frame to frame."""

    @property
    def row_time(self) -> float: ...  # noqa: D102
    @property
    def exposure_time(self) -> float: ...  # noqa: D102
    @property
    def frame_period(self) -> float: ...  # noqa: D102


@dataclass(frozen=True)
class Shake:
    """The motion: tones of each axis (x, y), arrays (2, K), and an image motion in px/s, (2,)."""

    amplitude: Array
    frequency: Array
    phase: Array
    image_motion: Array

    @classmethod
    def of(cls, vibration: Any) -> "Shake":
        """The motion of a ``Vibration`` of the package."""
        parts = (vibration.amplitude, vibration.frequency, vibration.phase, vibration.image_motion)
        return cls(*(values.numpy() for values in parts))

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


def fine_rows(scene: Array, finer: int = BETWEEN) -> NDArray[np.complex128]:
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
    timing: Timing,
    num_frames: int,
    size: tuple[int, int],
    *,
    points: int = 1,
    between: int = BETWEEN,
    nodes: int | None = None,
    rows: NDArray[np.complex128] | None = None,
) -> Array:
    """Frames (T, H, W) without noise, centred on a periodic scene of ``points`` per px along both axes.

    There are ``between`` interpolated rows per row of the scene; ``rows`` are ``fine_rows(scene, between)``, where they
    are used several times. The quadrature of an exposure has as many ``nodes`` as the motion needs, if none are given.
    """
    rows = fine_rows(scene, between) if rows is None else rows
    top, left = ((whole - points * part) // 2 for whole, part in zip(scene.shape, size, strict=True))
    u = np.fft.rfftfreq(scene.shape[1]) * points  # cycles per px
    frames = np.zeros((num_frames, *size))
    if nodes is None:
        moments, shares = exposure_moments(shake, timing.exposure_time)
    else:
        moments, shares = (0.5 * values for values in np.polynomial.legendre.leggauss(nodes))
        moments = moments + 0.5
    for p in range(num_frames):
        total = np.zeros((size[0], len(u)), dtype=complex)
        for moment, share in zip(moments, shares, strict=True):
            times = p * timing.frame_period + np.arange(size[0]) * timing.row_time + moment * timing.exposure_time
            x, y = shake.displacement(times)
            source = (top + points * (np.arange(size[0]) - y)) * between
            cell = np.floor(source).astype(int)
            weights = polynomial_weights(source - cell)
            row = np.zeros_like(total)
            for i in range(POINTS):
                row += weights[:, i, None] * rows[(cell + i - (POINTS // 2 - 1)) % len(rows)]
            total += share * row * np.exp(-2j * np.pi * x[:, None] * u)
        frames[p] = np.fft.irfft(total, n=scene.shape[1], axis=1)[:, left : left + points * size[1] : points]
    return frames


def after_optics(scene: Array, sigma: float, pixel: float = 1.0) -> Array:
    """The scene after Gaussian optics of ``sigma`` px and square pixels of ``pixel`` px, on its own grid."""
    v, u = (np.fft.fftfreq(size) * POINTS_PER_PX for size in scene.shape)  # cycles per px
    transfer = [np.exp(-2 * (np.pi * sigma * w) ** 2) * np.sinc(pixel * w) for w in (v, u)]
    return np.fft.ifft2(np.fft.fft2(scene) * transfer[0][:, None] * transfer[1]).real


def still_image(scene: Array, size: tuple[int, int], scale: int = 1, offset: tuple[int, int] = (0, 0)) -> Array:
    """The scene after the optics on a grid of ``scale`` points per px, moved by an offset in points of the scene."""
    top, left = ((whole - POINTS_PER_PX * part) // 2 for whole, part in zip(scene.shape, size, strict=True))
    moved = np.roll(scene, (offset[0] - top, offset[1] - left), (0, 1))
    step = POINTS_PER_PX // scale
    return moved[: POINTS_PER_PX * size[0] : step, : POINTS_PER_PX * size[1] : step]


def mosaic_of(frames: Array, pattern: str) -> Array:
    """Raw frames (T, H, W) behind colour filters from colour frames (T, 3, H, W).

    ``pattern`` names the colours of the pixels (0, 0), (0, 1), (1, 0), (1, 1).
    """
    raw = np.empty((len(frames), *frames.shape[-2:]))
    for place, colour in enumerate(pattern):
        part = (slice(place // 2, None, 2), slice(place % 2, None, 2))
        raw[:, *part] = frames[:, "RGB".index(colour), *part]
    return raw
