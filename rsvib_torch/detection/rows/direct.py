"""Direct detection: the motion is fitted to displacements that are measured around it on the images.

Every round of ``_refine`` has four steps:

1. warp the frames to the scene by the current motion,
2. measure the residual displacement and the information matrix of every scene row (``rows.displacements``), with roll
   and zoom in strips of columns (``rows.measured_rows``),
3. fit tones and image motion to the measurements by weighted least squares (``tones``),
4. stop if the next round would change the motion by much less than its standard deviation, or if the residual stalls.

Steps 1 and 2 do not depend on the model of the motion, step 3 does not depend on images.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.rows.measured_rows import MeasuredRows, RowRecord
from rsvib_torch.detection.tones.fit import (
    ToneFit,
    fit_tones,
    model_displacements,
    residual_of,
    select_stacks,
    shrunk_motion,
    strongest_only,
)
from rsvib_torch.detection.tones.selection import (
    find_tones,
    robust_fit,
    significant_only,
    typical_size,
)
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.vibration import Vibration, blind_frequencies
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.registration.gradients import RowGradients

__all__ = ["AbandonedError", "DirectFit", "offset_curve", "refine_directly"]


@dataclass(frozen=True, eq=False)
class DirectFit:
    """Result of the direct method.

    Attributes:
        measurements: Displacements of blocks of scene rows, measured around the fit.
        fit: The fit to them.
        other_motion: Motion in the measurements that the fit does not explain.
        robust_weights: (B, N, 2) weights 0 ... 1 by which the information of each row was multiplied; 0 for outliers.
        aliasing: (B,) px, expected size of the bias of the displacements by aliasing.
        uneven: (B, 2) px, differences of the displacements along a row that roll and zoom cannot explain.
        has_pattern: Whether a pattern of columns was subtracted.
    """

    measurements: Measurements
    fit: ToneFit
    other_motion: OtherMotion
    robust_weights: Tensor
    aliasing: Tensor
    uneven: Tensor
    has_pattern: bool = False


class AbandonedError(Exception):
    """The motion that was tried does not explain the rows after few rounds."""


# rounds; multiple of the residual that the verdict permits. Roll and zoom leave 0.1 of it, parallax 2 to 10 times it
_TRIED_ROUNDS, _MAX_TRIED = 3, 2.0


def refine_directly(
    rows: MeasuredRows,
    intervals: Tensor,
    start: ToneFit,
    tones: int | None,
    max_rounds: int = 12,
    *,
    is_trial: bool = False,
    has_pattern: bool | None = None,
) -> tuple[DirectFit, OffsetCurve, Tensor]:
    """Refine a detected motion on the images.

    With two frames, tones equally far above and below a blind frequency have the same gain and differ only within a
    frame; long exposures can make the start choose the wrong one. If the residual of a fit is too large, the fit from
    the mirrored frequency is computed as well, and the better one is returned.

    Args:
        rows: The frames. A column pattern of the sensor is subtracted in place.
        intervals: (M,) s, times between the frames that are compared.
        start: Fit to the offsets of row bands.
        tones: Number of tones of each axis; None to select it by significance.
        max_rounds: Largest number of rounds of measuring and fitting; exposures of 400 rows need more than six.
        is_trial: Whether the motion is possibly of another kind than assumed (parallax instead of roll). It is
            abandoned if a large residual remains after three rounds.
        has_pattern: Whether the frames have a pattern of columns: it is then subtracted after the first round instead
            of the last, or not looked for. None if it is not known.

    Returns:
        The last measurements and the fit to them, the measurements as offsets between consecutive frames, and the
        offsets (B, P, N, 2) in px that the fit predicts.

    Raises:
        AbandonedError: If a trial is abandoned.
    """
    motion = shrunk_motion(start, intervals)
    found = _refine(rows, intervals, start, tones, max_rounds, is_trial, has_pattern)
    if rows.differently_blurred(motion):
        tried = torch.zeros_like(start.active[..., 0])
        for _ in range(2):  # one axis after the other
            frequencies, mirrored = _mirrored_frequencies(found, start, tried)
            if not bool(mirrored.any()):
                break
            tried = tried | mirrored
            other, _ = robust_fit(found.measurements, frequencies, strongest_only(found.fit).active, start.model)
            again = _refine(rows, intervals, other, tones, max_rounds, has_pattern=has_pattern)
            found = replace(_better_of_each(found, again), has_pattern=found.has_pattern)  # it was subtracted before
    if tones is None:
        found = replace(found, fit=significant_only(found.measurements, found.fit, intervals))
    blur = rows.blur_ratio(shrunk_motion(found.fit, intervals))
    found = replace(found, other_motion=replace(found.other_motion, blur=blur))
    return found, *offset_curve(
        found.measurements, found.fit, found.robust_weights, [group.starts.shape[1] for group in rows.groups]
    )


def offset_curve(
    measurements: Measurements, fit: ToneFit, robust_weights: Tensor, group_frames: Sequence[int]
) -> tuple[OffsetCurve, Tensor]:
    """Measured offsets between consecutive frames, and those (B, P, N, 2) in px that a fit predicts.

    Args:
        measurements: Displacements of the rows of all groups behind each other.
        fit: The fit to them.
        robust_weights: As in ``DirectFit``.
        group_frames: Number of frames of each group; neighbouring groups share a frame.
    """
    count = measurements.displacements.shape[1] // len(group_frames)
    parts = [
        (slice(number * count, (number + 1) * count), slice(frame, frame + 2))
        for number, frames in enumerate(group_frames)
        for frame in range(frames - 1)
    ]

    def of_pairs(values: Tensor) -> tuple[Tensor, Tensor]:
        """Values (B, N, G, ...) of the earlier and the later frame of each pair, (B, P, N, ...)."""
        earlier, later = torch.stack([values[:, rows, frames] for rows, frames in parts], 1).unbind(3)
        return earlier, later

    def of_rows(values: Tensor) -> Tensor:
        return torch.stack([values[:, rows] for rows, _ in parts], 1)

    starts, later_starts = of_pairs(measurements.exposure_starts)
    before, after = of_pairs(measurements.displacements)
    everywhere = replace(measurements, visible=torch.ones_like(measurements.visible))
    fitted_before, fitted_after = of_pairs(model_displacements(everywhere, fit))
    visible = torch.stack(of_pairs(measurements.visible)).amin(0) > 0
    weights, robust = of_rows(measurements.weights), of_rows(robust_weights)
    measured = visible & (weights > 0).any(-1)
    frames = torch.arange(len(parts), device=starts.device)
    curve = OffsetCurve(
        pairs=torch.stack([frames, frames + 1], -1),
        rows=BLOCK_ROWS * (torch.arange(count, dtype=torch.float64, device=starts.device) + 0.5) - 0.5,
        times=starts,
        later_times=later_starts,
        offsets=torch.where(measured[..., None], after - before, torch.nan),
        quality=torch.where(measured, robust.amin(-1), 0.0),
        heights=(BLOCK_ROWS, BLOCK_ROWS),
        std=torch.where(weights > 0, (2.0 * robust / weights).sqrt(), torch.nan),  # of a difference of two
    )
    return curve, fitted_after - fitted_before


def _refine(
    rows: MeasuredRows,
    intervals: Tensor,
    start: ToneFit,
    tones: int | None,
    max_rounds: int,
    is_trial: bool = False,
    has_pattern: bool | None = None,
) -> DirectFit:
    """Measure around the motion, fit, repeat."""
    timing, fit, model = rows.timing, start, start.model
    motion, is_converged = shrunk_motion(fit, intervals), False
    gradients: list[RowGradients] | None = None  # None: compute them from the warped frames
    steps: list[_Step] = []
    sizes: list[Tensor] = []  # (B, A), typical residuals since the search in standard deviations
    fits: list[ToneFit] = []  # since the search, with the same tones
    search_round = 1  # the first round removes the error of the band offsets; weak tones are significant after it
    patterns = _Patterns(rows, 0 if has_pattern is False else 2)  # a strong pattern biases its first estimate
    interval = max(BLOCK_ROWS * timing.row_time, 0.5 * timing.exposure_time)  # exposures average out faster tones
    blind = blind_frequencies(timing, 0.5 / interval).to(motion.device)
    for number in range(max_rounds):
        record, previous = rows.measure(motion, gradients), fit
        measurements = record.measurements
        residual = residual_of(measurements, fit)
        size = measurements.sizes(residual).nanmedian(1).values
        sizes = [*sizes, size] if number != search_round else []  # fewer tones before the search
        if number == search_round:
            independent = replace(measurements, independent=measurements.independent_fraction(residual))
            # the noise of rows is nearly white: a tone that explains a fiftieth of the residual is significant
            fit = find_tones(independent, interval, tones, model, 0.02, strongest_only(fit), blind)
        else:
            fit, _ = robust_fit(measurements, fit.frequencies, fit.active, model, residual, steps=1)
        fits = [*fits, fit] if torch.equal(previous.active, fit.active) and number > search_round else [fit]
        warped_by, motion, gradients = motion, shrunk_motion(fit, intervals), record.gradients
        if number == 0 and has_pattern and patterns.subtracted(motion, gradients):
            gradients = None
            continue
        if number == max_rounds - 1 or not bool((measurements.weights > 0).any()):  # or nothing is visible any more
            break

        if is_trial and number == _TRIED_ROUNDS - 1:
            _abandon_if_large(record, fit)
        if number == search_round + 1 and patterns.were_not_the_cause(size):
            break
        step = _Step.between(measurements, warped_by, motion)
        ratio = step.ratio_to(steps[-1]) if steps and torch.equal(previous.active, fit.active) else None
        converged = _converged(previous, fit, ratio) & (number >= search_round)
        stalled = _stalled(sizes, record, fit)
        if bool((converged | stalled).all()):
            if not patterns.subtracted(motion, gradients, size if bool(stalled.all()) else None):
                is_converged = bool(converged.all())
                break
            search_round, gradients, steps, sizes = number + 1, None, [], []
            continue
        # steps with other tones do not predict the next one
        steps = [*steps[-3:], step] if len(fits) > 1 else [step]
        if len(steps) > 1 and bool((inexact := step.is_inexact_after(steps[-2])).any()):
            fit = _accelerated_fit(measurements, steps, inexact, fit)
            motion = shrunk_motion(fit, intervals)
            step = _Step.between(measurements, warped_by, motion)
        if float(step.change.abs().amax()) > 0.05:  # px; over smaller distances the gradients of the scene are the same
            gradients = None
    found = replace(_conclude(record, fit), has_pattern=patterns.found)
    return found if is_converged else _not_converged(found, warped_by, motion, fits)


def _not_converged(found: DirectFit, warped_by: Motion, motion: Motion, fits: list[ToneFit]) -> DirectFit:
    """The fit of a refinement that did not converge: what its last rounds changed is not known.

    The change of the displacements by the last round counts as motion that is not explained. The axes count alike,
    because the displacement along one determines which rows are compared along the other. Tones of 10 to 40 px in three
    frames with a long exposure did not converge: they were wrong, with a permitted residual.

    The changes of the parameters since the last ``fits`` count as errors. Tones near blind frequencies with long
    exposures had errors of 4 to 18 standard deviations without them.
    """
    change = _Step.between(found.measurements, warped_by, motion).change
    distance = found.measurements.distances(change).square().nanmean(1).nan_to_num(0.0).sqrt()
    other, fit = found.other_motion, found.fit
    least = (distance / other.permitted).amax(-1, keepdim=True) * other.permitted
    other = replace(other, unexplained=torch.maximum(other.unexplained, least))
    changes = torch.stack([one.about(fit.centre).parameters - fit.parameters for one in fits], -1).flatten(1, 2)
    return replace(found, other_motion=other, fit=replace(fit, covariance=fit.covariance + changes @ changes.mT))


def _abandon_if_large(record: RowRecord, fit: ToneFit) -> None:
    """Raise ``AbandonedError`` if the fit leaves a large residual."""
    other = _conclude(record, fit).other_motion
    if bool((other.unexplained > _MAX_TRIED * other.permitted).any()):
        raise AbandonedError


@dataclass(eq=False)
class _Patterns:
    """Patterns of columns that are subtracted after some of the rounds.

    Attributes:
        rows: The frames.
        remaining: Number of times that a pattern may be subtracted.
        found: Whether there was a pattern.
        refused: (B, A) residuals before the last pattern was subtracted, if all axes were refused; else None.
    """

    rows: MeasuredRows
    remaining: int
    found: bool = False
    refused: Tensor | None = None

    def subtracted(self, motion: Vibration, gradients: list[RowGradients], refused: Tensor | None = None) -> bool:
        """Subtract a pattern; False if there is none, or if the axes are refused again after the last one."""
        if self.remaining == 0 or (refused is not None and self.refused is not None):
            return False
        if not self.rows.remove_column_pattern(motion, gradients):
            return False
        self.remaining, self.found, self.refused = self.remaining - 1, True, refused
        return True

    def were_not_the_cause(self, size: Tensor) -> bool:
        """Whether refused axes have residuals (B, A) of more than half the size without the pattern."""
        return self.refused is not None and bool((size > 0.5 * self.refused).all())


# Convergence


@dataclass(frozen=True, eq=False)
class _Step:
    """A round of measuring and fitting, as relative displacements (B, N, G, 2) of the rows in px.

    Attributes:
        fitted: Displacements by the fit.
        change: The same less those by the motion that the frames were warped by.
    """

    fitted: Tensor
    change: Tensor

    @classmethod
    def between(cls, measurements: Measurements, warped_by: Motion, fitted: Motion) -> "_Step":
        """Step from the motion that the frames were warped by to the fitted motion."""
        before, after = (
            measurements.relative(motion.mean_displacement(measurements.exposure_starts, measurements.exposure_time))
            for motion in (warped_by, fitted)
        )
        return cls(after, after - before)

    def ratio_to(self, previous: "_Step") -> Tensor:
        """(B,) length of the step over the length of the previous one."""
        square, previous_square = (step.change.square().sum((1, 2, 3)) for step in (self, previous))
        return (square / previous_square.clamp(min=1e-30)).sqrt()

    def is_inexact_after(self, previous: "_Step") -> Tensor:
        """(B,) bool, whether the previous step was too short or too long by more than 30 %: this one corrects it."""
        product = (self.change * previous.change).sum((1, 2, 3))
        return (product / previous.change.square().sum((1, 2, 3)).clamp(min=1e-30)).abs() > 0.3


def _stalled(sizes: list[Tensor], record: RowRecord, fit: ToneFit) -> Tensor:
    """(B, A) bool, axes whose typical residual hardly decreased in two rounds, and which are refused because of it.

    A quarter in two rounds is too little to reach what is permitted in the rounds that remain.

    Args:
        sizes: Typical residuals of the rounds so far, in standard deviations.
        record: Measurements of this round.
        fit: The fit to them.
    """
    if len(sizes) < 3 or not bool((stalled := sizes[-1] > 0.75 * sizes[-3]).any()):
        return torch.zeros((), dtype=torch.bool, device="cpu")
    other = _conclude(record, fit).other_motion
    return stalled & (other.unexplained > other.permitted)


def _converged(previous: ToneFit, fit: ToneFit, ratio: Tensor | None) -> Tensor:
    """(B, A) bool, whether the next round is expected to change the tones of an axis by 8 % of their std.

    Without long exposures a step is a tenth of the previous one or shorter. Changes of up to half a standard deviation
    are therefore small enough, and up to three standard deviations if the measured ratio of two steps allows it.

    Args:
        previous: The fit of the previous round.
        fit: The fit of this round.
        ratio: (B,) length of the last step over that of the step before; None if unknown.
    """
    if previous.active.shape != fit.active.shape:
        return torch.zeros_like(fit.active[..., 0])
    deviation = fit.covariance.diagonal(dim1=-2, dim2=-1)
    deviation = deviation.unflatten(-1, (fit.coefficients.shape[1], -1)).clamp(min=0.0).sqrt()
    std = deviation[..., : 3 * fit.frequencies.shape[-1]].unflatten(-1, (-1, 3))  # of Re C, Im C and f
    change = (previous.about(fit.centre).coefficients - fit.coefficients).abs()
    max_change_std = change.new_full((), 0.5)
    if ratio is not None:
        max_change_std = (0.08 / ratio.clamp(min=1e-3)).clamp(0.5, 3.0)[:, None, None]
    small = (change <= max_change_std * std[..., :2].amax(-1)) & (
        (previous.frequencies - fit.frequencies).abs() <= max_change_std * std[..., 2]
    )
    converged: Tensor = (small | ~fit.active).all(-1)
    return converged


def _accelerated_fit(measurements: Measurements, steps: list[_Step], where: Tensor, fit: ToneFit) -> ToneFit:
    """Fit to the measurements from ``_accelerated``."""
    accelerated = _accelerated(measurements, steps, where)
    given = residual_of(accelerated, fit)
    return robust_fit(accelerated, fit.frequencies, fit.active, fit.model, given, steps=1)[0]


def _accelerated(measurements: Measurements, steps: list[_Step], where: Tensor) -> Measurements:
    """Measurements corrected by the combination of the last steps that would have left the least change.

    A wrong motion also blurs the warped frames wrongly. With long exposures, rows therefore measure up to twice their
    residual displacement, or half of it, and plain rounds overshoot or converge slowly (Anderson acceleration: J. ACM
    12, 547, 1965).

    Args:
        measurements: The measurements of the last step.
        steps: The last steps, with the same tones.
        where: (B,) bool, stacks to correct.
    """
    pairs = list(itertools.pairwise(steps))
    fitted = torch.stack([after.fitted - before.fitted for before, after in pairs], -1)
    change = torch.stack([after.change - before.change for before, after in pairs], -1).flatten(1, -2)  # (B, n, M)
    gram, right = change.mT @ change, change.mT @ steps[-1].change.flatten(1)[..., None]
    ridge = 1e-3 * gram.diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=1e-30)
    share = torch.linalg.solve(
        gram + ridge[:, None, None] * torch.eye(len(pairs), dtype=torch.float32, device="cpu").to(gram), right
    )[..., 0]
    share = share.clamp(-4.0, 4.0) * where[:, None]  # no extrapolation over more than four steps
    correction = (fitted * share[:, None, None, None]).sum(-1)
    return replace(measurements, displacements=measurements.displacements - correction)


# Mirrored frequencies


def _mirrored_frequencies(found: DirectFit, start: ToneFit, tried: Tensor) -> tuple[Tensor, Tensor]:
    """Frequencies of the strongest tones, that of the less explained axis mirrored at the nearest blind frequency.

    Args:
        found: Fit that may be at the wrong side of a blind frequency ``j / (m T_row)``.
        start: Fit that it was refined from.
        tried: (B, 2) bool, axes that were mirrored before.

    Returns:
        Frequencies (B, 2, 1) in Hz and the axes (B, 2) that are mirrored, at most one of each stack: those with a
        residual of three standard deviations in the typical row, and frequencies that a frame does not resolve.
    """
    measurements, fit = found.measurements, strongest_only(found.fit)
    residual = measurements.sizes(residual_of(measurements, found.fit)).nanmedian(1).values.nan_to_num(0.0)  # (B, 2)
    exposure_starts = measurements.exposure_starts
    duration = (exposure_starts.amax(1) - exposure_starts.amin(1)).amax(-1)[:, None]
    interval = (exposure_starts[:, :, 1] - exposure_starts[:, :, 0]).mean(1)[:, None]
    frequency = strongest_only(start).frequencies[..., 0]
    mirrored = 2 * (frequency * interval).round() / interval - frequency
    unresolved = ((mirrored - frequency).abs() * duration < 0.35) & (mirrored > 0) & fit.active[..., 0]
    where = unresolved & ~tried & (residual > 3.0) & (residual == residual.amax(-1, keepdim=True))
    if fit.model.harmonics > 1 or exposure_starts.shape[2] > 2:
        where = torch.zeros_like(where)
    return torch.where(where, mirrored, fit.frequencies[..., 0])[..., None], where


def _better_of_each(one: DirectFit, other: DirectFit) -> DirectFit:
    """For every stack the result with the smaller residual in the typical row."""
    better = typical_size(other.measurements, other.fit) < typical_size(one.measurements, one.fit)
    if not bool(better.any()):
        return one
    if bool(better.all()):
        return other
    measurements = select_stacks(better, other.measurements, one.measurements)
    count = max(one.fit.active.shape[-1], other.fit.active.shape[-1])

    def tones(first: Tensor, second: Tensor) -> Tensor:
        first, second = (functional.pad(values, (0, count - values.shape[-1])) for values in (first, second))
        return torch.where(better[:, None, None], first, second)

    frequencies = tones(other.fit.frequencies, one.fit.frequencies)
    fit = fit_tones(measurements, frequencies, tones(other.fit.active, one.fit.active), one.fit.model)
    return DirectFit(
        measurements,
        fit,
        select_stacks(better, other.other_motion, one.other_motion),
        torch.where(better[:, None, None], other.robust_weights, one.robust_weights),
        torch.where(better, other.aliasing, one.aliasing),
        torch.where(better[:, None], other.uneven, one.uneven),
    )


def _conclude(record: RowRecord, fit: ToneFit) -> DirectFit:
    """The last fit, to the measurements themselves, with a covariance that accounts for correlated residuals."""
    measurements = record.measurements
    residual = residual_of(measurements, fit)
    weighted = measurements.reweighted(residual)
    share = weighted.independent_fraction(residual) * measurements.share_counted(residual)
    weighted = replace(weighted, independent=share)
    fit = fit_tones(weighted, fit, fit.active, fit.model)
    shown = measurements.num_differences > 0
    measured = (shown & (measurements.weights > 0).any(-1)).double().sum(1) / shown.double().sum(1).clamp(min=1.0)
    tones = measurements.relative(model_displacements(measurements, replace(fit, drift=torch.zeros_like(fit.drift))))
    other = OtherMotion(
        size=math.sqrt(2) * measurements.distances(tones).square().nanmean(1).sqrt(),
        unexplained=measurements.unexplained(residual),
        correlated=measurements.correlated(residual),
        differential=record.differential(),
        measured=measured,
        blur=measured.new_tensor([1.0, 0.0, 0.0]).expand(len(measured), 3),  # replaced once the motion is final
    )
    robust_weights = weighted.weights / measurements.weights.clamp(min=1e-300)
    aliasing = torch.stack([own.aliasing for own in record.gradients]).mean(0)
    return DirectFit(weighted, fit, other, robust_weights, aliasing, record.uneven())
