"""B-spline interpolation on a unit grid, correlation with short filters, and Gauss-Legendre quadrature."""

from collections.abc import Iterator
from functools import cache, partial
from math import comb, factorial

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import roots_legendre
from torch import Tensor

from rsvib_torch.execution.parallel import runs
from rsvib_torch.numerics.tables import Array, table, tensor


def bspline_weights(fraction: Tensor, degree: int, derivative: int = 0) -> Tensor:
    """Weights of the ``degree + 1`` B-splines that are not zero at a position, or their derivatives.

    The value at ``x = n + fraction`` is ``sum_k weights[k] c[n - degree // 2 + k]`` with coefficients ``c`` of a spline
    of odd degree; 1 is linear interpolation. Fractions (...) in [0, 1] have weights (..., degree + 1).
    """
    if derivative:
        lower = bspline_weights(fraction, degree - 1, derivative - 1)
        return torch.nn.functional.pad(lower, (1, 0)) - torch.nn.functional.pad(lower, (0, 1))
    highest, *others = torch.tensor(_polynomials(degree), dtype=fraction.dtype, device=fraction.device)
    weights: Tensor = highest
    for lower in others:
        weights = torch.addcmul(lower, weights, fraction[..., None])
    return weights


def spline_taps(
    times: Array, start: float, spacing: float, count: int, *, derivative: int = 0
) -> tuple[NDArray[np.int64], Array]:
    """The coefficients (..., 4) of a cubic spline, or its derivative, at times (...), and their factors.

    The first of ``count`` coefficients belongs to the knot at ``start``; times and ``spacing`` are in s. The spline is
    constant beyond its ends.
    """
    place = np.clip((times - start) / spacing, 0.0, count - 3)
    cell = np.minimum(np.floor(place), count - 4.0)
    factors = table(bspline_weights(tensor(place - cell), 3, derivative)) / spacing**derivative
    return cell.astype(np.int64)[..., None] + np.arange(4), factors


