"""From the fit to the vibration: amplitude, frequency and phase at the time origin, with standard deviations."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.tones.tone_model import ToneFit
from rsvib_torch.motion.vibration import Vibration, VibrationStd

__all__ = ["BLIND", "amplitude_deviation", "known_motion", "motion_of_fit", "offset_gain", "vibration_of_fit"]

BLIND = 0.1  # gain from displacement to offset that counts as half blind


def _own_covariance(fit: ToneFit) -> tuple[Tensor, Tensor]:
    """Covariances of each axis by itself: of the parameters of every tone (B, 2, K, 3, 3), of drifts (B, 2, J, J)."""
    tones = fit.frequencies.shape[-1]
    size = 3 * tones + fit.drift.shape[-1]
    own = fit.covariance.reshape(-1, 2, size, 2, size).diagonal(dim1=1, dim2=3).movedim(-1, 1)  # (B, 2, size, size)
    blocks = torch.stack([own[..., 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(tones)], dim=2)
    return blocks, own[..., 3 * tones :, 3 * tones :]


def _deviation(fit: ToneFit, blocks: Tensor, *derivative: Tensor) -> Tensor:
    """Standard deviation (B, 2, K) of what depends on the parameters of a tone by these derivatives (B, 2, K)."""
    vector = torch.stack(derivative, dim=-1)
    variance = torch.einsum("bakp,bakpq,bakq->bak", vector, blocks, vector).clamp(min=0.0)
    return torch.where(fit.active, variance.sqrt(), 0.0)


def _direction(fit: ToneFit) -> tuple[Tensor, Tensor, Tensor]:
    """Real and imaginary part of coefficients over their modulus, and that, 1 where there is no tone."""
    amplitude = torch.where(fit.active, fit.coefficients.abs(), 0.0)
    safe = torch.where(amplitude > 0, amplitude, 1.0)
    return fit.coefficients.real / safe, fit.coefficients.imag / safe, safe


def amplitude_deviation(fit: ToneFit) -> Tensor:
    """Standard deviation (B, 2, K) of the amplitudes in px; 0 for tones that are not active."""
    real, imaginary, _ = _direction(fit)
    return _deviation(fit, _own_covariance(fit)[0], real, imaginary, torch.zeros_like(real))


def motion_of_fit(fit: ToneFit) -> Vibration:
    """Vibration (B, 2, K) from a fit: ``A = |C|``, ``phi = arg C + pi/2 - 2 pi f centre`` (Eqs. 6-8).

    Gain and exposure are in the fit already. Tones that are not active have amplitude and frequency 0.
    """
    centre = fit.centre[:, None, None]
    amplitude = torch.where(fit.active, fit.coefficients.abs(), 0.0)
    frequency = torch.where(fit.active, fit.frequencies, 0.0)
    phase = fit.coefficients.angle() + 0.5 * math.pi - 2 * math.pi * frequency * centre
    phase = torch.remainder(phase + math.pi, 2 * math.pi) - math.pi
    phase = torch.where(fit.active, phase, 0.0)
    motion, acceleration = fit.drift[..., 0], torch.zeros_like(fit.drift[..., 0])
    if fit.drift.shape[-1] > 1:  # from the middle of the record to the time origin
        acceleration = fit.drift[..., 1]
        motion = motion - acceleration * centre[..., 0]
    return Vibration(amplitude, frequency, phase, motion, acceleration)


def offset_gain(frequencies: Tensor, intervals: Tensor) -> Tensor:
    """Largest gain (...) from displacement to offset (Eq. 7) of tones (...) over intervals (M,) s between frames."""
    return 2 * torch.sin(math.pi * frequencies[..., None] * intervals).abs().amax(-1)


def known_motion(fit: ToneFit, intervals: Tensor) -> Vibration:
    """As much of the motion of a fit as is known: tones near a blind frequency must not move frames by what may be.

    An amplitude A with deviation s counts for ``A max(0, 1 - s^2 / A^2)`` (positive-part James-Stein estimate) where
    the gain is small. Where it is large a tone is as good as what rows tell, however hard it is to tell from others.

    Args:
        fit: With its covariance.
        intervals: (M,) s, times between the frames compared.
    """
    blindness = 1 / (1 + (offset_gain(fit.frequencies, intervals) / BLIND).square())
    noise = (amplitude_deviation(fit) / fit.coefficients.abs().clamp(min=1e-30)).square()
    share = (1 - blindness * noise).clamp(min=0.0)
    return motion_of_fit(replace(fit, coefficients=fit.coefficients * share))


def vibration_of_fit(fit: ToneFit) -> tuple[Vibration, VibrationStd]:
    """Vibration (B, 2, K) from a fit as ``motion_of_fit``, and its standard deviations.

    Errors are carried through by their first derivatives, with all covariances. Tones that are not active have standard
    deviations 0.
    """
    centre = fit.centre[:, None, None]
    blocks, variance = _own_covariance(fit)
    real, imaginary, size = _direction(fit)
    zero, one = torch.zeros_like(real), torch.ones_like(real)
    frequency = torch.where(fit.active, fit.frequencies, 0.0)
    frequency_std = _deviation(fit, blocks, zero, zero, one)
    turn = -2 * math.pi * centre.expand_as(real)
    std = {
        "amplitude": _deviation(fit, blocks, real, imaginary, zero),
        "frequency": frequency_std,
        "period": frequency_std / torch.where(frequency > 0, frequency, 1.0).square(),
        "phase": _deviation(fit, blocks, -imaginary / size, real / size, turn),
    }
    order = torch.where(fit.active, fit.coefficients.abs(), 0.0).argsort(dim=-1, descending=True, stable=True)
    std = {name: value.take_along_dim(order, -1) for name, value in std.items()}
    motion_variance, acceleration_variance = variance[..., 0, 0], torch.zeros_like(variance[..., 0, 0])
    if fit.drift.shape[-1] > 1:  # from the middle of the record to the time origin
        acceleration_variance = variance[..., 1, 1]
        motion_variance = (
            motion_variance - 2 * centre[..., 0] * variance[..., 0, 1] + centre[..., 0].square() * acceleration_variance
        )
    deviations = VibrationStd(
        **std,
        image_motion=motion_variance.clamp(min=0.0).sqrt(),
        image_acceleration=acceleration_variance.clamp(min=0.0).sqrt(),
    )
    return motion_of_fit(fit), deviations
