"""Detection at the limit: measure around the model, fit, repeat."""

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.rows.equal_blur import blurred_unlike
from rsvib_torch.detection.rows.residuals import independent_fraction, slant, unexplained
from rsvib_torch.detection.rows.row_groups import (
    BLOCK,
    LARGEST_GROUP,
    FrameGroup,
    frame_groups,
    intervals_compared,
    join_groups,
    measure_group,
    warping,
)
from rsvib_torch.detection.tones.fit import ToneFit, fit_tones, residual_of, select_stacks, shrunk_motion
from rsvib_torch.detection.tones.selection import (
    find_tones,
    robust_fit,
    significant_only,
    strongest_only,
    typical_size,
    visible_size,
)
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration, blind_frequencies
from rsvib_torch.registration.gradients import RowGradients
from rsvib_torch.registration.row_spectra import EVERY, RowSpectra, column_pattern

__all__ = ["DirectFit", "refine_directly"]

_CLEANINGS = 2  # rounds of taking out what is fixed to the sensor
_NEAR = 0.05  # px: gradients of frames that were warped this well need not be taken again
_LITTLE, _NOT_MUCH = 0.5, 1.5  # standard deviations that a last round may change, if the one before changed far more
_HARDLY = 0.05  # standard deviations that the next round may then be expected to change
_RUNAWAY = 2.0  # times larger from round to round: no tone that was found does that
_LINGERING = 0.3  # of a step that is still missing after it, or was too much: then earlier steps are looked at
_REMEMBERED = 3  # steps
_FARTHEST = 4.0  # steps that are taken back or repeated at a time
_UNEXPLAINED = 3.0  # standard deviations that the typical row is off: the model is wrong
_TOLD_APART = 0.35  # of one over the time of a scan: frequencies nearer than this look alike to two frames
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


@dataclass(frozen=True, eq=False)
class _Step:
    """What a round of measuring and fitting came to, as relative displacements (B, N, G, 2) of the rows.

    Attributes:
        reached: Those of the fit.
        change: Those of the fit less those of the motion that the frames were warped by.
    """

    reached: Tensor
    change: Tensor

    def lingers(self, before: "_Step") -> Tensor:
        """(B,) bool: whether much of the step before is still to be gone, or to be taken back."""
        left = (self.change * before.change).sum((1, 2, 3)) / before.change.square().sum((1, 2, 3)).clamp(min=1e-30)
        return left.abs() > _LINGERING

    def share_of(self, before: "_Step") -> Tensor:
        """(B,) how large the step is, of the one before."""
        size, last = (step.change.square().sum((1, 2, 3)) for step in (self, before))
        return (size / last.clamp(min=1e-30)).sqrt()


def _corrected(told: Measurements, steps: list[_Step]) -> Measurements:
    """Measurements less what the last steps teach about how rows respond to a change of the motion, where steps linger.

    Where an exposure is long, a wrong motion blurs frames wrongly as well, and rows say up to twice what is missing, or
    half of it. The combination of the last steps is taken that would have left the least change (Anderson, J. ACM 12,
    547, 1965).
    """
    lingering = steps[-1].lingers(steps[-2])
    if not bool(lingering.any()):
        return told
    pairs = list(itertools.pairwise(steps))
    reached = torch.stack([after.reached - before.reached for before, after in pairs], -1)
    change = torch.stack([after.change - before.change for before, after in pairs], -1).flatten(1, -2)  # (B, n, M)
    gram, right = change.mT @ change, change.mT @ steps[-1].change.flatten(1)[..., None]
    ridge = 1e-3 * gram.diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=1e-30)
    share = torch.linalg.solve(gram + ridge[:, None, None] * torch.eye(len(pairs)).to(gram), right)[..., 0]
    share = share.clamp(-_FARTHEST, _FARTHEST) * lingering[:, None]
    return replace(told, displacements=told.displacements - (reached * share[:, None, None, None]).sum(-1))


