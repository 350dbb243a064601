"""How many tones: added one by one, strongest first, as long as the data ask for them."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.periodogram import strongest_frequency
from rsvib_torch.detection.tones import Measurements, ToneFit, fit_tones, model_offsets

__all__ = ["MAX_TONES", "find_tones", "reweighted"]

MAX_TONES = 4
_F_THRESHOLD = 14.0  # of chi-square gained per parameter over noise: chance over a whole frequency grid stays below it
_LEAST_GAIN = 0.2  # of the residual chi-square that a further tone must explain
_ROBUST_STEPS = 3
_TUNING = 4.685  # of Tukey's biweight: 95 % efficient for Gaussian errors


def reweighted(measurements: Measurements, residual: Tensor) -> Measurements:
    """Measurements with outliers weighed down by Tukey's biweight of their residual, axis by axis."""
    known = measurements.weights > 0
    size = torch.where(known, residual.abs() * measurements.weights.sqrt(), torch.nan)
    spread = 1.4826 * size.nanmedian(dim=1, keepdim=True).values
    spread = spread.nan_to_num(1.0).clamp(min=1e-9)
    ratio = torch.where(known, size / (_TUNING * spread), 1.0)
    factor = (1 - ratio.square()).clamp(min=0.0).square()
    root = factor.sqrt()
    information = measurements.information * root[..., :, None] * root[..., None, :]
    return replace(measurements, information=information)


def _robust_fit(measurements: Measurements, frequencies: Tensor, active: Tensor) -> tuple[ToneFit, Measurements]:
    """Fit, weigh outliers down, fit again."""
    fit = fit_tones(measurements, frequencies, active)
    weighed = measurements
    for _ in range(_ROBUST_STEPS):
        weighed = reweighted(measurements, measurements.offsets - model_offsets(measurements, fit))
        fit = fit_tones(weighed, fit.frequencies, active)
    return fit, weighed


def find_tones(measurements: Measurements, sample_interval: float, tones: int | None = None, group: int = 1) -> ToneFit:
    """Find and fit the tones of both axes without start values.

    The strongest tone of the gain-aware periodogram is added and all parameters are fitted again, until ``tones`` are
    there, or until the next one is not significant: it must lower the weighted sum of squares by far more than noise
    would over all frequencies tried (an F-test), and explain a fifth of what is left.

    Args:
        measurements: The offsets.
        sample_interval: Seconds between neighbouring rows or bands.
        tones: Number of tones of each axis; None to choose it from the data.
        group: Neighbouring measurements averaged for the periodogram.

    Returns:
        The fit, with K the largest number of tones of any axis (at least 1).
    """
    batch = len(measurements.starts)
    device = measurements.starts.device
    frequencies = torch.zeros(batch, 2, 1, dtype=torch.float64, device=device)
    active = torch.zeros(batch, 2, 1, dtype=torch.bool, device=device)
    fit, weighed = _robust_fit(measurements, frequencies, active)
    known = (measurements.weights > 0).sum(1) * measurements.independent  # (B, 2)
    for count in range(1, (MAX_TONES if tones is None else tones) + 1):
        left = replace(weighed, offsets=measurements.offsets - model_offsets(measurements, fit)).grouped(group)
        candidate = strongest_frequency(left, sample_interval)
        trial_active = torch.cat([fit.active, torch.ones_like(active)], -1) if count > 1 else torch.ones_like(active)
        if tones is None and count > 1:
            # an axis that stopped stays stopped
            trial_active[..., -1] &= fit.active[..., -1]
        previous = fit.frequencies if count > 1 else fit.frequencies[..., :0]
        trial, trial_weighed = _robust_fit(measurements, torch.cat([previous, candidate[..., None]], -1), trial_active)
        if tones is None:
            # both fits are judged with the weights of the richer one
            before = _weighted_square(trial_weighed, measurements.offsets - model_offsets(measurements, fit))
            after = _weighted_square(trial_weighed, measurements.offsets - model_offsets(measurements, trial))
            spare = (known - 3 * trial_active.sum(-1) - 1).clamp(min=1.0)
            statistic = (before - after) / 3 / (after / spare).clamp(min=1e-300)
            gained = (statistic > _F_THRESHOLD) & (before - after > _LEAST_GAIN * before)
            accepted = trial_active[..., -1] & gained
            if not bool(accepted.any()):
                break
            if not bool((accepted == trial_active[..., -1]).all()):
                trial_active = torch.cat([trial_active[..., :-1], accepted[..., None]], -1)
                trial, trial_weighed = _robust_fit(measurements, trial.frequencies, trial_active)
        fit, weighed = trial, trial_weighed
    return fit


def _weighted_square(measurements: Measurements, residual: Tensor) -> Tensor:
    return (measurements.weights * residual.square()).sum(1)
