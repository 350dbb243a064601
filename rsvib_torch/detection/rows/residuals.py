"""What rows tell beside a fitted motion, beyond their noise."""

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.registration.gradients import RowGradients

__all__ = ["independent_fraction", "slant", "trimmed_mean", "unexplained"]

_LAGS = 4  # blocks over which residuals may be correlated
_MAJORITY = 0.7  # of the rows: clouds and things that move by themselves may cover the others
_SLANT_ROWS = 64  # rows whose halves are compared
_USABLE = 1e-4  # least share of the product of the diagonal that the determinant of a stretch must keep


def independent_fraction(measurements: Measurements, residual: Tensor) -> float:
    """Fraction of the blocks that are independent, from the correlation of neighbouring residuals.

    Where the model misses something, residuals of neighbours are alike; the variance of a mean is larger by
    ``1 + 2 sum rho(k)``.
    """
    scaled = residual * measurements.weights.sqrt()[:, :, None]
    energy = scaled.square().sum()
    total = sum((scaled[:, lag:] * scaled[:, :-lag]).sum() / energy for lag in range(1, _LAGS + 1))
    return 1.0 / max(1.0, 1.0 + 2.0 * float(total))


def unexplained(measured: Measurements, residual: Tensor) -> Tensor:
    """(B, 2) px, rms of residuals beyond their noise."""
    counts = (measured.weights > 0) & (measured.differences[..., None] > 0)
    spare = measured.differences[..., None].clamp(min=1.0)
    excess = residual.square().sum(2) / spare - 1 / measured.weights.clamp(min=1e-300)
    return trimmed_mean(torch.where(counts, excess, torch.nan)).clamp(min=0.0).sqrt()


def slant(gradients: list[RowGradients]) -> Tensor:
    """(B, 2) px, rms difference between what the halves of the rows miss, beyond its noise."""
    excesses = []
    for known in gradients:
        rows = known.halves.shape[1] // _SLANT_ROWS * _SLANT_ROWS
        weight = torch.where(known.variance > 0, 1 / known.variance.clamp(min=1e-300), 0.0)[:, :rows, None, None]
        hxx, hxy, hyy, bx, by = (known.halves[:, :rows] * weight).unflatten(1, (-1, _SLANT_ROWS)).sum(2).unbind(-1)
        determinant = hxx * hyy - hxy.square()
        usable = determinant > _USABLE * hxx * hyy
        safe = torch.where(usable, determinant, 1.0)
        missed = -torch.stack([hyy * bx - hxy * by, hxx * by - hxy * bx], -1) / safe[..., None]  # (B, N, halves, 2)
        noise = 2 * torch.stack([hyy, hxx], -1) / safe[..., None]  # of a difference of two frames
        both = usable.all(-1)[..., None]
        excess = (missed[:, :, 1] - missed[:, :, 0]).square() - noise.sum(2)
        excesses.append(torch.where(both, excess, torch.nan))
    return trimmed_mean(torch.cat(excesses, 1)).clamp(min=0.0).sqrt()


def trimmed_mean(values: Tensor) -> Tensor:
    """Mean (B, A) of the smaller ones of values (B, N, A), NaN left out: a few rows are not held against all."""
    ordered = values.sort(dim=1).values  # NaN come last
    count = ((~torch.isnan(values)).sum(1, keepdim=True) * _MAJORITY).ceil()
    place = torch.arange(values.shape[1], device=values.device)[None, :, None]
    counted = place < count
    return torch.where(counted, ordered, 0.0).sum(1) / count[:, 0].clamp(min=1)