def _settled(before: ToneFit, after: ToneFit, share: Tensor | None) -> bool:
    """Whether the next round would change coefficients and frequencies by hardly a twentieth of their deviations.

    Errors shrink from round to round, under short exposures to a tenth and less: a round that changed little was the
    last, and so was one that changed much less than the one before.

    Args:
        before: The fit of the round before.
        after: The fit of this round.
        share: (B,) size of this step, of the one before; None: not known.
    """
    if before.active.shape != after.active.shape:
        return False
    deviation = after.covariance.diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, -1)).clamp(min=0.0).sqrt()
    parts = deviation[..., : 3 * after.frequencies.shape[-1]].unflatten(-1, (-1, 3))
    turn = 2 * math.pi * before.frequencies * (after.centre - before.centre)[:, None, None]
    change = (before.coefficients * torch.polar(torch.ones_like(turn), turn) - after.coefficients).abs()
    bound = change.new_full((), _LITTLE)
    if share is not None:
        bound = (_HARDLY / share.clamp(min=1e-3)).clamp(_LITTLE, _NOT_MUCH)[:, None, None]
    small = (change <= bound * parts[..., :2].amax(-1)) & (
        (before.frequencies - after.frequencies).abs() <= bound * parts[..., 2]
    )
    return bool((small | ~after.active).all())


def _without_runaways(measurements: Measurements, before: ToneFit, after: ToneFit) -> ToneFit:
    """The fit without tones, but the one of an axis that shows most, that grow from round to round.

    Near a blind frequency, or where the exposure fades it, a large tone leaves hardly an offset. What no tone explains
    may ask for one, and for a larger one when frames were warped by it.
    """
    size, grown = before.coefficients.abs(), after.coefficients.abs()
    shown = visible_size(measurements, before)
    strongest = shown == shown.amax(-1, keepdim=True)
    running = after.active & ~strongest & (grown > _RUNAWAY * size.clamp(min=_NEAR))
    if not bool(running.any()):
        return after
    return robust_fit(measurements, before.frequencies, after.active & ~running, after.model)[0]


def refine_directly(
    spectra: RowSpectra, timing: RowTiming, start: ToneFit, tones: int | None, iterations: int = 12
) -> DirectFit:
    """Refine a detected motion on the images themselves.

    The frames of a group are warped to the scene with the motion, every row tells what it still misses in each frame
    and how well it knows it, and the motion is fitted again to those rows; image work and motion model meet only here.

    Tones equally far above and below a blind frequency look alike to a short record, and long exposures mislead the
    start. Where rows are left unexplained, the other side is tried as well.

    Args:
        spectra: Of all frames, from ``stack_spectra``.
        timing: The sensor, in row order.
        start: The motion to start with, from the band offsets.
        tones: Number of tones of each axis; None to choose it from the rows.
        iterations: Rounds of measuring and fitting at most.

    Returns:
        The last measurements and the fit to them.
    """
    intervals = intervals_compared(timing, spectra.values.shape[1], LARGEST_GROUP, start.active.device)
    motion = shrunk_motion(start, intervals)
    groups = frame_groups(spectra, timing, motion, alike=True)
    found = _refine(groups, timing, intervals, start, tones, iterations)
    tried = torch.zeros_like(start.active[..., 0])
    for _ in range(2):
        frequencies, rival = _beyond_blind(found, start, tried)
        if not bool(rival.any()):
            break
        if not any(bool(blurred_unlike(group.starts, spectra.height, timing, motion).any()) for group in groups):
            break
        tried = tried | rival
        other, _ = robust_fit(found.measurements, frequencies, strongest_only(found.fit).active, start.model)
        found = _better_of_each(found, _refine(groups, timing, intervals, other, tones, iterations))
    if tones is not None:
        return found
    return replace(found, fit=significant_only(found.measurements, found.fit, intervals))


