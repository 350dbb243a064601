"""Frames of a camera that aliases, for tests of the finer grid, and a check of gradients by differences.

The camera is that of ``scripts/benchmarks/independent_camera.py``, which shares no code with the package.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from benchmarks.independent_camera import POINTS_PER_PX as FINER
from benchmarks.independent_camera import Array, Shake, take_frames
from torch import Tensor

import rsvib_torch as rsv

SHAKE = Shake(np.array([[3.1], [5.2]]), np.array([[90.0], [61.0]]), np.array([[0.4], [1.3]]), np.zeros(2))
VIBRATION = rsv.Vibration([3.1, 5.2], [90.0, 61.0], [0.4, 1.3])
TIMING = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=571)


def taken(scene: Array, count: int, size: int, shake: Shake = SHAKE) -> Array:
    """Noise-free frames (T, size, size) of a scene on the grid of the camera."""
    return take_frames(scene, shake, TIMING, count, (size, size), points=FINER)


def noisy(clean: Array, noise: float, seed: int = 1) -> Tensor:
    """Frames with white noise, float32."""
    return torch.from_numpy(clean + noise * np.random.default_rng(seed).standard_normal(clean.shape)).float()


def check_gradient(energy: Callable[[Tensor], Tensor], values: Tensor, rel: float) -> None:
    """Compare the gradient of a scalar function with its difference along a random direction."""
    values = values.detach().double().requires_grad_()
    gradient = torch.autograd.grad(energy(values), values)[0]
    step = torch.randn(values.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    with torch.no_grad():
        change = (energy(values + 1e-4 * step) - energy(values - 1e-4 * step)) / 2e-4
    assert float((gradient * step).sum()) == pytest.approx(float(change), rel=rel)
