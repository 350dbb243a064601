"""B-spline interpolation on a unit grid: basis weights and the prefilter that turns samples into coefficients."""

from collections.abc import Iterator
from functools import cache

import torch
from torch import Tensor

from rsvib_torch.pieces import runs

__all__ = [
    "bspline_coefficient_rows",
    "bspline_coefficients",
    "bspline_coefficients_adjoint",
    "bspline_weights",
    "mirrored",
]

_PRECISION = 1e-9  # of the largest tap, below which the prefilter is cut off
_SINGLE_PRECISION = 3e-8  # the same for float32, which does not hold more


def bspline_weights(fraction: Tensor, degree: int) -> Tensor:
    """Weights of the ``degree + 1`` B-splines that are not zero at a position (Cox-de Boor recursion).

    The value at ``x = n + fraction`` is ``sum_k weights[k] c[n + first_tap(degree) + k]`` with coefficients ``c``
    and ``first_tap(degree) = -(degree // 2)``. ``degree`` must be odd, 1 is linear interpolation.

    Args:
        fraction: Fractional positions in [0, 1], any shape S.
        degree: Odd degree of the spline.

    Returns:
        Tensor of shape (S, degree + 1); its last axis sums to 1.

    Example:
        >>> bspline_weights(torch.tensor(0.25), 1).tolist()
        [0.75, 0.25]
    """
    weights = [torch.ones_like(fraction)]
    for order in range(1, degree + 1):
        previous = weights
        weights = [torch.zeros_like(fraction) for _ in range(order + 1)]
        for tap, weight in enumerate(previous):
            # knots of the spline of this order that starts `order - 1 - tap` before the cell of the position
            rising = (fraction + (order - 1 - tap)) / order
            weights[tap] = weights[tap] + (1 - rising) * weight
            weights[tap + 1] = weights[tap + 1] + rising * weight
    return torch.stack(weights, dim=-1)


@cache
def _prefilter_taps(degree: int, double: bool) -> tuple[float, ...]:
    """One half (taps 0, 1, 2 ...) of the symmetric inverse of the sampled B-spline."""
    length = 1024
    samples = bspline_weights(torch.zeros((), dtype=torch.float64), degree)[:-1]
    kernel = torch.zeros(length, dtype=torch.float64)
    half = len(samples) // 2
    for tap, value in enumerate(samples.tolist()):
        kernel[(tap - half) % length] = value
    inverse = torch.fft.irfft(1.0 / torch.fft.rfft(kernel).real, n=length)
    reach = int((inverse[: length // 2].abs() > (_PRECISION if double else _SINGLE_PRECISION)).nonzero().max()) + 1
    return tuple(inverse[:reach].tolist())


def mirrored(index: Tensor, length: int) -> Tensor:
    """Indices, however far out, folded into ``0 .. length - 1`` by mirroring about the end samples.

    Example:
        >>> mirrored(torch.arange(-3, 7), 4).tolist()
        [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]
    """
    period = 2 * (length - 1)
    index = index.remainder(max(period, 1))
    return torch.minimum(index, period - index)


_BLOCK, _LARGE_BLOCK = 64, 256  # samples filtered together: one small dense matrix serves all blocks


def _filter_symmetric(samples: Tensor, taps: tuple[float, ...], dim: int) -> Tensor:
    """Correlate along ``dim`` with a symmetric kernel, valid part only, as products with a Toeplitz matrix."""
    reach = len(taps) - 1
    length = samples.shape[dim] - 2 * reach
    block = min(_BLOCK, length)
    matrix = _toeplitz(taps, block, samples)
    moved = samples.movedim(dim, -2) if samples.ndim > 1 else samples[:, None]
    count = -(-length // block)
    missing = count * block - length
    moved = torch.nn.functional.pad(moved, (0, 0, 0, missing)) if missing else moved
    windows = moved.unfold(-2, block + 2 * reach, block)  # (..., count, W, block + 2 reach), a view
    filtered = torch.matmul(matrix, windows.transpose(-2, -1)).flatten(-3, -2)
    filtered = filtered.narrow(-2, 0, length)
    return filtered.movedim(-2, dim) if samples.ndim > 1 else filtered[:, 0]


def _toeplitz(taps: tuple[float, ...], rows: int, like: Tensor) -> Tensor:
    """Matrix (rows, rows + 2 reach) that correlates with the symmetric kernel."""
    kernel = torch.tensor(taps[:0:-1] + taps, dtype=like.dtype, device=like.device)
    matrix = kernel.new_zeros(rows, rows + len(kernel) - 1)
    row = torch.arange(rows, device=like.device)[:, None]
    matrix[row, row + torch.arange(len(kernel), device=like.device)] = kernel
    return matrix


def bspline_coefficient_rows(samples: Tensor, degree: int) -> Iterator[tuple[slice, Tensor]]:
    """``bspline_coefficients`` across the rows of images, some rows at a time: they stay in the cache.

    Args:
        samples: (..., H, W).
        degree: Odd degree of the spline, at least 3.

    Yields:
        Which rows, and their coefficients (..., r, W).
    """
    taps = _prefilter_taps(degree, samples.dtype in (torch.float64, torch.complex128))
    reach, height = len(taps) - 1, samples.shape[-2]
    index = mirrored(torch.arange(-reach, height + reach, device=samples.device), height)
    step = min(_BLOCK if samples.device.type == "cpu" else _LARGE_BLOCK, height)
    matrix = _toeplitz(taps, step, samples)
    for rows in runs(height, step):
        count = rows.stop - rows.start
        near = slice(rows.start - reach, rows.stop + reach)
        inside = near.start >= 0 and near.stop <= height
        seen = samples[..., near, :] if inside else samples.index_select(-2, index[rows.start : rows.stop + 2 * reach])
        yield rows, torch.matmul(matrix[:count, : count + 2 * reach], seen)


def bspline_coefficients(samples: Tensor, degree: int, dim: int) -> Tensor:
    """B-spline coefficients along ``dim`` that interpolate the samples, with mirrored ends.

    The inverse of the sampled spline is applied as a finite symmetric filter, cut where it is below 1e-9
    (float32: 3e-8).

    Args:
        samples: Tensor of samples.
        degree: Odd degree of the spline; 1 returns the samples.
        dim: Axis to filter.

    Returns:
        Coefficients of the same shape.
    """
    if degree == 1:
        return samples
    taps = _prefilter_taps(degree, samples.dtype in (torch.float64, torch.complex128))
    length, reach = samples.shape[dim], len(taps) - 1
    index = mirrored(torch.arange(-reach, length + reach, device=samples.device), length)
    return _filter_symmetric(samples.index_select(dim, index), taps, dim)


def bspline_coefficients_adjoint(values: Tensor, degree: int, dim: int) -> Tensor:
    """Adjoint (transpose) of ``bspline_coefficients``."""
    if degree == 1:
        return values
    taps = _prefilter_taps(degree, values.dtype in (torch.float64, torch.complex128))
    length, reach = values.shape[dim], len(taps) - 1
    shape = list(values.shape)
    shape[dim] = 2 * reach
    edge = values.new_zeros(shape)
    spread = _filter_symmetric(torch.cat([edge, values, edge], dim), taps, dim)
    index = mirrored(torch.arange(-reach, length + reach, device=values.device), length)
    return torch.zeros_like(values).index_add(dim, index, spread)
