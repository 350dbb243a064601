"""Fourier transforms along rows that are not periodic: lengths, boundary extension, phase factors."""

import math

import numpy as np
import torch
from scipy import fft, special
from torch import Tensor

from rsvib_torch.execution.parallel import gathered, runs
from rsvib_torch.numerics.splines import bspline_coefficient_rows
from rsvib_torch.numerics.tables import Array, constant

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
    # twice the end minus what is mirrored, of both ends; index_select is four times as fast as an index
    after, before = images.index_select(-1, sources).chunk(2, -1)
    ends = torch.lerp(images[..., :1], images[..., -1:], share)
    return torch.cat([images, 2 * ends - torch.lerp(before, after, share)], dim=-1)


def extended_length(width: int, reach: int) -> int:
    """Length for ``extend_rows`` of rows of ``width`` px: a quarter of the gap is ``reach`` and 8 px more."""
    return fast_length(width + 4 * (8 + reach))


def spline_spectra(images: Tensor, degree: int, length: int) -> Tensor:
    """Transforms (..., H, U) along rows, extended to ``length``, of spline coefficients across images (..., H, W)."""
    pieces = (
        (rows, torch.fft.rfft(extend_rows(coefficients, length)))
        for rows, coefficients in bspline_coefficient_rows(images, degree)
    )
    return gathered(pieces, images.shape[-2], images.ndim - 2)


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
