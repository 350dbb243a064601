"""Fits that outliers do not pull away, and what they leave."""

from dataclasses import fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.tones.fit import fit_roughly, fit_tones
from rsvib_torch.detection.tones.tone_model import MotionModel, ToneFit, model_displacements, tone_response

__all__ = ["of_each", "residual_of", "robust_fit", "shown_size", "typical_size"]

Kind = TypeVar("Kind", ToneFit, Measurements, OtherMotion)


def robust_fit(
    measurements: Measurements,
    frequencies: Tensor,
    active: Tensor,
    model: MotionModel,
    residual: Tensor | None = None,
) -> tuple[ToneFit, Measurements]:
    """Fit, weigh outliers down, fit again; the fit and the weights it was made with.

    Args:
        measurements: The displacements.
        frequencies: (B, 2, K) Hz to start from.
        active: (B, 2, K) bool.
        model: What is fitted beside the tones.
        residual: (B, N, G, 2) what an earlier fit leaves; None for none.
    """
    if residual is None:
        fit = fit_tones(measurements, frequencies, active, model)
        frequencies, residual = fit.frequencies, residual_of(measurements, fit)
    rough, residual = fit_roughly(measurements.reweighted(residual), frequencies, active, model)
    weighed = measurements.reweighted(residual)
    return fit_tones(weighed, rough, active, model), weighed


def residual_of(measurements: Measurements, fit: ToneFit) -> Tensor:
    """Displacements (B, N, G, 2) that a fit leaves."""
    return measurements.relative(measurements.displacements - model_displacements(measurements, fit))


def shown_size(measurements: Measurements, fit: ToneFit) -> Tensor:
    """Root-mean-square displacement (B, 2, K) in px that the record sees of each tone: next to none of a blind one."""
    seen = tone_response(measurements, fit.frequencies).abs().square().mean((1, 2)).sqrt()
    return torch.where(fit.active, fit.coefficients.abs() * seen, 0.0)


def typical_size(measurements: Measurements, fit: ToneFit) -> Tensor:
    """(B,) typical size of what a fit leaves, both axes together: stretches of outliers hardly raise it."""
    return measurements.sizes(residual_of(measurements, fit)).nanmedian(1).values.square().sum(-1)


def of_each(where: Tensor, one: Kind, other: Kind) -> Kind:
    """One result for the stacks (B,) where that is told, the other for the rest."""

    def pick(field: str) -> Any:
        mine, yours = getattr(one, field), getattr(other, field)
        if not isinstance(mine, Tensor):
            return mine
        return torch.where(where.reshape(-1, *(1,) * (mine.ndim - 1)), mine, yours)

    return replace(one, **{field.name: pick(field.name) for field in fields(one)})
