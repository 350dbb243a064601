"""How far two images of one scene lie apart, from the brightness of their difference along edges."""

import math

import torch
from torch import Tensor

from rsvib_torch.core.splines import correlated

__all__ = ["RIM", "misfit"]

_SMOOTHING = 5.0  # px: reaches displacements of several px, and noise hardly matters
_STEP = 4  # px between those that count: all others are much the same
_FLAT = 1e-5  # of the brightest value: gradients and differences below are rounding
RIM = math.ceil(3 * _SMOOTHING) + 1  # px at the borders that smoothing and gradient spoil


def _kernels(like: Tensor) -> Tensor:
    """A Gaussian, and half the difference of it at both sides, (2, 2 RIM + 1)."""
    place = torch.arange(-RIM, RIM + 1, device=like.device)
    gaussian = torch.where(place.abs() < RIM, torch.exp(-0.5 * (place / _SMOOTHING).double().square()), 0.0)
    gaussian = gaussian / gaussian.sum()
    return torch.stack([gaussian, 0.5 * (gaussian.roll(1) - gaussian.roll(-1))]).to(like.dtype)


def misfit(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Root-mean-square displacement between two images of one scene, along each axis.

    A displacement d changes brightness by ``d . grad f``: the squared difference grows with the squared gradient,
    ``(f2 - f1)^2 = a + dx^2 fx^2 + dy^2 fy^2 + 2 dx dy fx fy`` on average, where noise of whatever level only raises
    ``a``. Both images are smoothed, so that displacements up to about 10 px are still in proportion, and weighted
    least squares gives the mean of dx^2 and dy^2 over the image.

    Args:
        first: (C, H, W), at least 2 RIM + 3 px on a side.
        second: The same shape.

    Returns:
        Misfit (2,) and its resolution (2,) in px, axes (x, y), float64: below the resolution it is not told from 0.
        Where there is nothing to tell it by, 0 and infinity.
    """
    kernels = _kernels(first)
    mean, changed = (0.5 * (first + second), second - first)
    smooth, slope = correlated(torch.stack([mean, changed]), kernels, -1, _STEP)
    along = correlated(slope[0], kernels[:1], -2, _STEP)[0].flatten().to(torch.float64)
    (_, change), (across, _) = correlated(smooth, kernels, -2, _STEP)
    across, change = (values.flatten().to(torch.float64) for values in (across, change))
    change = change.square()
    energy = along.square() + across.square()
    weight = (energy + energy.mean()).square().clamp(min=torch.finfo(torch.float64).tiny).reciprocal()
    terms = torch.stack([torch.ones_like(along), along.square(), across.square(), 2 * along * across])
    normal = (terms * weight) @ terms.T
    scale = normal.diagonal().clamp(min=torch.finfo(torch.float64).tiny).rsqrt()
    inverse = torch.linalg.pinv(normal * scale * scale[:, None], hermitian=True) * scale * scale[:, None]
    found = inverse @ ((terms * weight) @ change)
    # where nothing moves, squares scatter by twice their square; neighbours within the smoothing say the same
    spread = (terms * weight.square()) @ terms.T * (4 * math.pi * (_SMOOTHING / _STEP) ** 2 * 2.0 * found[0].square())
    deviation = (inverse @ spread @ inverse).diagonal()[1:3].clamp(min=0.0).sqrt()
    told = energy.amax().sqrt() > _FLAT * torch.maximum(first.abs().amax(), second.abs().amax())
    size, resolution = found[1:3].clamp(min=0.0).sqrt(), (2.0 * deviation).sqrt()
    return size.where(told, 0.0), resolution.where(told, math.inf)
