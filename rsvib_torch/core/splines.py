"""B-spline interpolation on a unit grid: basis weights and the prefilter that turns samples into coefficients."""

from collections.abc import Iterator
from fractions import Fraction
from functools import cache

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.core.short_filters import correlated, toeplitz

__all__ = [
    "bspline_coefficient_rows",
    "bspline_coefficients",
    "bspline_coefficients_adjoint",
    "bspline_weights",
    "mirrored",
    "spread_taps",
]

_PRECISION = 1e-9  # of the largest tap, below which the prefilter is cut off
_SINGLE_PRECISION = 3e-8  # the same for float32, which does not hold more
_ROWS, _MANY_ROWS = {"cpu": 64}, 256  # at a time: they stay in the cache
_FEW, _NOT_MANY = {"cpu": 1 << 20}, 1 << 24  # values of images that do so without being cut


def bspline_weights(fraction: Tensor, degree: int) -> Tensor:
    """Weights of the ``degree + 1`` B-splines that are not zero at a position.

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
    highest, *others = torch.tensor(_polynomials(degree), dtype=fraction.dtype, device=fraction.device)
    weights: Tensor = highest
    for lower in others:
        weights = torch.addcmul(lower, weights, fraction[..., None])
    return weights


def spread_taps(cells: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Arrange the taps of several nodes, each at a cell of its own, on one grid of taps per row.

    Args:
        cells: Position (..., N) of the first tap of each node, whole numbers.
        weights: (..., N, K) weights of consecutive taps.

    Returns:
        Lowest cell (...) of the nodes, int64, and weights (..., N, J) of the J taps from there on, 0 where a node has
        no tap.

    Example:
        >>> first, taps = spread_taps(torch.tensor([3.0, 4.0]), torch.tensor([[0.5, 0.5], [0.75, 0.25]]))
        >>> first.item(), taps.tolist()
        (3, [[0.5, 0.5, 0.0], [0.0, 0.75, 0.25]])
    """
    first = cells.detach().amin(-1)
    index = (cells - first[..., None]).to(torch.int64)[..., None] + torch.arange(weights.shape[-1], device=cells.device)
    count = int(index.amax()) + 1
    return first.to(torch.int64), weights.new_zeros(*weights.shape[:-1], count).scatter(-1, index, weights)


@cache
def _polynomials(degree: int) -> tuple[tuple[float, ...], ...]:
    """Coefficients of the weights as polynomials of the fraction: a row for each power, highest first, of all taps.

    By the Cox-de Boor recursion, in whole fractions.
    """
    taps = [[Fraction(1)]]  # of each tap, lowest power first
    for order in range(1, degree + 1):
        before, taps = taps, [[Fraction(0)] * (order + 1) for _ in range(order + 1)]
        for tap, weight in enumerate(before):
            # knots of the spline of this order that starts so many cells before that of the position
            distance = order - 1 - tap
            for power, value in enumerate(weight):
                for which, at_zero, slope in ((tap, order - distance, -1), (tap + 1, distance, 1)):
                    taps[which][power] += value * at_zero / order
                    taps[which][power + 1] += value * slope / order
    return tuple(tuple(float(weight[power]) for weight in taps) for power in reversed(range(degree + 1)))


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


def _symmetric(taps: tuple[float, ...], like: Tensor) -> Tensor:
    """The whole of a symmetric kernel from one half."""
    return torch.tensor(taps[:0:-1] + taps, dtype=like.dtype, device=like.device)


def mirrored(index: Tensor, length: int) -> Tensor:
    """Indices, however far out, folded into ``0 .. length - 1`` by mirroring about the end samples.

    Example:
        >>> mirrored(torch.arange(-3, 7), 4).tolist()
        [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]
    """
    period = 2 * (length - 1)
    index = index.remainder(max(period, 1))
    return torch.minimum(index, period - index)


def bspline_coefficient_rows(samples: Tensor, degree: int) -> Iterator[tuple[slice, Tensor]]:
    """``bspline_coefficients`` across the rows of images, some rows at a time, or all of small ones.

    Args:
        samples: (..., H, W).
        degree: Odd degree of the spline, at least 3.

    Yields:
        Which rows, and their coefficients (..., r, W).
    """
    if samples.numel() <= _FEW.get(samples.device.type, _NOT_MANY):
        yield slice(0, samples.shape[-2]), bspline_coefficients(samples, degree, -2)
        return
    taps = _prefilter_taps(degree, samples.dtype in (torch.float64, torch.complex128))
    reach, height = len(taps) - 1, samples.shape[-2]
    index = mirrored(torch.arange(-reach, height + reach, device=samples.device), height)
    step = min(_ROWS.get(samples.device.type, _MANY_ROWS), height)
    matrix = toeplitz(_symmetric(taps, samples), step)
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
    return correlated(samples.index_select(dim, index), _symmetric(taps, samples)[None], dim)[0]


def bspline_coefficients_adjoint(values: Tensor, degree: int, dim: int) -> Tensor:
    """Adjoint (transpose) of ``bspline_coefficients``."""
    if degree == 1:
        return values
    taps = _prefilter_taps(degree, values.dtype in (torch.float64, torch.complex128))
    length, reach = values.shape[dim], len(taps) - 1
    shape = list(values.shape)
    shape[dim] = 2 * reach
    edge = values.new_zeros(shape)
    spread = correlated(torch.cat([edge, values, edge], dim), _symmetric(taps, values)[None], dim)[0]
    index = mirrored(torch.arange(-reach, length + reach, device=values.device), length)
    return torch.zeros_like(values).index_add(dim, index, spread)
