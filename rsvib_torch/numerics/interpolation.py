"""Interpolation of frames: B-splines across the rows and Fourier transforms along them; correlation and quadrature."""

import math
from collections.abc import Iterator
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import fft, special
from torch import Tensor

from rsvib_torch.execution.parallel import runs
from rsvib_torch.numerics.tables import Array, constant, table, tensor


def bspline_weights(fraction: Tensor, degree: int, derivative: int = 0) -> Tensor:
    """Weights of the ``degree + 1`` B-splines that are not zero at a position, or their derivatives.

    The value at ``x = n + fraction`` is ``sum_k weights[k] c[n - degree // 2 + k]`` with coefficients ``c`` of a spline
    of odd degree; 1 is linear interpolation. Fractions (...) in [0, 1] have weights (..., degree + 1).
    """
    if derivative:
        lower = bspline_weights(fraction, degree - 1, derivative - 1)
        return torch.nn.functional.pad(lower, (1, 0)) - torch.nn.functional.pad(lower, (0, 1))
    highest, *lower_powers = constant(_polynomials, degree, dtype=fraction.dtype, device=fraction.device)
    weights: Tensor = highest
    for lower in lower_powers:
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
    """
    first = cells.detach().amin(-1)
    index = (cells - first[..., None]).to(torch.int64)[..., None] + torch.arange(weights.shape[-1], device=cells.device)
    count = int(index.amax()) + 1
    return first.to(torch.int64), weights.new_zeros(*weights.shape[:-1], count).scatter(-1, index, weights)


@cache
def _polynomials(degree: int) -> Array:
    """Coefficients of the weights as polynomials of the fraction: one row of all taps per power, highest power first.

    Tap k is the B-spline of degree n on the knots 0 ... n + 1 at ``x = fraction + n - k``: ``x / n`` times that of
    degree n - 1 plus ``(n + 1 - x) / n`` times the same at x - 1.
    """
    powers: Array = np.ones((1, 1))
    for n in range(1, degree + 1):
        tap, same, shifted = np.arange(n + 1), np.pad(powers, ((0, 0), (1, 0))), np.pad(powers, ((0, 0), (0, 1)))
        rising, constant_part = same - shifted, (n - tap) * same + (tap + 1) * shifted
        powers = (np.pad(rising, ((0, 1), (0, 0))) + np.pad(constant_part, ((1, 0), (0, 0)))) / n
    return powers


@cache
def _inverse_filter(degree: int, smallest: float) -> Array:
    """Symmetric inverse filter (1, N) of the sampled B-spline, cut where it is below ``smallest``."""
    samples = _polynomials(degree)[-1, :-1]  # at fraction 0
    kernel = np.roll(np.pad(samples, (0, 1024 - len(samples))), -(len(samples) // 2))
    inverse = np.fft.fftshift(np.fft.irfft(1.0 / np.fft.rfft(kernel).real))
    return inverse[None, abs(inverse) > smallest]


def mirrored(index: Tensor, length: int) -> Tensor:
    """Indices folded into ``0 .. length - 1`` by mirroring about the end samples, any number of times.

    Example:
        >>> mirrored(torch.arange(-3, 7), 4).tolist()
        [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]
    """
    period = 2 * (length - 1)
    index = index.remainder(max(period, 1))
    return torch.minimum(index, period - index)


def _inverse_filter_of(samples: Tensor, degree: int, dim: int) -> tuple[Tensor, Tensor]:
    """The inverse filter (1, N) for samples, and the samples along ``dim`` that it needs, with mirrored ends."""
    smallest = 1e-9 if samples.dtype in (torch.float64, torch.complex128) else 3e-8  # float32 has no more digits
    kernel = constant(_inverse_filter, degree, smallest, dtype=samples.dtype, device=samples.device)
    length, reach = samples.shape[dim], kernel.shape[-1] // 2
    return kernel, mirrored(torch.arange(-reach, length + reach, device=samples.device), length)


def bspline_coefficient_rows(samples: Tensor, degree: int) -> Iterator[Tensor]:
    """``bspline_coefficients`` across the rows of images: those of consecutive rows, which stay in the cache."""
    on_cpu, height = samples.device.type == "cpu", samples.shape[-2]
    fits = samples.numel() <= (1 << 20 if on_cpu else 1 << 24)  # the cache, or the memory
    kernel, index = _inverse_filter_of(samples, degree, -2)
    for rows in runs(height, height if fits else 64 if on_cpu else 256):
        neighbours = samples.index_select(-2, index[rows.start : rows.stop + kernel.shape[-1] - 1])
        yield correlated(neighbours, kernel, -2)[0]


def bspline_coefficients(samples: Tensor, degree: int, dim: int) -> Tensor:
    """B-spline coefficients along ``dim`` that interpolate the samples, with mirrored ends.

    The inverse of the sampled spline is applied as a finite symmetric filter, cut where it is below 1e-9
    (float32: 3e-8). The degree is odd; 1 returns the samples.
    """
    if degree == 1:
        return samples
    kernel, index = _inverse_filter_of(samples, degree, dim)
    return correlated(samples.index_select(dim, index), kernel, dim)[0]


def correlated(samples: Tensor, kernels: Tensor, dim: int, step: int = 1) -> Tensor:
    """Correlate along an axis with several kernels, at places where these lie inside ("valid").

    Products with small dense matrices are faster than convolutions. Samples are real or complex, and n >= N along
    ``dim``; kernels (Q, N) are of the same dtype. The values have a leading dimension for the kernels, and ``(n - N) //
    step + 1`` entries along ``dim``.
    """
    if samples.ndim == 1:
        return correlated(samples[:, None], kernels, 0, step)[..., 0]
    number, taps = kernels.shape
    rows = samples.movedim(dim, -2)
    length = (rows.shape[-2] - taps) // step + 1
    # 1. Blocks of values, by a batch of products with one matrix (Q, block, span).
    block = min(max(1, 32 // step) if samples.device.type == "cpu" else 256, length)
    reach, count = (block - 1) * step, length // block
    span = reach + taps
    matrix = torch.nn.functional.pad(kernels, (reach, reach)).unfold(-1, span, step).flip(-2)
    windows = rows.unfold(-2, span, block * step).mT  # (..., count, span, W)
    flat = windows.reshape(-1, *windows.shape[-2:])
    products = torch.bmm(matrix.reshape(1, -1, span).expand(len(flat), -1, -1), flat)
    values: Tensor = products.view(*windows.shape[:-2], number, block, -1).movedim(-3, 0).flatten(-3, -2)
    # 2. The values behind the last whole block.
    remaining = length - count * block
    if remaining:
        needed = (remaining - 1) * step + taps
        last = matrix[:, :remaining, :needed].flatten(0, 1) @ rows[..., count * block * step :, :][..., :needed, :]
        values = torch.cat([values, last.unflatten(-2, (number, remaining)).movedim(-3, 0)], -2)
    return values.movedim(-2, dim + 1 if dim >= 0 else dim)


@cache
def gauss_legendre(count: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes (N,) within 0 ... 1, and weights that sum to 1, float64; cached, do not modify them."""
    nodes, weights = special.roots_legendre(count)  # 10,000 nodes in 2 s; numpy.polynomial.legendre.leggauss: minutes
    with torch.inference_mode(False):  # later callers may differentiate
        return torch.from_numpy((nodes + 1) / 2), torch.from_numpy(weights / 2)


