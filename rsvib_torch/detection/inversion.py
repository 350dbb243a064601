"""From the fit to the vibration: amplitude, frequency and phase at the time origin, with standard deviations."""

import math

import torch
from torch import Tensor

from rsvib_torch.detection.result import VibrationStd
from rsvib_torch.detection.tones import ToneFit
from rsvib_torch.vibration import Vibration

__all__ = ["vibration_of_fit"]


def vibration_of_fit(fit: ToneFit) -> tuple[Vibration, VibrationStd]:
    """Vibration (B, 2, K) and its standard deviations from a fit (Eqs. 6-8; gain and exposure are in the fit already).

    ``A = |C|``, ``phi = arg C + pi/2 - 2 pi f centre``; errors are carried through by their first derivatives, with all
    covariances. Tones that are not active have amplitude, frequency and standard deviations 0.
    """
    batch, _, tones = fit.frequencies.shape
    centre = fit.centre[:, None, None]
    amplitude = torch.where(fit.active, fit.coefficients.abs(), 0.0)
    frequency = torch.where(fit.active, fit.frequencies, 0.0)
    phase = fit.coefficients.angle() + 0.5 * math.pi - 2 * math.pi * frequency * centre
    phase = torch.remainder(phase + math.pi, 2 * math.pi) - math.pi
    phase = torch.where(fit.active, phase, 0.0)

    size = 3 * tones + fit.drift.shape[-1]
    own = fit.covariance.reshape(batch, 2, size, 2, size).diagonal(dim1=1, dim2=3).movedim(-1, 1)  # (B, 2, size, size)
    blocks = torch.stack([own[..., 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(tones)], dim=2)
    safe = torch.where(amplitude > 0, amplitude, 1.0)
    real, imaginary = fit.coefficients.real / safe, fit.coefficients.imag / safe
    zero, one = torch.zeros_like(real), torch.ones_like(real)

    def deviation(*derivative: Tensor) -> Tensor:
        vector = torch.stack(derivative, dim=-1)
        variance = torch.einsum("bakp,bakpq,bakq->bak", vector, blocks, vector).clamp(min=0.0)
        return torch.where(fit.active, variance.sqrt(), 0.0)

    frequency_std = deviation(zero, zero, one)
    period_std = frequency_std / torch.where(frequency > 0, frequency, 1.0).square()
    turn = -2 * math.pi * centre.expand_as(real)
    std = {
        "amplitude": deviation(real, imaginary, zero),
        "frequency": frequency_std,
        "period": period_std,
        "phase": deviation(-imaginary / safe, real / safe, turn),
    }
    order = amplitude.argsort(dim=-1, descending=True, stable=True)
    std = {name: value.take_along_dim(order, -1) for name, value in std.items()}
    drift, variance = fit.drift, own[..., 3 * tones :, 3 * tones :]
    motion, acceleration = drift[..., 0], torch.zeros_like(drift[..., 0])
    motion_variance, acceleration_variance = variance[..., 0, 0], torch.zeros_like(motion)
    if drift.shape[-1] > 1:  # from the middle of the record to the time origin
        acceleration, acceleration_variance = drift[..., 1], variance[..., 1, 1]
        motion = motion - acceleration * centre[..., 0]
        motion_variance = (
            motion_variance - 2 * centre[..., 0] * variance[..., 0, 1] + centre[..., 0].square() * variance[..., 1, 1]
        )
    deviations = VibrationStd(
        **std,
        image_motion=motion_variance.clamp(min=0.0).sqrt(),
        image_acceleration=acceleration_variance.clamp(min=0.0).sqrt(),
    )
    return Vibration(amplitude, frequency, phase, motion, acceleration), deviations
