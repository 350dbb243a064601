"""Error of the displacements by aliasing: estimated from the residuals of a fit, and removed from its parameters.

Frames contain an aliased part of the scene, which a displacement d multiplies by ``exp(2 pi i d)`` along its axis
whatever its frequency. It biases the displacement of a row in frame p, relative to the mean over the G frames, by

    b / G sum_q sin(2 pi (d_p - d_q))

with one size b for each axis. With four frames, b is 2e-3 px for optics of 0.3 px (Gaussian, standard deviation) and
below 3e-5 px for 0.7 px. The phase of the bias turns with every pixel of displacement, so that motions of more than
about 1 px determine b from the residuals.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements
from rsvib_torch.detection.tones.linearised import LinearisedFit

__all__ = ["without_aliasing"]


def without_aliasing(measurements: Measurements, fit: ToneFit, size: Tensor) -> ToneFit:
    """The fit without the error by aliasing of x and y, and with its remaining uncertainty in the covariance.

    Args:
        measurements: The measurements of the fit, with its weights.
        fit: With its covariance.
        size: (B,) px, prior standard deviation of b.
    """
    precision = size.clamp(min=1e-9).square().reciprocal()[:, None]
    covariance, axes = fit.covariance.clone(), fit.drift.shape[1]
    change = fit.drift.new_zeros(len(covariance), axes, covariance.shape[-1] // axes)
    bias = _unit_bias(measurements, model_displacements(measurements, fit))
    for problem in LinearisedFit.of_each_axis(measurements, fit)[:2]:
        Z, by_unit = problem.unexplained(bias[..., problem.axis, None])
        variance = 1 / (Z.square().sum(1) + problem.rounding[:, None] + precision)  # (B, 1), of b
        b = variance * (Z[..., 0] * problem.residual).sum(1, keepdim=True)
        problem.add_covariance(covariance, by_unit * variance[..., None] @ by_unit.mT)
        problem.add_change(change, -b * by_unit[..., 0])
    tones, drift = change.split((3 * fit.frequencies.shape[-1], fit.drift.shape[-1]), dim=-1)
    real, imaginary, frequency = tones.unflatten(-1, (-1, 3)).unbind(-1)
    return replace(
        fit,
        coefficients=fit.coefficients + torch.complex(real, imaginary),
        frequencies=(fit.frequencies + frequency).clamp(min=0.0),
        drift=fit.drift + drift,
        covariance=covariance,
    )


def _unit_bias(measurements: Measurements, displacements: Tensor) -> Tensor:
    """Bias (B, N, G, A) of relative displacements of that shape, for b = 1."""
    angle = 2 * math.pi * displacements
    turn = torch.polar(torch.ones_like(angle), angle)
    visible = measurements.visible[..., None]
    mean = (visible * turn).sum(2, keepdim=True) / visible.sum(2, keepdim=True).clamp(min=1.0)
    return measurements.relative((turn * mean.conj()).imag)
