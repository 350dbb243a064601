"""Simulated camera with rolling or global shutter and aliasing, independent of the package, in NumPy.

The scene is drawn on a grid with half the pixel pitch and blurred so that this grid samples it without aliasing. Frames
take every second sample at the displaced positions, so that detail beyond the Nyquist frequency of the pixels appears
as aliasing, as in a real camera. Interpolation is that of benchmarks/independent_camera.py.
"""

from dataclasses import dataclass

import numpy as np
from benchmarks.independent_camera import POINTS, Array, Shake, closed, fine_rows, polynomial_weights
from numpy.typing import NDArray

PITCH = 2  # samples of the scene per pixel
RIM = 32  # px of scene beyond the largest displacement, over which it fades so that it is periodic
_FINER = 4  # interpolated rows per row of the scene
_NODES = 5  # Gauss-Legendre nodes of an exposure: exact to 1e-6 for half a pixel of motion blur, to 1e-4 for 3 px


def margins(shake: Shake, duration: float) -> tuple[int, int]:
    """Margin of the scene around the frame (down, across), px of the camera."""
    across, down = np.ceil(shake.reach(duration)).astype(int) + RIM
    return int(down), int(across)


@dataclass(frozen=True, eq=False)
class Scene:
    """A still scene around a frame.

    Attributes:
        samples: (PITCH (h + 2 down), PITCH (w + 2 across)), periodic.
        spectra: Its rows' spectra, interpolated across rows.
        still: (h, w), frame of a camera at rest, without noise.
        margin: (down, across) px.
    """

    samples: Array
    spectra: NDArray[np.complex128]
    still: Array
    margin: tuple[int, int]

    @classmethod
    def around(cls, drawn: Array, margin: tuple[int, int]) -> "Scene":
        """The scene of an image drawn at ``PITCH`` samples per pixel, with a margin in px."""
        samples = closed(drawn, (RIM - 8) * PITCH)
        down, across = (PITCH * m for m in margin)
        still = samples[down : len(samples) - down : PITCH, across : samples.shape[1] - across : PITCH]
        return cls(samples, fine_rows(samples, _FINER), still, margin)


def take_frames(
    scene: Scene, shake: Shake, *, row_time: float, exposure_time: float, frame_period: float, num_frames: int
) -> Array:
    """Frames (T, h, w) without noise; ``row_time=0`` is a global shutter."""
    height, width = scene.still.shape
    down, across = (PITCH * m for m in scene.margin)
    u = np.fft.rfftfreq(scene.samples.shape[1])
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    rows = np.arange(height)
    frames = np.empty((num_frames, height, width))
    for p in range(num_frames):
        total = np.zeros((height, len(u)), dtype=complex)
        for node, weight in zip(nodes, weights, strict=True):
            times = p * frame_period + rows * row_time + 0.5 * (1 + node) * exposure_time
            x, y = PITCH * shake.displacement(times)
            source = (down + PITCH * rows - y) * _FINER
            cell = np.floor(source).astype(int)
            taps = 0.5 * weight * polynomial_weights(source - cell)
            row = np.zeros_like(total)
            for i in range(POINTS):
                row += taps[:, i, None] * scene.spectra[(cell + i - (POINTS // 2 - 1)) % len(scene.spectra)]
            total += row * np.exp(-2j * np.pi * x[:, None] * u)
        taken = np.fft.irfft(total, n=scene.samples.shape[1], axis=1)
        frames[p] = taken[:, across : across + PITCH * width : PITCH]
    return frames


def with_noise(frames: Array, noise: float, bits: int, generator: np.random.Generator) -> Array:
    """Frames with Gaussian noise (fraction of full scale), as counts of this number of bits."""
    levels = 2**bits - 1
    noisy = frames + noise * generator.standard_normal(frames.shape)
    return np.round(np.clip(noisy, 0.0, 1.0) * levels) / levels