_CHUNK = 2**21  # values at a time
# frequencies per entry of the coarse table of phases; 169 and 1057 frequencies take 0.75 and 0.92 of the time with 64
_PHASE_STEP = 32


def fast_length(minimum: int) -> int:
    """Smallest length from ``minimum`` on that is fast to transform: a multiple of 8 with prime factors up to 11.

    A prime length takes 4-5 times as long, and an odd one with small factors more than twice.
    """
    return 8 * int(fft.next_fast_len(-(-minimum // 8)))


def fourier_sums(times: Array, values: Array, grid: tuple[float, int, int]) -> Array:
    """Sums of ``values exp(2 pi i f t)`` over unequal times for equally spaced frequencies.

    The values are spread over a grid of times with a Kaiser-Bessel kernel, transformed, and divided by the transform of
    the kernel (Fessler and Sutton, IEEE Trans. Signal Process. 51, 560, 2003), to 1e-7 of the sum of their moduli.
    Times (B, N, G) are in s, values (B, ..., N, G) real, sums (B, ..., F) complex. The grid is the step of the
    frequencies in Hz, and first and number of its multiples.

    Example:
        >>> times, values = np.array([0.1, 0.25, 0.7]), np.array([1.0, 2.0, -1.0])
        >>> direct = np.exp(2j * np.pi * 0.5 * np.arange(2, 20)[:, None] * times) @ values
        >>> sums = fourier_sums(times[None, :, None], values[None, :, None], (0.5, 2, 18))[0]
        >>> bool(np.abs(sums - direct).max() < 1e-6)
        True
    """
    width, shape = 8, 18.6  # grid points; of the kernel, for twice as many grid points as necessary
    step, first, count = grid
    length = 4 * fast_length(first + count)
    # 1. Every value on the eight grid points around its time.
    places = times.reshape(len(times), -1) * (step * length)  # (B, M)
    flat = values.reshape(len(values), -1, places.shape[1])  # (B, C, M)
    taps = np.arange(width) - (width // 2 - 1)
    rows = length * np.arange(flat.shape[0] * flat.shape[1]).reshape(*flat.shape[:2], 1)  # of the flat sums
    total = np.zeros(rows.size * length)
    for part in runs(places.shape[1], max(1, _CHUNK // (width * rows.size))):
        cell = np.floor(places[:, part])
        distance = (places[:, part] - cell)[..., None] - taps
        kernel = special.i0(shape * np.sqrt(np.maximum(1 - np.square(2 / width * distance), 0.0)))
        index = ((cell.astype(np.int64)[..., None] + taps) % length).reshape(len(places), 1, -1)
        spread = (flat[..., part, None] * kernel[:, None]).reshape(*flat.shape[:2], -1)
        total += np.bincount((rows + index).ravel(), spread.ravel(), len(total))
    # 2. The transform of the grid over that of the kernel.
    transformed = fft.rfft(total.reshape(*flat.shape[:2], length))[..., first : first + count].conj()
    angle = math.pi * width / length * np.arange(first, first + count)
    root = np.sqrt(shape**2 - np.square(angle))
    sums: Array = transformed * (root / (width * np.sinh(root)))
    return sums.reshape(*values.shape[:-2], count)


def _mirrored_ends(width: int, extra: int) -> Array:
    """Pixels that are mirrored at the right end, then those at the left end, of rows that are extended by ``extra``."""
    steps = np.arange(1, extra + 1)
    return np.concatenate([(width - 1 - steps).clip(0), steps[::-1].clip(None, width - 1)])


def _blend(extra: int, hold: float) -> Array:
    """Share of the right end in the extension."""
    progress = ((np.arange(1, extra + 1) / (extra + 1) - hold) / (1 - 2 * hold)).clip(0, 1)
    return 0.5 + 0.5 * np.cos(np.pi * progress)


def extend_rows(images: Tensor, length: int, hold: float = 0.25) -> Tensor:
    """Extend rows (..., W) at their right end to ``length``, so that they close smoothly into a period.

    Both ends are extended by odd reflection, which keeps value and slope; a cosine blends the two reflections. Without
    it, the jump would ring into the image, and displaced rows would wrap around. ``hold`` is the share of the gap next
    to either end that is the reflection of that end only. With a quarter, rows displaced by up to a quarter of the gap
    contain no content of the opposite end, which improves restoration near the ends by up to 0.7 dB (displacements of
    40 px, exposures of 100 rows).
    """
    width = images.shape[-1]
    extra = length - width
    if extra <= 0:
        return images
    sources = constant(_mirrored_ends, width, extra, dtype=torch.int64, device=images.device)
    share = constant(_blend, extra, hold, dtype=images.dtype, device=images.device)
    # twice the end minus the mirrored pixels, at both ends; index_select is four times as fast as an index
    after, before = images.index_select(-1, sources).chunk(2, -1)
    ends = torch.lerp(images[..., :1], images[..., -1:], share)
    return torch.cat([images, 2 * ends - torch.lerp(before, after, share)], dim=-1)


def extended_length(width: int, reach: int) -> int:
    """Length for ``extend_rows`` of rows of ``width`` px: a quarter of the gap is ``reach`` and 8 px more."""
    return fast_length(width + 4 * (8 + reach))


def spline_spectra(images: Tensor, degree: int, length: int) -> Tensor:
    """Transforms (..., H, U) along rows, extended to ``length``, of spline coefficients across images (..., H, W)."""
    rows = bspline_coefficient_rows(images, degree)
    return torch.cat([torch.fft.rfft(extend_rows(coefficients, length)) for coefficients in rows], dim=-2)


def shift_phases(shift: Tensor, length: int, frequencies: slice, dtype: torch.dtype) -> Tensor:
    """Phase factors ``exp(2 pi i k shift / length)`` (..., stop - start), which move rows back by a shift (...) in px.

    ``frequencies`` selects k of ``rfft``. The factors are products of the two ``phase_tables``.
    """
    return phase_products(*phase_tables(shift, length, frequencies, dtype), frequencies.stop - frequencies.start)


def phase_tables(shift: Tensor, length: int, frequencies: slice, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Phase factors at every 32nd frequency (..., n), and those of 0 ... 31 steps of the frequency (..., 32)."""
    coarse = np.arange(frequencies.start, frequencies.stop, _PHASE_STEP)
    steps = torch.from_numpy(np.concatenate([coarse, np.arange(_PHASE_STEP)]) / length).to(shift.device)
    turns = shift[..., None] * steps
    angle = ((turns - turns.detach().round()) * (2 * math.pi)).to(dtype.to_real())
    tables = torch.complex(angle.cos(), angle.sin())  # several times faster than torch.polar
    first, second = tables.split([len(coarse), _PHASE_STEP], -1)
    return first, second


def phase_products(coarse: Tensor, fine: Tensor, count: int) -> Tensor:
    """Products (..., count) of the tables of ``phase_tables``."""
    return (coarse[..., None] * fine[..., None, :]).flatten(-2)[..., :count]


def waves(places: Tensor, frequencies: Tensor) -> Tensor:
    """``exp(-2 pi i u x)`` at places (...) in px and frequencies (U,) in cycles per px, (..., U)."""
    angle = (-2 * math.pi) * places[..., None] * frequencies
    return torch.complex(angle.cos(), angle.sin())  # several times faster than torch.polar


def squared_modulus(values: Tensor) -> Tensor:
    """``|z|^2`` of complex values; several times faster than the square of ``abs``, which guards against overflow."""
    real, imaginary = torch.view_as_real(values.resolve_conj()).unbind(-1)
    return real.square().addcmul_(imaginary, imaginary)
