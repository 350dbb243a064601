"""Noise of one frame from the floor of its power spectrum: noise is white, the spectrum of a scene falls."""

import math

import torch
from torch import Tensor

from rsvib_torch.core.fourier import squared_modulus
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.noise.squares import SIDE, cut_squares, mostly_measured, spread_squares, tapered

__all__ = ["noise_floor", "noise_of_spectral_floor"]

_SECTORS = 6  # directions, with one power law each


def noise_of_spectral_floor(
    frames: Tensor,
    motion: FrameMotion,
    stack: int,
    ignore: Tensor | None,
    high_pass: Tensor,
    *,
    max_reduction: float = 9.0,
    min_reduction: float = 1.25,
) -> Tensor:
    """Noise power of each frame from ``noise_floor``, within bounds.

    Args:
        frames: As in ``ESTIMATORS``, and likewise the next four.
        motion: Not used.
        stack: Not used.
        ignore: Pixels that were not measured.
        high_pass: (T,) noise power, texture included.
        max_reduction: Largest factor between ``high_pass`` and the result; a noise level that is far too low amplifies
            noise more than one that is too high blurs.
        min_reduction: Factor below which ``high_pass`` is kept, because the floor is the less accurate of the two.

    Returns:
        (T,); NaN for a frame whose floor is not clearly lower than ``high_pass``.
    """
    floor = noise_floor(frames, ignore).mean(-1).to(high_pass.dtype)
    bounded = torch.maximum(floor, high_pass / max_reduction)
    return torch.where(floor < high_pass / min_reduction, bounded, math.nan)


@torch.no_grad()
def noise_floor(frames: Tensor, ignore: Tensor | None = None, *, min_frequency: float = 0.2) -> Tensor:
    """Power of the white noise below the texture of each image, from its power spectrum.

    At frequency f in direction d the power is ``n + c_d f^(-a_d) exp(-b f^2)``: a power law for the scene in every
    direction, Gaussian optics, and one floor. Fisher scoring estimates all of them, for powers with exponential
    distributions about their means (Whittle 1953). The floor is uncertain if texture exceeds it up to the highest
    frequencies.

    Args:
        frames: (..., H, W).
        ignore: Boolean mask of the same shape; squares with many such pixels do not count.
        min_frequency: Cycles per px; below, spectra are steeper than the power law.

    Returns:
        Power, shape (...), float64; NaN for an image of less than one square, or without a usable one.
    """
    height, width = frames.shape[-2:]
    images = frames.reshape(-1, height, width)
    if min(height, width) < SIDE:
        return images.new_full(frames.shape[:-2], math.nan, dtype=torch.float64)
    power = _pooled(_spectrum(images, None if ignore is None else ignore.reshape(images.shape)))  # (N, V, U)
    u = _pooled(torch.fft.rfftfreq(SIDE, dtype=torch.float64, device=frames.device).expand(2, -1))[0]
    v = torch.fft.fftfreq(SIDE, dtype=torch.float64, device=frames.device).unflatten(0, (-1, 2)).mean(-1)
    frequency, direction = torch.hypot(u, v[:, None]), torch.atan2(v[:, None], u)
    used = frequency > min_frequency
    sector = ((direction[used] / math.pi + 0.5) * _SECTORS).long().clamp(0, _SECTORS - 1)
    return _fit_floor(power[:, used], frequency[used], sector).reshape(frames.shape[:-2])


def _spectrum(images: Tensor, ignore: Tensor | None, *, squares_per_axis: int = 6) -> Tensor:
    """Mean power (N, V, U) of squares of images (N, H, W); the power of white noise is its variance."""
    counts = [min(2 * extent // SIDE - 1, squares_per_axis) for extent in images.shape[-2:]]
    rows, columns = spread_squares(images.shape[-2:], counts, images.device)
    squares = tapered(cut_squares(images, rows, columns).flatten(1, 2))
    power = squared_modulus(torch.fft.rfft2(squares)).to(torch.float64)
    if ignore is None:
        return power.mean(1)
    missing = cut_squares(ignore, rows, columns).double().mean((-2, -1)).flatten(1)
    usable = mostly_measured(missing, (-1,))
    return (power * usable[..., None, None]).sum(1) / usable.sum(1)[:, None, None]


def _pooled(values: Tensor) -> Tensor:
    """Means over 2 x 2 neighbouring frequencies of (..., V, U), without the lowest and the two highest u."""
    pooled: Tensor = values[..., 1:-2].unflatten(-1, (-1, 2)).unflatten(-3, (-1, 2)).mean((-3, -1))
    return pooled


def _fit_floor(
    power: Tensor,
    frequency: Tensor,
    sector: Tensor,
    *,
    steepness_mean: float = 3.0,
    steepness_std: float = 8.0,
    iterations: int = 16,
    max_step: float = 0.7,
) -> Tensor:
    """Floor (N,) by Fisher scoring of ``n + c_d f^(-a_d) exp(-b f^2)`` in the logarithms of n and c.

    Args:
        power: (N, K) at K frequencies.
        frequency: (K,) cycles per px.
        sector: (K,) index of the direction.
        steepness_mean: Mean of the weak prior of the exponents a.
        steepness_std: Its standard deviation.
        iterations: Scoring steps.
        max_step: Largest change of a parameter in one step.
    """
    inside = torch.nn.functional.one_hot(sector, _SECTORS).to(torch.float64)  # (K, D)
    frequency = frequency / 0.4  # in units of a typical one, so that levels and exponents are nearly independent
    scale = power.mean(-1, keepdim=True)
    power = (power / scale).nan_to_num(nan=1.0)
    low = power.amin(-1, keepdim=True).clamp(min=1e-9)
    typical = ((power @ inside) / inside.sum(0)).clamp(min=1e-9)
    log_level, exponent = (0.5 * typical).log(), torch.full_like(typical, 2.0)
    parameters = torch.cat([(0.5 * low).log(), torch.zeros_like(low), log_level, exponent], dim=-1)
    expected = parameters.new_tensor([0.0] * (2 + _SECTORS) + [steepness_mean] * _SECTORS)
    prior = parameters.new_tensor([1e-3] * (2 + _SECTORS) + [steepness_std**-2] * _SECTORS)
    log_frequency, square = frequency.log(), frequency.square()
    for _ in range(iterations):
        floor, blur, log_level, exponent = parameters.split([1, 1, _SECTORS, _SECTORS], dim=-1)
        scene = (log_level[:, sector] - exponent[:, sector] * log_frequency - blur * square).exp()
        model = floor.exp() + scene
        share = scene / model
        parts = share[..., None] * inside
        slope = torch.cat(
            [(floor.exp() / model)[..., None], -(share * square)[..., None], parts, -parts * log_frequency[:, None]],
            dim=-1,
        )
        normal = slope.transpose(-2, -1) @ slope + torch.diag(prior)
        gradient = (slope.transpose(-2, -1) @ (power / model - 1.0)[..., None])[..., 0]
        gradient[:, 1:] += ((expected - parameters) * prior)[:, 1:]
        parameters = parameters + torch.linalg.solve(normal, gradient).clamp(-max_step, max_step)
        parameters[:, 1].clamp_(min=0.0)  # optics attenuate
    return parameters[:, 0].exp() * scale[:, 0]
