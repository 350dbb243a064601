"""Ground truth for tests, independent of the package: scenes, motion and frames in NumPy float64.

The camera is that of ``scripts/benchmarks/independent_camera.py``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from benchmarks import independent_camera
from benchmarks.independent_camera import Array, decibel  # noqa: F401 - tests import it from here
from scipy import ndimage
from torch import Tensor

from rsvib_torch import SensorTiming, Vibration

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
) -> Array:
    """Frames (T, H, W) of the centred part of the scene, ``margin`` px smaller on every side."""
    height, width = (size - 2 * margin for size in scene.shape)
    frames = independent_camera.take_frames(scene, motion, timing, num_frames, (height, width), between=1)
    return frames + noise * np.random.default_rng(seed).standard_normal(frames.shape)


def recorded(size: tuple[int, int], *camera: Any, seed: int = 0, margin: int = MARGIN) -> Tensor:
    """``take_frames``, float32, of a scene that is drawn from the seed, which is that of the noise as well."""
    scene = draw_scene(size[0] + 2 * margin, size[1] + 2 * margin, seed)
    return torch.from_numpy(take_frames(scene, *camera, seed=seed, margin=margin)).float()


def tone_errors(vibration: Any, motion: Motion) -> Tensor:
    """Errors (3, 2) of the first tone of each axis: period %, amplitude %, phase in pi."""
    truth = motion.vibration()
    turn = torch.remainder(vibration.phase - truth.phase + np.pi, 2 * np.pi) - np.pi
    period = 100 * (truth.frequency / vibration.frequency - 1)
    amplitude = 100 * (vibration.amplitude / truth.amplitude - 1)
    return torch.stack([period, amplitude, turn / np.pi])[..., 0].abs()


def crop(scene: Array, margin: int = MARGIN) -> Array:
    """The part of the scene in frames of a camera at rest."""
    return scene[margin:-margin, margin:-margin]
