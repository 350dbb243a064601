"""The kernel that interpolates a scene between its rows."""

from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor

from rsvib_torch.core.splines import gauss_legendre

__all__ = [
    "REACH",
    "SCENE_REACH",
    "TAPS",
    "interpolation_error",
    "kernel_samples",
    "kernel_spectrum",
    "kernel_weights",
    "scene_weights",
]

REACH = 3  # rows on either side that a position is interpolated from
TAPS = 2 * REACH
SCENE_REACH = 5  # rows on either side that a row of the scene is made from
_FINEST, _OPTICS = 0.46, 0.6  # cycles per row up to which it is faithful; px, sigma, of the optics that it is made for
# (1 - z^2)^2 times this polynomial in z^2, z the distance over the reach: of all such kernels that pass at least 5 % at
# half a cycle per row (less makes the coefficients ill-conditioned; the quintic B-spline passes 7 %) the one that
# interpolates samples best, gain and images outside the band, for power spectra like frequency^-2 under Gaussian
# optics of sigma 0.6 px: to -52 dB of the power.
_POLYNOMIAL = (
    0.5769045436701062,
    -3.0182129505404856,
    5.466830566399834,
    -6.758201648807548,
    6.263407370735177,
    -2.8993528884704753,
)


def _kernel(distance: Tensor) -> Tensor:
    """Kernel at distances of at most ``REACH``."""
    square = (distance / REACH).square()
    value = torch.full_like(square, _POLYNOMIAL[-1])
    for coefficient in _POLYNOMIAL[-2::-1]:
        value = value * square + coefficient
    return value * (1 - square).square()


def kernel_weights(fraction: Tensor) -> Tensor:
    """Weights of the six rows ``n - 2 ... n + 3`` at position ``n + fraction``.

    Args:
        fraction: Fractional positions in [0, 1], any shape S.

    Returns:
        Weights (S, 6); their sum is 1 to 5e-4.
    """
    taps = torch.arange(TAPS, dtype=fraction.dtype, device=fraction.device) - (REACH - 1)
    return _kernel(fraction[..., None] - taps)


def kernel_samples() -> tuple[float, ...]:
    """The kernel at the rows -2 ... 2."""
    return tuple(_kernel(torch.arange(1 - REACH, REACH, dtype=torch.float64)).tolist())


def kernel_spectrum(frequencies: Tensor) -> Tensor:
    """Fourier transform of the kernel at frequencies in cycles per row."""
    nodes, weights = gauss_legendre(32)  # of one side
    places = (nodes * REACH).to(frequencies)
    values = 2 * REACH * weights.to(frequencies) * _kernel(places)
    return torch.cos(2 * torch.pi * frequencies[..., None] * places) @ values


@cache
def scene_weights() -> tuple[float, ...]:
    """Weights of the rows -5 ... 5 of coefficients that make a row of the scene.

    Between its rows a wave of coefficients has the height that ``kernel_spectrum`` says, and on them that of its
    aliases, too. Exposures blur these away, and so do frames that see the rows at many places. So the scene is what the
    kernel makes of the coefficients without aliases, as well as so few weights can tell, for spectra like frequency^-1
    (of the amplitude) under Gaussian optics.
    """
    v = torch.linspace(0, _FINEST, 369, dtype=torch.float64)
    spectrum = kernel_spectrum(v)
    order = torch.arange(SCENE_REACH + 1, dtype=torch.float64)
    cosines = torch.cos(2 * torch.pi * v[:, None] * order) * torch.where(order > 0, 2.0, 1.0)
    count = torch.exp(-0.5 * (2 * torch.pi * _OPTICS * v).square()) / ((v + 0.02) * spectrum)
    half = torch.linalg.lstsq(cosines * count[:, None], (spectrum * count)[:, None]).solution[:, 0]
    return tuple(torch.cat([half.flip(0), half[1:]]).tolist())


def interpolation_error(frequencies: Tensor, cycles: Sequence[int] = (-3, -2, -1, 1, 2, 3)) -> Tensor:
    """Power of the aliases that a wave of unit coefficients has between the rows.

    Args:
        frequencies: Cycles per row within -0.5 ... 0.5, any shape.
        cycles: How many cycles per row beyond to look.

    Returns:
        Power of the same shape: what the kernel lets through there.
    """
    return kernel_spectrum(frequencies[..., None] + torch.tensor(cycles).to(frequencies)).square().sum(-1)
