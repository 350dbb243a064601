"""How far two images of one scene lie apart, from the brightness of their difference along edges."""

import math

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

__all__ = ["RIM", "misfit"]

_SMOOTHING = 5.0  # px: reaches displacements of several px, and noise hardly matters
_STEP = 2  # px between those that count: all others are much the same
RIM = math.ceil(3 * _SMOOTHING) + 1  # px at the borders that smoothing and gradient spoil


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
    """
    size = 2 * math.ceil(3 * _SMOOTHING) + 1
    smooth = gaussian_blur2d(torch.stack([first, second]), (size, size), (_SMOOTHING, _SMOOTHING))
    inner = smooth[..., RIM - 1 : -RIM + 1, RIM - 1 : -RIM + 1].to(torch.float64)
    mean = 0.5 * (inner[0] + inner[1])
    some = slice(None, None, _STEP)
    along = (0.5 * (mean[:, 1:-1:_STEP, 2:] - mean[:, 1:-1:_STEP, :-2])[..., some]).flatten()
    across = (0.5 * (mean[:, 2:, 1:-1:_STEP] - mean[:, :-2, 1:-1:_STEP])[..., some, :]).flatten()
    change = (inner[1] - inner[0])[:, 1:-1:_STEP, 1:-1:_STEP].flatten().square()
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
    return found[1:3].clamp(min=0.0).sqrt(), (2.0 * deviation).sqrt()
