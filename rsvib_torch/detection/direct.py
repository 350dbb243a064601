"""Detection at the limit: measure around the model, fit, repeat."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.detection.fit import fit_tones
from rsvib_torch.detection.inversion import vibration_of_fit
from rsvib_torch.detection.leftovers import independent_fraction, slant, unexplained
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.row_groups import BLOCK, frame_groups, join_groups, measure_group, warping
from rsvib_torch.detection.selection import (
    find_tones,
    residual_of,
    robust_fit,
    shown_size,
    significant_only,
    strongest_only,
)
from rsvib_torch.detection.tones import ToneFit
from rsvib_torch.registration.gradients import RowGradients
from rsvib_torch.registration.pattern import column_pattern
from rsvib_torch.registration.row_spectra import RowSpectra
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration, blind_frequencies

__all__ = ["DirectFit", "refine_directly"]

_CLEANINGS = 2  # rounds of taking out what is fixed to the sensor
_NEAR = 0.05  # px: gradients of frames that were warped this well need not be taken again
_RUNAWAY = 2.0  # times larger from round to round: no tone that was found does that
_BACK = -0.3  # part of a step that the next one takes back: then both were too long
_SHORTEST = 0.25  # of what rows say is missing
_LEAST_GAIN = 0.02  # of the residual that a further tone must explain: the rows' noise is nearly white


@dataclass(frozen=True, eq=False)
class DirectFit:
    """What the direct method found.

    Attributes:
        measurements: Displacements of blocks of scene rows, measured around the fit.
        fit: The fit to them.
        other_motion: What the rows tell beside it.
    """

    measurements: Measurements
    fit: ToneFit
    other_motion: OtherMotion


def _displacements(measurements: Measurements, motion: Vibration) -> Tensor:
    return motion.mean_displacement(measurements.moments, measurements.exposure_time)


def _believed(told: Measurements, around: Vibration, belief: Tensor) -> Measurements:
    """Measurements around a motion with parts (B,) of what rows say is missing."""
    placed = told.relative(_displacements(told, around))
    return replace(told, displacements=placed + belief[:, None, None, None] * (told.displacements - placed))


def _shorter(belief: Tensor, step: Tensor, before: Tensor) -> Tensor:
    """Parts (B,) of what rows say is missing to believe, after two steps (B, N, G, 2) of the motion.

    Where an exposure is long, a wrong motion blurs frames wrongly as well, and rows say up to twice what is missing.
    Steps then overshoot: of two in opposite directions the second is ``1 - belief gain`` times the first.
    """
    back = (step * before).sum((1, 2, 3)) / before.square().sum((1, 2, 3)).clamp(min=1e-30)
    return torch.where(back < _BACK, (belief / (1 - back)).clamp(min=_SHORTEST), belief)


def _settled(before: ToneFit, after: ToneFit) -> bool:
    """Whether a round changed coefficients and frequencies by less than half their standard deviations."""
    deviation = after.covariance.diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, -1)).clamp(min=0.0).sqrt()
    parts = deviation[..., : 3 * after.frequencies.shape[-1]].unflatten(-1, (-1, 3))
    turn = 2 * math.pi * before.frequencies * (after.centre - before.centre)[:, None, None]
    change = (before.coefficients * torch.polar(torch.ones_like(turn), turn) - after.coefficients).abs()
    small = (change <= 0.5 * parts[..., :2].amax(-1)) & (
        (before.frequencies - after.frequencies).abs() <= 0.5 * parts[..., 2]
    )
    return bool((small | ~after.active).all())


def _without_runaways(measurements: Measurements, before: ToneFit, after: ToneFit) -> ToneFit:
    """The fit without tones, but the one of an axis that shows most, that grow from round to round.

    Near a blind frequency, or where the exposure fades it, a large tone leaves hardly an offset. What no tone explains
    may ask for one, and for a larger one when frames were warped by it.
    """
    size, grown = before.coefficients.abs(), after.coefficients.abs()
    shown = shown_size(measurements, before)
    strongest = shown == shown.amax(-1, keepdim=True)
    running = after.active & ~strongest & (grown > _RUNAWAY * size.clamp(min=_NEAR))
    if not bool(running.any()):
        return after
    return robust_fit(measurements, before.frequencies, after.active & ~running, after.model)[0]


def refine_directly(
    spectra: RowSpectra,
    timing: SensorTiming,
    start: ToneFit,
    tones: int | None,
    iterations: int = 10,
) -> DirectFit:
    """Refine a detected motion on the images themselves.

    The frames of a group are warped to the scene with the motion, every row tells what it still misses in each frame
    and how well it knows it, and the motion is fitted again to those rows; image work and motion model meet only here.

    Args:
        spectra: Of all frames, from ``stack_spectra``.
        timing: The sensor, in row order.
        start: The motion to start with, from the band offsets.
        tones: Number of tones of each axis; None to choose it from the rows.
        iterations: Rounds of measuring and fitting at most.

    Returns:
        The last measurements and the fit to them.
    """
    fit, model = start, start.model
    motion, _ = vibration_of_fit(fit)
    groups = frame_groups(spectra, timing, motion, alike=True)
    gradients: list[RowGradients | None] = [None] * len(groups)
    belief = torch.ones(len(start.active), dtype=torch.float64, device=start.active.device)
    last: Tensor | None = None
    cleanings = _CLEANINGS
    search_at = 1  # the first round removes the error of the bands: then weak tones show
    interval = max(BLOCK * timing.row_time, 0.5 * timing.exposure_time)  # the exposure averages out what is faster
    blind = blind_frequencies(timing, 0.5 / interval).to(spectra.values.device)
    for step in range(iterations):
        measured = [measure_group(group, timing, motion, known) for group, known in zip(groups, gradients, strict=True)]
        gradients = [known for _, known in measured]
        told = join_groups([part for part, _ in measured])
        before, around = fit, motion
        measurements = _believed(told, motion, belief)
        if step == search_at:
            left = residual_of(measurements, fit)
            careful = replace(measurements, independent=independent_fraction(measurements, left))
            fit = find_tones(careful, interval, tones, model, _LEAST_GAIN, strongest_only(fit), blind)
        else:
            fit, _ = robust_fit(measurements, fit.frequencies, fit.active, model, residual_of(measurements, fit))
            if step > search_at:
                fit = _without_runaways(measurements, before, fit)
        motion, _ = vibration_of_fit(fit)
        if step == iterations - 1:
            break
        if step > search_at and _settled(before, fit):
            pattern = None
            if cleanings:
                leaves = [known.variance for known in gradients if known is not None]
                warps = [warping(group, timing, motion) for group in groups]
                pattern = column_pattern([(*warp, left) for warp, left in zip(warps, leaves, strict=True)])
            if pattern is None:
                break
            cleanings, search_at = cleanings - 1, step + 1
            for group in groups:
                group.spectra.subtract(pattern)
            gradients = [None] * len(groups)
            continue
        change = measurements.relative(_displacements(measurements, motion) - _displacements(measurements, around))
        if float(change.abs().amax()) > _NEAR:
            gradients = [None] * len(groups)
        plain = step > search_at and torch.equal(before.active, fit.active)  # else steps are of another model
        if plain and last is not None:
            belief = _shorter(belief, change, last)
        last = change if plain else None
    return _concluded(told, fit, tones, gradients)


def _concluded(told: Measurements, fit: ToneFit, tones: int | None, gradients: list[RowGradients | None]) -> DirectFit:
    """The last fit, to all that the rows say: with the part of it that was believed their noise would seem smaller."""
    residual = residual_of(told, fit)
    weighed = told.reweighted(residual)
    share = independent_fraction(weighed, residual) * told.share_counted(residual)
    honest = replace(weighed, independent=share)
    fit = fit_tones(honest, fit.frequencies, fit.active, fit.model)
    if tones is None:
        fit = significant_only(honest, fit)
    apart = OtherMotion(unexplained(told, residual), slant([g for g in gradients if g is not None]))
    return DirectFit(honest, fit, apart)
