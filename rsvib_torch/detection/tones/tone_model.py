"""The motion that is fitted: tones and an image motion, as the measured displacements see them."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements

__all__ = [
    "MotionModel",
    "ToneFit",
    "drift_response",
    "model_displacements",
    "tone_columns",
    "tone_response",
]


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


def tone_response(measurements: Measurements, frequencies: Tensor) -> Tensor:
    """What the measurements see of unit tones.

    ``S(f) exp(2 pi i f (t - centre))`` at the mid-exposures t of the matched rows, less the mean over the group, with
    ``S(f) = sinc(f T_e) sinc(f h T_row)``: exposure (Eq. 2), gain (Eq. 4) and band average in one, and the coupling of
    the scan with motion along it through the moments.

    Args:
        measurements: The displacements.
        frequencies: (B, 2, K) Hz.

    Returns:
        complex128 (B, N, G, 2, K).
    """
    attenuation = torch.sinc(frequencies * measurements.smearing_times).prod(0)[:, None, None]
    angle = 2 * math.pi * frequencies[:, None, None] * measurements.middles
    return measurements.relative(torch.complex(attenuation * angle.cos(), attenuation * angle.sin()))


def tone_columns(measurements: Measurements, coefficients: Tensor, frequencies: Tensor) -> Tensor:
    """Derivatives (B, N, G, 2, K, 3) of what the measurements see of tones by the real part, the imaginary part and f.

    The tones are ``Re C S(f) exp(2 pi i f (t - centre))`` with C and f (B, 2, K), as in ``tone_response``; the mean
    over the group is still in.
    """
    times = measurements.smearing_times
    smeared, smeared_slope = _sinc(frequencies * times)
    attenuation = smeared[0] * smeared[1]
    slope = (smeared_slope * times * smeared.flip(0)).sum(0)
    time = measurements.middles
    angle = 2 * math.pi * frequencies[:, None, None] * time
    wave = torch.complex(angle.cos(), angle.sin())
    # derivatives by f: of the attenuation, and of the angle
    start, turn = (slope * coefficients)[:, None, None], (2j * math.pi * attenuation * coefficients)[:, None, None]
    by_frequency = ((start + time * turn) * wave).real
    by_parts = torch.view_as_real((attenuation[:, None, None] * wave).conj_physical())
    return torch.cat([by_parts, by_frequency[..., None]], dim=-1)


def _sinc(x: Tensor) -> tuple[Tensor, Tensor]:
    """sin(pi x) / (pi x) and its derivative."""
    value = torch.sinc(x)
    small = x.abs() < 1e-4
    slope = (torch.cos(math.pi * x) - value) / torch.where(small, 1.0, x)
    return value, torch.where(small, -(math.pi**2) * x / 3, slope)


def drift_response(measurements: Measurements, order: int) -> Tensor:
    """What the measurements see of unit drifts s^j / j!, averaged over the exposure, (B, N, G, J)."""
    time = measurements.middles[..., 0, 0]
    powers = [time, 0.5 * time.square() + measurements.exposure_time**2 / 24.0]
    return measurements.relative(torch.stack(powers[:order], dim=-1))


def model_displacements(measurements: Measurements, fit: ToneFit) -> Tensor:
    """Displacements (B, N, G, 2) in px that the fitted motion predicts at the measurements."""
    turn = 2 * math.pi * fit.frequencies * (measurements.centre - fit.centre)[:, None, None]
    response = tone_response(measurements, fit.frequencies)
    tones = (fit.coefficients * torch.polar(torch.ones_like(turn), turn))[:, None, None] * response
    # powers of another centre differ by lower powers and a constant, which the group does not see
    moved = fit.drift.clone()
    if fit.drift.shape[-1] > 1:
        moved[..., 0] += fit.drift[..., 1] * (measurements.centre - fit.centre)[:, None]
    drift = torch.einsum("bngj,baj->bnga", drift_response(measurements, fit.drift.shape[-1]), moved)
    return tones.real.sum(-1) + drift