def spread_taps(cells: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Arrange the taps of several nodes, each at a cell of its own, on one grid of taps per row.

    Cells (..., N), whole numbers, are those of the first of K consecutive taps (..., N, K). The result is the lowest
    cell (...) of the nodes, int64, and weights (..., N, J) of the J taps from there on, 0 where a node has none.

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
    """Coefficients of the weights as polynomials of the fraction: one row of all taps per power, highest power first.

    ``sum_j (-1)^j binomial(n + 1, j) max(x - j, 0)^n / n!`` is the B-spline of degree n on the knots 0 ... n + 1; tap k
    is at ``x = fraction + n - k``.
    """

    def coefficient(tap: int, power: int) -> float:
        terms = (
            (-1) ** j * comb(degree + 1, j) * (degree - tap - j) ** (degree - power) for j in range(degree - tap + 1)
        )
        return float(comb(degree, power) * sum(terms) / factorial(degree))

    taps = range(degree + 1)
    return tuple(tuple(coefficient(tap, power) for tap in taps) for power in reversed(taps))


_PREFILTERS: dict[tuple[int, bool], tuple[float, ...]] = {}


def _prefilter_taps(degree: int, double: bool) -> tuple[float, ...]:
    """Taps 0, 1, 2 ... of the symmetric inverse filter of the sampled B-spline."""
    if (degree, double) not in _PREFILTERS:  # ``torch.compile`` looks into this table, but not into that of a cache
        length = 1024
        samples = np.array(_polynomials(degree)[-1][:-1])  # at fraction 0
        kernel = np.roll(np.pad(samples, (0, length - len(samples))), -(len(samples) // 2))
        inverse = np.fft.irfft(1.0 / np.fft.rfft(kernel).real, n=length)
        smallest = 1e-9 if double else 3e-8  # of the largest tap; float32 has no more digits
        reach = int(np.flatnonzero(np.abs(inverse[: length // 2]) > smallest).max()) + 1
        _PREFILTERS[degree, double] = tuple(inverse[:reach].tolist())
    return _PREFILTERS[degree, double]


def _symmetric(taps: tuple[float, ...], like: Tensor) -> Tensor:
    """A symmetric kernel from its taps 0, 1, 2 ..."""
    return torch.tensor(taps[:0:-1] + taps, dtype=like.dtype, device=like.device)


def mirrored(index: Tensor, length: int) -> Tensor:
    """Indices folded into ``0 .. length - 1`` by mirroring about the end samples, any number of times.

    Example:
        >>> mirrored(torch.arange(-3, 7), 4).tolist()
        [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]
    """
    period = 2 * (length - 1)
    index = index.remainder(max(period, 1))
    return torch.minimum(index, period - index)


def bspline_coefficient_rows(samples: Tensor, degree: int) -> Iterator[tuple[slice, Tensor]]:
    """``bspline_coefficients`` across the rows of images, in slices of rows that stay in the cache."""
    on_cpu = samples.device.type == "cpu"
    if samples.numel() <= (1 << 20 if on_cpu else 1 << 24):  # fits the cache, or the memory
        yield slice(0, samples.shape[-2]), bspline_coefficients(samples, degree, -2)
        return
    taps = _prefilter_taps(degree, samples.dtype in (torch.float64, torch.complex128))
    reach, height = len(taps) - 1, samples.shape[-2]
    index = mirrored(torch.arange(-reach, height + reach, device=samples.device), height)
    step = min(64 if on_cpu else 256, height)
    matrix = _toeplitz(_symmetric(taps, samples), step)
    for rows in runs(height, step):
        count = rows.stop - rows.start
        near = slice(rows.start - reach, rows.stop + reach)
        inside = near.start >= 0 and near.stop <= height
        source = (
            samples[..., near, :] if inside else samples.index_select(-2, index[rows.start : rows.stop + 2 * reach])
        )
        flat = source.flatten(0, -3)
        own = matrix[:count, : count + 2 * reach].expand(len(flat), -1, -1)
        yield rows, torch.bmm(own, flat).view(*samples.shape[:-2], count, -1)


def bspline_coefficients(samples: Tensor, degree: int, dim: int) -> Tensor:
    """B-spline coefficients along ``dim`` that interpolate the samples, with mirrored ends.

    The inverse of the sampled spline is applied as a finite symmetric filter, cut where it is below 1e-9
    (float32: 3e-8). The degree is odd; 1 returns the samples.
    """
    if degree == 1:
        return samples
    taps = _prefilter_taps(degree, samples.dtype in (torch.float64, torch.complex128))
    length, reach = samples.shape[dim], len(taps) - 1
    index = mirrored(torch.arange(-reach, length + reach, device=samples.device), length)
    return correlated(samples.index_select(dim, index), _symmetric(taps, samples)[None], dim)[0]


def bspline_coefficients_adjoint(values: Tensor, degree: int, dim: int) -> Tensor:
    """Adjoint (transpose) of ``bspline_coefficients``."""
    adjoint = torch.func.vjp(partial(bspline_coefficients, degree=degree, dim=dim), torch.zeros_like(values))[1]
    return adjoint(values)[0]


def _toeplitz(kernels: Tensor, rows: int, step: int = 1) -> Tensor:
    """Matrix (..., rows, (rows - 1) step + N) whose product with samples is their correlation with kernels (..., N)."""
    reach = (rows - 1) * step
    windows = torch.nn.functional.pad(kernels, (reach, reach)).unfold(-1, reach + kernels.shape[-1], step)
    return windows.flip(-2)


def correlated(samples: Tensor, kernels: Tensor, dim: int, step: int = 1) -> Tensor:
    """Correlate along an axis with several kernels, at places where these lie inside ("valid").

    Products with small dense matrices are faster than convolutions. Samples are real or complex, and n >= N along
    ``dim``; kernels (Q, N) are of the same dtype. The values have a leading dimension for the kernels, and ``(n - N) //
    step + 1`` entries along ``dim``.
    """
    if samples.ndim == 1:
        return correlated(samples[None], kernels, 1, step)[:, 0]
    number, taps = kernels.shape
    length = (samples.shape[dim] - taps) // step + 1
    if dim not in (-1, samples.ndim - 1):
        values = _across(samples.movedim(dim, -2), kernels, step, length)
        return values.movedim(-2, dim + 1 if dim >= 0 else dim)
    block = min(64 if samples.device.type == "cpu" else 256, length)  # values per matrix product
    matrix = _toeplitz(kernels, block, step)  # (Q, block, m)
    parts = []
    for part in runs(length, block):
        count = part.stop - part.start
        own = matrix[:, :count, : (count - 1) * step + taps].flatten(0, 1)
        values = samples[..., part.start * step : (part.stop - 1) * step + taps] @ own.T
        parts.append(values.unflatten(-1, (number, count)))
    return torch.cat(parts, -1).movedim(-2, 0)


def _across(samples: Tensor, kernels: Tensor, step: int, length: int) -> Tensor:
    """``correlated`` across rows (..., n, W): (Q, ..., length, W), by batches of small matrices."""
    number, taps = kernels.shape
    block = min(32 // step if samples.device.type == "cpu" else 256, length)
    span = (block - 1) * step + taps
    count = length // block
    matrix = _toeplitz(kernels, block, step)  # (Q, block, span)
    windows = samples.unfold(-2, span, block * step).mT  # (..., count, span, W)
    every = windows.reshape(-1, *windows.shape[-2:])
    products = torch.bmm(matrix.reshape(1, -1, span).expand(len(every), -1, -1), every)
    blocks: Tensor = products.view(*windows.shape[:-2], number, block, -1).movedim(-3, 0).flatten(-3, -2)
    rest = length - count * block
    if not rest:
        return blocks
    near = (rest - 1) * step + taps
    last = matrix[:, :rest, :near].flatten(0, 1) @ samples[..., count * block * step :, :][..., :near, :]
    return torch.cat([blocks, last.unflatten(-2, (number, rest)).movedim(-3, 0)], -2)


@cache
def gauss_legendre(count: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes (N,) within 0 ... 1, and weights that sum to 1, float64; cached, do not modify them."""
    nodes, weights = roots_legendre(count)  # 10,000 nodes in 2 s; numpy.polynomial.legendre.leggauss: minutes
    with torch.inference_mode(False):  # later callers may differentiate
        return torch.from_numpy((nodes + 1) / 2), torch.from_numpy(weights / 2)
