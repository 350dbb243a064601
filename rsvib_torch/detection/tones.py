"""The motion that is fitted: tones and an image motion, as the measured displacements see them."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements

__all__ = ["MotionModel", "ToneFit", "drift_response", "model_displacements", "tone_response"]


@dataclass(frozen=True)
class MotionModel:
    """What is fitted beside the tones, and how tones hang together.

    Attributes:
        harmonics: Tones come in families of a base frequency and its multiples up to this one, with one common
            frequency to fit; 1 leaves all tones free.
        drift_order: 1 for a uniform image motion, 2 for one whose speed changes steadily.
    """

    harmonics: int = 1
    drift_order: int = 1


@dataclass(frozen=True, eq=False)
class ToneFit:
    """Tones and motion: ``D(t) = Re sum_k C_k exp(2 pi i f_k s) + sum_j d_j s^j / j!``, s = t - centre, per axis.

    Attributes:
        coefficients: (B, 2, K) complex128 C in px.
        frequencies: (B, 2, K) float64 Hz.
        active: (B, 2, K) bool, tones that exist.
        drift: (B, 2, J) float64 d_j in px/s^j.
        covariance: (B, N, N) float64, N = 2 (3 K + J), of [Re C, Im C, f of each tone, d] of x, then of y.
        centre: (B,) float64 s.
        model: What was fitted.
    """

    coefficients: Tensor
    frequencies: Tensor
    active: Tensor
    drift: Tensor
    covariance: Tensor
    centre: Tensor
    model: MotionModel


def tone_response(measurements: Measurements, frequencies: Tensor) -> tuple[Tensor, Tensor]:
    """What the measurements see of unit tones, and its derivative by frequency.

    ``S(f) exp(2 pi i f (t - centre))`` at the mid-exposures t of the matched rows, less the mean over the group, with
    ``S(f) = sinc(f T_e) sinc(f h T_row)``: exposure (Eq. 2), gain (Eq. 4) and band average in one, and the coupling of
    the scan with motion along it through the moments.

    Args:
        measurements: The displacements.
        frequencies: (B, 2, K) Hz.

    Returns:
        Two complex128 tensors (B, N, G, 2, K).
    """
    middle = 0.5 * measurements.exposure_time - measurements.centre
    f = frequencies[:, None, None]
    time = (measurements.moments + middle[:, None, None])[..., None, None]
    angle = 2 * math.pi * f * time
    turn = torch.polar(torch.ones_like(angle), angle)
    average = torch.tensor(measurements.average_times, dtype=f.dtype, device=f.device)[:, None]
    exposure, exposure_slope = _sinc(f * measurements.exposure_time)
    band, band_slope = _sinc(f * average)
    attenuation = exposure * band
    slope = exposure_slope * measurements.exposure_time * band + exposure * band_slope * average
    derivative = torch.complex(slope.expand_as(angle), attenuation * 2 * math.pi * time) * turn
    return measurements.relative(attenuation * turn), measurements.relative(derivative)


def _sinc(x: Tensor) -> tuple[Tensor, Tensor]:
    """sin(pi x) / (pi x) and its derivative."""
    value = torch.sinc(x)
    small = x.abs() < 1e-4
    slope = (torch.cos(math.pi * x) - value) / torch.where(small, 1.0, x)
    return value, torch.where(small, -(math.pi**2) * x / 3, slope)


def drift_response(measurements: Measurements, order: int) -> Tensor:
    """What the measurements see of unit drifts s^j / j!, averaged over the exposure, (B, N, G, J)."""
    time = measurements.moments + (0.5 * measurements.exposure_time - measurements.centre)[:, None, None]
    powers = [time, 0.5 * time.square() + measurements.exposure_time**2 / 24.0]
    return measurements.relative(torch.stack(powers[:order], dim=-1))


def model_displacements(measurements: Measurements, fit: ToneFit) -> Tensor:
    """Displacements (B, N, G, 2) in px that the fitted motion predicts at the measurements."""
    turn = 2 * math.pi * fit.frequencies * (measurements.centre - fit.centre)[:, None, None]
    response, _ = tone_response(measurements, fit.frequencies)
    tones = (fit.coefficients * torch.polar(torch.ones_like(turn), turn))[:, None, None] * response
    # powers of another centre differ by lower powers and a constant, which the group does not see
    moved = fit.drift.clone()
    if fit.drift.shape[-1] > 1:
        moved[..., 0] += fit.drift[..., 1] * (measurements.centre - fit.centre)[:, None]
    drift = torch.einsum("bngj,baj->bnga", drift_response(measurements, fit.drift.shape[-1]), moved)
    return tones.real.sum(-1) + drift
