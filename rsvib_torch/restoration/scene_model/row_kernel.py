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

REACH = 3  # rows on either side; support of the kernel
TAPS = 2 * REACH
SCENE_REACH = 5  # rows on either side; support of the weights of a scene row
# The kernel is (1 - z^2)^2 times this polynomial in z^2, z the distance divided by the reach. It has the least error of
# interpolation (gain and aliases, -52 dB of the power) for power spectra like frequency^-2 behind Gaussian optics of
# sigma 0.6 px, of all such kernels with a transfer function of at least 5 % at half a cycle per row: less makes the
# coefficients ill-conditioned (the quintic B-spline has 7 %).
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
    """Weights of the coefficients of rows -5 ... 5 in a row of the scene.

    On the rows, a wave of coefficients interpolated by the kernel has the amplitude of ``kernel_spectrum`` plus that of
    its aliases. Exposures, and frames that sample at many places, do not contain the aliases. So the scene is the
    interpolation without aliases: the least-squares fit of these weights to ``kernel_spectrum`` up to 0.46 cycles per
    row, for amplitude spectra like frequency^-1 behind Gaussian optics of sigma 0.6 px.
    """
    v = torch.linspace(0, 0.46, 369, dtype=torch.float64)
    spectrum = kernel_spectrum(v)
    order = torch.arange(SCENE_REACH + 1, dtype=torch.float64)
    cosines = torch.cos(2 * torch.pi * v[:, None] * order) * torch.where(order > 0, 2.0, 1.0)
    count = torch.exp(-0.5 * (2 * torch.pi * 0.6 * v).square()) / ((v + 0.02) * spectrum)
    half = torch.linalg.lstsq(cosines * count[:, None], (spectrum * count)[:, None]).solution[:, 0]
    return tuple(torch.cat([half.flip(0), half[1:]]).tolist())


def interpolation_error(frequencies: Tensor, cycles: Sequence[int] = (-3, -2, -1, 1, 2, 3)) -> Tensor:
    """Power of the aliases that a wave of unit coefficients has between the rows.

    Args:
        frequencies: Cycles per row within -0.5 ... 0.5, any shape.
        cycles: Offsets of the aliases in cycles per row.

    Returns:
        Power of the same shape.
    """
    return kernel_spectrum(frequencies[..., None] + torch.tensor(cycles).to(frequencies)).square().sum(-1)
