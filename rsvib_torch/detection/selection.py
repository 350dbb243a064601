"""How many tones: added one by one, strongest first, as long as the data ask for them."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.fit import fit_tones
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.periodogram import strongest_frequency
from rsvib_torch.detection.tones import MotionModel, ToneFit, model_displacements

__all__ = ["MAX_TONES", "find_tones", "robust_fit"]

MAX_TONES = 4
_F_THRESHOLD = 14.0  # of chi-square gained per parameter over noise: chance over a whole frequency grid stays below it
_LEAST_GAIN = 0.2  # of the residual chi-square that a further tone must explain
_ROBUST_STEPS = 3


def robust_fit(
    measurements: Measurements, frequencies: Tensor, active: Tensor, model: MotionModel, steps: int = _ROBUST_STEPS
) -> tuple[ToneFit, Measurements]:
    """Fit, weigh outliers down, fit again; the fit and the weights it was made with."""
    fit = fit_tones(measurements, frequencies, active, model)
    weighed = measurements
    for _ in range(steps):
        weighed = measurements.reweighted(residual_of(measurements, fit))
        fit = fit_tones(weighed, fit.frequencies, active, model)
    return fit, weighed


def residual_of(measurements: Measurements, fit: ToneFit) -> Tensor:
    """Displacements (B, N, G, 2) that a fit leaves."""
    return measurements.relative(measurements.displacements - model_displacements(measurements, fit))


def find_tones(
    measurements: Measurements,
    sample_interval: float,
    tones: int | None = None,
    model: MotionModel | None = None,
    least_gain: float = _LEAST_GAIN,
) -> ToneFit:
    """Find and fit the tones of both axes without start values.

    The strongest tone of the gain-aware periodogram is added and all parameters are fitted again, until ``tones`` are
    there, or until the next one is not significant: it must lower the weighted sum of squares by far more than noise
    would over all frequencies tried (an F-test), and explain ``least_gain`` of what is left.

    Args:
        measurements: The displacements.
        sample_interval: Seconds between neighbouring rows or bands.
        tones: Number of tones of each axis (of families, where harmonics are tied); None to choose it from the data.
        model: What is fitted beside the tones.
        least_gain: Share of the residual that a further tone must explain.

    Returns:
        The fit, with K the largest number of tones of any axis (at least 1).
    """
    model = model or MotionModel()
    batch = len(measurements.moments)
    device = measurements.moments.device
    multiples = torch.arange(1, model.harmonics + 1, dtype=torch.float64, device=device)
    none = torch.zeros(batch, 2, model.harmonics, dtype=torch.bool, device=device)
    fit, weighed = robust_fit(measurements, none.double(), none, model)
    parameters = 2 * model.harmonics + 1
    going = torch.ones_like(none[..., 0])  # an axis that stopped stays stopped
    for count in range(1, (MAX_TONES if tones is None else tones) + 1):
        left = replace(weighed, displacements=residual_of(measurements, fit))
        candidate = strongest_frequency(left, sample_interval, model.harmonics)[..., None] * multiples
        keep = fit.active if count > 1 else none[..., :0]
        frequencies = torch.cat([fit.frequencies[..., : keep.shape[-1]], candidate], -1)
        active = torch.cat([keep, going[..., None].expand_as(none)], -1)
        trial, trial_weighed = robust_fit(measurements, frequencies, active, model)
        if tones is None:
            # both fits are judged with the weights of the richer one
            before = trial_weighed.square(residual_of(measurements, fit))
            after = trial_weighed.square(residual_of(measurements, trial))
            spare = (measurements.known - parameters * active.sum(-1) // model.harmonics - 1).clamp(min=1.0)
            statistic = (before - after) / parameters / (after / spare).clamp(min=1e-300)
            accepted = going & (statistic > _F_THRESHOLD) & (before - after > least_gain * before)
            if not bool(accepted.any()):
                break
            if not bool((accepted == going).all()):
                active = torch.cat([keep, accepted[..., None].expand_as(none)], -1)
                trial, trial_weighed = robust_fit(measurements, trial.frequencies, active, model)
            going = accepted
        fit, weighed = trial, trial_weighed
    return fit
