"""Ground truth for tests, independent of the package: scenes, motion and frames in NumPy float64.

Displacement along rows is a Fourier shift of a scene larger than the frame, displacement across rows a quintic spline
with the prefilter of SciPy, and the exposure a midpoint sum.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import BSpline

from rsvib_torch import SensorTiming, Vibration

Array = NDArray[np.float64]
MARGIN = 40


@dataclass(frozen=True)
class Motion:
    """One tone per axis (x, y) and uniform image motion, with an independent formula for the displacement."""

    amplitude: tuple[float, float] = (3.1, 5.2)
    frequency: tuple[float, float] = (50.0, 30.0)
    phase: tuple[float, float] = (0.4, 1.3)
    image_motion: tuple[float, float] = (0.0, 0.0)

    def displacement(self, times: Array) -> Array:
        tones = zip(self.amplitude, self.frequency, self.phase, self.image_motion, strict=True)
        return np.stack([a * np.sin(2 * np.pi * f * times + p) + v * times for a, f, p, v in tones], axis=-1)

    def scaled(self, factor: float) -> "Motion":
        amplitude = (self.amplitude[0] * factor, self.amplitude[1] * factor)
        return Motion(amplitude, self.frequency, self.phase, self.image_motion)

    def vibration(self) -> Vibration:
        return Vibration(self.amplitude, self.frequency, self.phase, self.image_motion)


class Curve(Motion):
    """A motion that is any function of the time in s, with values (..., 2) in px."""

    def __init__(self, curve: Callable[[Array], Array]) -> None:
        object.__setattr__(self, "curve", curve)

    def displacement(self, times: Array) -> Array:
        return np.asarray(self.curve(times))  # type: ignore[attr-defined]


def draw_scene(height: int, width: int, seed: int, blur: float = 0.8) -> Array:
    """Fractal ground with bright and dark buildings, blurred by Gaussian optics, values within 0 ... 1."""
    generator = np.random.default_rng(seed)
    v, u = np.meshgrid(np.fft.fftfreq(height), np.fft.rfftfreq(width), indexing="ij")
    spectrum = np.fft.rfft2(generator.standard_normal((height, width))) / np.hypot(np.hypot(u, v), 2e-3) ** 1.1
    spectrum[0, 0] = 0
    ground = np.fft.irfft2(spectrum, s=(height, width))
    scene = 0.45 + 0.12 * ground / ground.std()
    for _ in range(height * width // 1500):
        top, left = generator.integers(0, height), generator.integers(0, width)
        tall, wide = generator.integers(4, 28, 2)
        scene[top : top + tall, left : left + wide] = generator.uniform(0.1, 0.9)
    return np.clip(ndimage.gaussian_filter(scene, blur), 0.0, 1.0)


def take_frames(
    scene: Array,
    timing: SensorTiming,
    motion: Motion,
    num_frames: int = 2,
    noise: float = 0.0,
    *,
    seed: int = 0,
    margin: int = MARGIN,
    samples: int | None = None,
) -> Array:
    """Frames (T, H, W) of the centred part of the scene, ``margin`` px smaller on every side."""
    height, width = (size - 2 * margin for size in scene.shape)
    coefficients = ndimage.spline_filter1d(scene, order=5, axis=0, mode="mirror")
    spectra = np.fft.rfft(coefficients, axis=1)
    u = np.fft.rfftfreq(scene.shape[1])
    basis = BSpline.basis_element(np.arange(7) - 3.0, extrapolate=False)
    count = max(int(np.ceil(timing.exposure_rows)), 8) if samples is None else samples
    frames = np.zeros((num_frames, height, width))
    for p in range(num_frames):
        total = np.zeros((height, len(u)), dtype=complex)
        for n in range(count):
            times = (p * timing.frame_rows + np.arange(height)) * timing.row_time
            x, y = motion.displacement(times + (n + 0.5) / count * timing.exposure_time).T
            place = np.arange(height) + margin - y
            first = np.floor(place).astype(int) - 2
            rows = np.zeros_like(total)
            for tap in range(6):
                weight = np.nan_to_num(basis(place - first - tap))
                rows += weight[:, None] * spectra[np.clip(first + tap, 0, scene.shape[0] - 1)]
            total += rows * np.exp(-2j * np.pi * x[:, None] * u)
        frames[p] = np.fft.irfft(total / count, n=scene.shape[1], axis=1)[:, margin : margin + width]
    return frames + noise * np.random.default_rng(seed).standard_normal(frames.shape)


def crop(scene: Array, margin: int = MARGIN) -> Array:
    """The part of the scene in frames of a camera at rest."""
    return scene[margin:-margin, margin:-margin]


def decibel(image: Array, truth: Array, rim: int = 32) -> float:
    """PSNR in dB for full scale 1, excluding a rim."""
    error = (np.asarray(image, dtype=np.float64) - truth)[..., rim:-rim, rim:-rim]
    return float(-10 * np.log10(np.mean(error**2)))
