"""Fourier transforms along rows of images that are not periodic."""

import math
from functools import cache

import torch
from scipy.fft import next_fast_len
from torch import Tensor

__all__ = ["extend_rows", "fast_length", "shift_phases", "squared_modulus", "waves"]

_TABLE = 64  # frequencies that a phase is stepped through


def fast_length(minimum: int) -> int:
    """Length from ``minimum`` on that is fast to transform: a multiple of 8 without prime factors over 11.

    A prime length takes 4-5 times as long, and an odd one without large factors still more than twice.

    Example:
        >>> [fast_length(minimum) for minimum in (1, 97, 1104, 2072)]
        [8, 112, 1120, 2112]
    """
    return 8 * int(next_fast_len(-(-minimum // 8)))


def extend_rows(images: Tensor, length: int) -> Tensor:
    """Extend rows at their right end to ``length`` so that they close smoothly into a period.

    Both ends go on by odd reflection, which keeps value and slope, and fade to their mean: interpolation in the
    Fourier domain then stays local, where a jump or kink would ring into the image.

    Args:
        images: (..., W).
        length: Length of the period, at least W.

    Returns:
        Tensor (..., length) whose first W columns are the image.
    """
    width = images.shape[-1]
    extra = length - width
    if extra <= 0:
        return images
    reach = min(extra, width - 1)
    ends = torch.cat([images[..., : reach + 1], images[..., width - 1 - reach :]], dim=-1)
    gap = ends @ _extension(reach, extra, images.dtype, images.device)
    return torch.cat([images, gap], dim=-1)


@cache
@torch.inference_mode(False)
def _extension(reach: int, extra: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (2 reach + 2, extra) from the values at both ends of a row to those that ``extend_rows`` adds."""
    left, right = torch.eye(2 * reach + 2, dtype=torch.float64).chunk(2, dim=1)
    taper = 0.5 + 0.5 * torch.cos(torch.arange(1, reach + 1, dtype=torch.float64) * (torch.pi / (reach + 1)))
    first, last = left[:, :1], right[:, -1:]
    middle = 0.5 * (first + last)
    gap = middle.repeat(1, extra)
    gap[:, :reach] += (2 * last - middle - right[:, :-1].flip(-1)) * taper
    gap[:, extra - reach :] += (2 * first - middle - left[:, 1:].flip(-1)) * taper.flip(-1)
    return gap.to(device, dtype)


def shift_phases(shift: Tensor, length: int, frequencies: slice, dtype: torch.dtype) -> Tensor:
    """``exp(2 pi i k shift / length)``: what moves rows back by a shift, as products of two tables.

    Args:
        shift: (...) px, float64.
        length: L of the period.
        frequencies: Which k of ``rfft``, from start to stop.
        dtype: Complex, of the result.

    Returns:
        (..., stop - start).

    Example:
        >>> rows = torch.sin(2 * torch.pi * (torch.arange(8.0) - 0.25) / 8)
        >>> phases = shift_phases(torch.tensor(0.25, dtype=torch.float64), 8, slice(0, 5), torch.complex64)
        >>> moved = torch.fft.irfft(torch.fft.rfft(rows) * phases, n=8)
        >>> torch.allclose(moved, torch.sin(2 * torch.pi * torch.arange(8.0) / 8), atol=1e-6)
        True
    """
    start, stop = frequencies.start, frequencies.stop
    coarse = torch.arange(start, stop, _TABLE, device=shift.device)
    steps = torch.cat([coarse, torch.arange(_TABLE, device=shift.device)]).to(torch.float64)
    turns = shift[..., None] * (steps / length)
    angle = ((turns - turns.detach().round()) * (2 * math.pi)).to(dtype.to_real())
    tables = torch.complex(angle.cos(), angle.sin())  # several times faster than torch.polar
    product = tables[..., : len(coarse), None] * tables[..., None, len(coarse) :]
    return product.flatten(-2)[..., : stop - start]


def waves(places: Tensor, frequencies: Tensor) -> Tensor:
    """``exp(-2 pi i u x)`` at places (...) in px and frequencies (U,) in cycles per px, (..., U)."""
    angle = (-2 * math.pi) * places[..., None] * frequencies
    return torch.complex(angle.cos(), angle.sin())  # several times faster than torch.polar


def squared_modulus(values: Tensor) -> Tensor:
    """``|z|^2`` of complex values; several times faster than the square of ``abs``, which guards against overflow."""
    return values.real.square().addcmul_(values.imag, values.imag)