def _refine(
    groups: list[FrameGroup],
    timing: RowTiming,
    intervals: Tensor,
    start: ToneFit,
    tones: int | None,
    iterations: int,
) -> DirectFit:
    """Measure around the motion, fit, repeat."""
    fit, model = start, start.model
    motion = shrunk_motion(fit, intervals)
    gradients: list[RowGradients | None] = [None] * len(groups)
    steps: list[_Step] = []
    cleanings = _CLEANINGS
    search_at = 1  # the first round removes the error of the bands: then weak tones show
    interval = max(BLOCK * timing.row_time, 0.5 * timing.exposure_time)  # the exposure averages out what is faster
    blind = blind_frequencies(timing, 0.5 / interval).to(motion.device)
    for step in range(iterations):
        measured = [measure_group(group, timing, motion, known) for group, known in zip(groups, gradients, strict=True)]
        gradients = [known for _, known in measured]
        measurements = join_groups([part for part, _ in measured])
        before, placed = fit, measurements.relative(_displacements(measurements, motion))
        if step == search_at:
            left = residual_of(measurements, fit)
            careful = replace(measurements, independent=independent_fraction(measurements, left))
            fit = find_tones(careful, interval, tones, model, _LEAST_GAIN, strongest_only(fit), blind)
        else:
            fit, _ = robust_fit(measurements, fit.frequencies, fit.active, model, residual_of(measurements, fit))
            if step > search_at:
                fit = _without_runaways(measurements, before, fit)
        motion = shrunk_motion(fit, intervals)
        if step == iterations - 1:
            break
        reached = measurements.relative(_displacements(measurements, motion))
        taken, same = _Step(reached, reached - placed), torch.equal(before.active, fit.active)
        if step >= search_at and _settled(before, fit, taken.share_of(steps[-1]) if steps and same else None):
            pattern = None
            if cleanings:
                leaves = [known.variance[:, ::EVERY] for known in gradients if known is not None]
                warps = [warping(group, timing, motion, EVERY) for group in groups]
                pattern = column_pattern([(*warp, left) for warp, left in zip(warps, leaves, strict=True)])
            if pattern is None:
                break
            cleanings, search_at = cleanings - 1, step + 1
            for group in groups:
                group.spectra.subtract(pattern)
            gradients, steps = [None] * len(groups), []
            continue
        same = same and step > search_at  # else steps are of another model
        steps = [*(steps[-_REMEMBERED:] if same else ()), taken]
        if len(steps) > 1:
            nearer = _corrected(measurements, steps)
            if nearer is not measurements:
                fit, _ = robust_fit(nearer, fit.frequencies, fit.active, model, residual_of(nearer, fit))
                motion = shrunk_motion(fit, intervals)
                reached = measurements.relative(_displacements(measurements, motion))
        if float((reached - placed).abs().amax()) > _NEAR:
            gradients = [None] * len(groups)
    return _concluded(measurements, fit, gradients)


def _beyond_blind(found: DirectFit, start: ToneFit, tried: Tensor) -> tuple[Tensor, Tensor]:
    """Of the strongest tones, that of the axis that leaves most unexplained on the other side of a blind frequency.

    Two frames see tones equally far above and below ``j / (m T_row)`` with the same gain; they differ within a frame.

    Args:
        found: So far.
        start: What it started with.
        tried: (B, 2) bool, axes that need not be looked at.

    Returns:
        (B, 2, 1) Hz, and which axes' are others, (B, 2) bool: at most one of a stack.
    """
    measurements, fit = found.measurements, strongest_only(found.fit)
    left = measurements.sizes(residual_of(measurements, found.fit)).nanmedian(1).values.nan_to_num(0.0)  # (B, 2)
    moments = measurements.moments
    span = (moments.amax(1) - moments.amin(1)).amax(-1)[:, None]
    interval = (moments[:, :, 1] - moments[:, :, 0]).mean(1)[:, None]
    first = strongest_only(start).frequencies[..., 0]
    mirrored = 2 * (first * interval).round() / interval - first
    alike = ((mirrored - first).abs() * span < _TOLD_APART) & (mirrored > 0) & fit.active[..., 0]
    rival = alike & ~tried & (left > _UNEXPLAINED) & (left == left.amax(-1, keepdim=True))
    if fit.model.harmonics > 1 or moments.shape[2] > 2:
        rival = torch.zeros_like(rival)
    return torch.where(rival, mirrored, fit.frequencies[..., 0])[..., None], rival


def _better_of_each(one: DirectFit, other: DirectFit) -> DirectFit:
    """For every stack the result that leaves the typical row less."""
    better = typical_size(other.measurements, other.fit) < typical_size(one.measurements, one.fit)
    if not bool(better.any()):
        return one
    if bool(better.all()):
        return other
    measurements = select_stacks(better, other.measurements, one.measurements)
    most = max(one.fit.active.shape[-1], other.fit.active.shape[-1])

    def tones(name: str) -> Tensor:
        mine, yours = (getattr(found.fit, name) for found in (other, one))
        mine, yours = (functional.pad(values, (0, most - values.shape[-1])) for values in (mine, yours))
        return torch.where(better[:, None, None], mine, yours)

    fit = fit_tones(measurements, tones("frequencies"), tones("active"), one.fit.model)
    return DirectFit(measurements, fit, select_stacks(better, other.other_motion, one.other_motion))


def _concluded(told: Measurements, fit: ToneFit, gradients: list[RowGradients | None]) -> DirectFit:
    """The last fit, to what the rows say themselves."""
    residual = residual_of(told, fit)
    weighed = told.reweighted(residual)
    share = independent_fraction(weighed, residual) * told.share_counted(residual)
    honest = replace(weighed, independent=share)
    fit = fit_tones(honest, fit.frequencies, fit.active, fit.model)
    apart = OtherMotion(unexplained(told, residual), slant([g for g in gradients if g is not None]))
    return DirectFit(honest, fit, apart)
