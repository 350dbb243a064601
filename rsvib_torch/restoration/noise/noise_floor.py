"""Noise told from texture by the spectrum of one frame: noise is flat, what optics let through falls."""

import math

import torch
from torch import Tensor

from rsvib_torch.core.fourier import squared_modulus
from rsvib_torch.restoration.noise.single_frame import mostly_measured
from rsvib_torch.restoration.noise.squares import SIDE, cut_squares, spread_squares, tapered

__all__ = ["noise_floor"]

_PIECES = 36  # of a frame, about: their spectra are averaged
_TYPICAL = 0.4  # cycles per px
_COARSE = 0.2  # cycles per px; below, spectra are steeper
_SECTORS = 6  # of directions, each of which falls in its own way
_STEEPNESS, _SPREAD = 3.0, 8.0  # of power laws: typical, and its standard deviation
_ITERATIONS = 16
_STEP = 0.7  # in logarithms, at most


@torch.no_grad()
def noise_floor(frames: Tensor, ignore: Tensor | None = None) -> Tensor:
    """Power of the white noise beneath the texture of each image, from how its spectrum flattens.

    At frequency f in direction d the power is ``n + c_d f^(-a_d) exp(-b f^2)``: a power law for the scene in every
    direction, Gaussian optics, and one floor. Fisher scoring finds all of them for powers that scatter exponentially
    about their means (Whittle 1953). The floor is uncertain where texture outweighs it up to the highest frequencies.

    Args:
        frames: (..., H, W).
        ignore: Boolean mask of the same shape: pieces with many such pixels do not count.

    Returns:
        Power, shape (...), float64; NaN for an image of less than one piece, or none that counts.
    """
    height, width = frames.shape[-2:]
    images = frames.reshape(-1, height, width)
    if min(height, width) < SIDE:
        return images.new_full(frames.shape[:-2], math.nan, dtype=torch.float64)
    power = _pooled(_spectrum(images, None if ignore is None else ignore.reshape(images.shape)))  # (N, V, U)
    u = _pooled(torch.fft.rfftfreq(SIDE, dtype=torch.float64, device=frames.device).expand(2, -1))[0]
    v = torch.fft.fftfreq(SIDE, dtype=torch.float64, device=frames.device).unflatten(0, (-1, 2)).mean(-1)
    far, direction = torch.hypot(u, v[:, None]), torch.atan2(v[:, None], u)
    fine = far > _COARSE
    sector = ((direction[fine] / math.pi + 0.5) * _SECTORS).long().clamp(0, _SECTORS - 1)
    inside = torch.nn.functional.one_hot(sector, _SECTORS).to(torch.float64)  # (K, D)
    found = _fit(power[:, fine], far[fine] / _TYPICAL, sector, inside)
    return found.reshape(frames.shape[:-2])


def _spectrum(images: Tensor, ignore: Tensor | None) -> Tensor:
    """Mean power (N, V, U), of white noise its variance, of pieces of images (N, H, W)."""
    counts = [min(2 * extent // SIDE - 1, round(_PIECES**0.5)) for extent in images.shape[-2:]]
    rows, columns = spread_squares(images.shape[-2:], counts, images.device)
    pieces = tapered(cut_squares(images, rows, columns).flatten(1, 2))
    power = squared_modulus(torch.fft.rfft2(pieces)).to(torch.float64)
    if ignore is None:
        return power.mean(1)
    lost = cut_squares(ignore, rows, columns).double().mean((-2, -1)).flatten(1)
    usable = mostly_measured(lost, (-1,))
    return (power * usable[..., None, None]).sum(1) / usable.sum(1)[:, None, None]


def _pooled(values: Tensor) -> Tensor:
    """Means over 2 x 2 neighbouring frequencies of (..., V, U), without the lowest and the two highest u."""
    pooled: Tensor = values[..., 1:-2].unflatten(-1, (-1, 2)).unflatten(-3, (-1, 2)).mean((-3, -1))
    return pooled


def _fit(power: Tensor, frequency: Tensor, sector: Tensor, inside: Tensor) -> Tensor:
    """Floor (N,) of powers (N, K) at K frequencies, in units of a typical one, each in one of D sectors."""
    scale = power.mean(-1, keepdim=True)
    power = (power / scale).nan_to_num(nan=1.0)
    low = power.amin(-1, keepdim=True).clamp(min=1e-9)
    typical = ((power @ inside) / inside.sum(0)).clamp(min=1e-9)
    count = inside.shape[-1]
    level, steepness = (0.5 * typical).log(), torch.full_like(typical, 2.0)
    found = torch.cat([(0.5 * low).log(), torch.zeros_like(low), level, steepness], dim=-1)
    expected = found.new_tensor([0.0] * (2 + count) + [_STEEPNESS] * count)
    prior = found.new_tensor([1e-3] * (2 + count) + [_SPREAD**-2] * count)
    logarithm, square = frequency.log(), frequency.square()
    for _ in range(_ITERATIONS):
        floor, blur, level, steepness = found.split([1, 1, count, count], dim=-1)
        scene = (level[:, sector] - steepness[:, sector] * logarithm - blur * square).exp()
        model = floor.exp() + scene
        share = scene / model
        parts = share[..., None] * inside
        slopes = [(floor.exp() / model)[..., None], -(share * square)[..., None], parts, -parts * logarithm[:, None]]
        slope = torch.cat(slopes, dim=-1)
        normal = slope.transpose(-2, -1) @ slope + torch.diag(prior)
        pull = (slope.transpose(-2, -1) @ (power / model - 1.0)[..., None])[..., 0]
        pull[:, 1:] += ((expected - found) * prior)[:, 1:]
        found = found + torch.linalg.solve(normal, pull).clamp(-_STEP, _STEP)
        found[:, 1].clamp_(min=0.0)  # optics do not sharpen: what flattens is noise
    return found[:, 0].exp() * scale[:, 0]
