"""The kernel that interpolates a scene between its rows."""

import numpy as np
import torch
from torch import Tensor

__all__ = ["REACH", "TAPS", "interpolation_error", "kernel_response", "kernel_samples", "kernel_weights"]

REACH = 3  # rows on either side that a position is interpolated from
TAPS = 2 * REACH
# (1 - z^2)^2 times this polynomial in z^2, z the distance over the reach: of all such kernels that pass at least 6 % at
# half a cycle per row (less makes the coefficients ill-conditioned; the quintic B-spline passes 7 %) the one that leaks
# least of images into their aliases, for power spectra like frequency^-2 under optics of sigma 0.5 ... 0.7 px. It leaks
# 4 dB less than the quintic B-spline, which has as many taps, and 7 dB less than the cubic one.
_POLYNOMIAL = (
    0.7193094787025778,
    -4.748278633799877,
    7.3489242728422655,
    -3.1679842963602103,
    -1.425171703601649,
    0.9650708204441334,
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
        Weights (S, 6); their sum is 1 to 3e-5.
    """
    taps = torch.arange(TAPS, dtype=fraction.dtype, device=fraction.device) - (REACH - 1)
    return _kernel(fraction[..., None] - taps)


def kernel_samples() -> tuple[float, ...]:
    """The kernel at the rows -2 ... 2."""
    return tuple(_kernel(torch.arange(1 - REACH, REACH, dtype=torch.float64)).tolist())


def kernel_response(frequencies: Tensor) -> Tensor:
    """Fourier transform of the sampled kernel at frequencies in cycles per row."""
    response = torch.zeros_like(frequencies)
    for row, weight in enumerate(kernel_samples()):
        response = response + weight * torch.cos(2 * torch.pi * frequencies * (row - (REACH - 1)))
    return response


def interpolation_error(frequencies: Tensor) -> Tensor:
    """Power of the aliases that a wave of unit coefficients has between the rows.

    Args:
        frequencies: Cycles per row within -0.5 ... 0.5, any shape.

    Returns:
        Power of the same shape: what the kernel lets through at whole cycles per row beyond.
    """
    nodes, weights = np.polynomial.legendre.leggauss(64)
    places = torch.from_numpy(nodes * REACH).to(frequencies)
    values = torch.from_numpy(weights * REACH).to(frequencies) * _kernel(places)
    aliases = frequencies[..., None] + torch.tensor([-3, -2, -1, 1, 2, 3]).to(frequencies)
    return (torch.cos(2 * torch.pi * aliases[..., None] * places) @ values).square().sum(-1)
