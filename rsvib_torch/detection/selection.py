"""How many tones: added one by one, strongest first, as long as the data ask for them."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.fit import fit_tones
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.periodogram import BLIND, MAJORITY, strongest_frequencies
from rsvib_torch.detection.tones import MotionModel, ToneFit, model_displacements, tone_response

__all__ = ["MAX_TONES", "find_tones", "residual_of", "robust_fit", "significant_only", "strongest_only"]

MAX_TONES = 4
_F_THRESHOLD = 14.0  # of chi-square gained per parameter over noise: chance over a whole frequency grid stays below it
_LEAST_GAIN = 0.2  # of the residual chi-square that a further tone must explain
_LEAST_APART = 0.7  # of one over the record: tones nearer than this are one that the noise has split
_CANDIDATES = 4  # peaks of the periodogram that are tried: outliers may raise a wrong one
_ABSOLUTE_STEPS = 8
_FEW_ITERATIONS = 5
_ROBUST_STEPS = 2


def robust_fit(
    measurements: Measurements, frequencies: Tensor, active: Tensor, model: MotionModel, reckon: bool = False
) -> tuple[ToneFit, Measurements]:
    """Fit, weigh outliers down, fit again; the fit and the weights it was made with.

    Args:
        measurements: The displacements.
        frequencies: (B, 2, K) Hz to start from.
        active: (B, 2, K) bool.
        model: What is fitted beside the tones.
        reckon: Reckon with long stretches of outliers: find the motion of the majority first.
    """
    fit = _of_majority(measurements, frequencies, active, model) if reckon else None
    fit = fit or fit_tones(measurements, frequencies, active, model)
    weighed = measurements
    for _ in range(_ROBUST_STEPS):
        weighed = measurements.reweighted(residual_of(measurements, fit))
        fit = fit_tones(weighed, fit.frequencies, active, model)
    return fit, weighed


def _of_majority(measurements: Measurements, frequencies: Tensor, active: Tensor, model: MotionModel) -> ToneFit:
    """Least absolute residuals: the motion of the majority, whatever the others do.

    Frequencies stay where they are until the outliers have lost their pull.
    """
    fit = fit_tones(measurements, frequencies, active, model, 0)
    for step in range(_ABSOLUTE_STEPS):
        weighed = measurements.for_least_absolute(residual_of(measurements, fit))
        fit = fit_tones(weighed, fit.frequencies, active, model, 0 if step < _ABSOLUTE_STEPS // 2 else _FEW_ITERATIONS)
    return fit


def _best_fit(
    measurements: Measurements,
    frequencies: Tensor,
    active: Tensor,
    candidates: Tensor,
    model: MotionModel,
    reckon: bool,
) -> tuple[ToneFit, Measurements]:
    """The robust fit with the one of several candidates (B, 2, C, H) for a further tone that explains most."""
    batch, _, count, harmonics = candidates.shape
    several = measurements.repeated(count)
    known = frequencies.repeat_interleave(count, dim=0)
    further = candidates.transpose(1, 2).flatten(0, 1)
    actives = active.repeat_interleave(count, dim=0)
    start = torch.cat([known, further], -1)
    fit = (
        _of_majority(several, start, actives, model)
        if reckon
        else fit_tones(several, start, actives, model, _FEW_ITERATIONS)
    )
    left = several.sizes(residual_of(several, fit)).nanquantile(MAJORITY, dim=1).nan_to_num(0.0)  # (B C, 2)
    sighted = _sighted(several, fit.frequencies[..., -harmonics:])
    worst = left.unflatten(0, (batch, count)).amax(1, keepdim=True)
    score = (worst - left.unflatten(0, (batch, count))) * sighted.unflatten(0, (batch, count))
    best = score.argmax(1)[:, None, :, None]  # each axis for itself
    chosen = fit.frequencies.unflatten(0, (batch, count)).gather(1, best.expand(-1, -1, -1, fit.frequencies.shape[-1]))
    return robust_fit(measurements, chosen[:, 0], active, model, reckon)


def _sighted(measurements: Measurements, frequencies: Tensor) -> Tensor:
    """(B, 2) 0 for frequencies (B, 2, H) that the record is blind to, 1 where the gain is large."""
    response = tone_response(measurements, frequencies)
    gain = 4 * response.abs().square().mean((1, 2)).amax(-1)
    return gain / (gain + BLIND**2)


def residual_of(measurements: Measurements, fit: ToneFit) -> Tensor:
    """Displacements (B, N, G, 2) that a fit leaves."""
    return measurements.relative(measurements.displacements - model_displacements(measurements, fit))


def find_tones(
    measurements: Measurements,
    sample_interval: float,
    tones: int | None = None,
    model: MotionModel | None = None,
    least_gain: float = _LEAST_GAIN,
    start: ToneFit | None = None,
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
        start: Tones that are known to be there; without it the search reckons with stretches of outliers.

    Returns:
        The fit, with K the largest number of tones of any axis (at least 1).
    """
    model = model or MotionModel()
    batch = len(measurements.moments)
    device = measurements.moments.device
    multiples = torch.arange(1, model.harmonics + 1, dtype=torch.float64, device=device)
    none = torch.zeros(batch, 2, model.harmonics, dtype=torch.bool, device=device)
    keep = none[..., :0] if start is None else start.active
    first = none if start is None else start.active
    known = none.double() if start is None else start.frequencies
    fit, weighed = robust_fit(measurements, known, first, model, reckon=start is None)
    parameters = 2 * model.harmonics + 1
    going = torch.ones_like(none[..., 0])  # an axis that stopped stays stopped
    for _ in range(keep.shape[-1] // model.harmonics, MAX_TONES if tones is None else tones):
        left = replace(weighed, displacements=residual_of(measurements, fit))
        found = [strongest_frequencies(left, sample_interval, model.harmonics, _CANDIDATES)]
        if keep.shape[-1] == 0:
            unweighed = replace(measurements, displacements=left.displacements)
            found.append(
                strongest_frequencies(unweighed, sample_interval, model.harmonics, _CANDIDATES, _ABSOLUTE_STEPS)
            )
        candidates = torch.cat(found, -1)[..., None] * multiples
        frequencies = fit.frequencies[..., : keep.shape[-1]]
        active = torch.cat([keep, going[..., None].expand_as(none)], -1)
        trial, trial_weighed = _best_fit(measurements, frequencies, active, candidates, model, start is None)
        if tones is None:
            # both fits are judged with the weights of the richer one
            before = trial_weighed.square(residual_of(measurements, fit))
            after = trial_weighed.square(residual_of(measurements, trial))
            spare = (measurements.known - parameters * active.sum(-1) // model.harmonics - 1).clamp(min=1.0)
            statistic = (before - after) / parameters / (after / spare).clamp(min=1e-300)
            accepted = going & (statistic > _F_THRESHOLD) & (before - after > least_gain * before)
            accepted = accepted & _resolved(measurements, trial)
            if keep.shape[-1] > 0:  # what the record hardly sees may be refused, but is not invented beside others
                accepted = accepted & (_sighted(measurements, trial.frequencies[..., -model.harmonics :]) > 0.5)
            if not bool(accepted.any()):
                break
            if not bool((accepted == going).all()):
                active = torch.cat([keep, accepted[..., None].expand_as(none)], -1)
                trial, trial_weighed = robust_fit(measurements, trial.frequencies, active, model)
            going = accepted
        fit, weighed = trial, trial_weighed
        keep = fit.active
    return fit


def _resolved(measurements: Measurements, fit: ToneFit) -> Tensor:
    """(B, 2) bool: whether all tones of an axis are far enough apart for the record to tell them from one."""
    span = measurements.moments.amax((1, 2)) - measurements.moments.amin((1, 2))
    order = torch.where(fit.active, fit.frequencies, torch.nan).sort(dim=-1).values
    return ~((order[..., 1:] - order[..., :-1]) * span[:, None, None] < _LEAST_APART).any(-1)


def significant_only(measurements: Measurements, fit: ToneFit, least: float = 4.0) -> ToneFit:
    """The fit without the tones, but the strongest of an axis, that are less than ``least`` standard deviations tall.

    With harmonics, a family goes as a whole.
    """
    harmonics = fit.model.harmonics
    deviation = fit.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt().unflatten(-1, (2, -1))
    of_tones = deviation[..., : 3 * fit.active.shape[-1]].unflatten(-1, (-1, 3))[..., :2].amax(-1)
    size = torch.where(fit.active, fit.coefficients.abs(), 0.0)
    tall = (size > least * of_tones) & fit.active
    strongest = size == size.amax(-1, keepdim=True)
    keep = ((tall | strongest) & fit.active).unflatten(-1, (-1, harmonics)).any(-1).repeat_interleave(harmonics, -1)
    if bool((keep == fit.active).all()):
        return fit
    return fit_tones(measurements, fit.frequencies, keep & fit.active, fit.model)


def strongest_only(fit: ToneFit) -> ToneFit:
    """The fit with the strongest tone (or family) of each axis alone."""
    harmonics = fit.model.harmonics
    size = torch.where(fit.active, fit.coefficients.abs(), 0.0).unflatten(-1, (-1, harmonics))
    family = size.sum(-1).argmax(-1)[..., None, None].expand(-1, -1, 1, harmonics)

    def pick(values: Tensor) -> Tensor:
        picked: Tensor = values.unflatten(-1, (-1, harmonics)).gather(2, family)[:, :, 0]
        return picked

    return replace(fit, coefficients=pick(fit.coefficients), frequencies=pick(fit.frequencies), active=pick(fit.active))
