"""Refinement of a detected motion on the images: rounds of measuring the rows and fitting the motion to them.

``Refinement.step`` is one round:

1. warp the frames to the scene by the current motion, and measure the residual displacement and the information matrix
   of every scene row (``rows.displacements``), with roll and zoom in strips of columns (``rows.grouped_frames``),
2. fit tones and image motion to the measurements by weighted least squares (``tones``),
3. decide: stop, or continue, possibly with a faster step.

Step 1 does not depend on the model of the motion, step 2 does not depend on images. All B stacks take part in a round;
those that are finished leave the batch. Patterns of columns that are found around the final motion are subtracted, and
the rounds repeated.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from rsvib_torch.detection.convergence import Acceleration, Step, is_converged
from rsvib_torch.detection.measurements import Measurements, OtherMotion
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.rows.grouped_frames import GroupedFrames, MeasuredRows
from rsvib_torch.detection.tones.fit import (
    ToneFit,
    covariance_with_tones,
    fitted_again,
    is_bounded,
    model_displacements,
    motion_of_fit,
    offset_gain,
    residual_of,
    shrunk,
    strongest_only,
    with_tones,
)
from rsvib_torch.detection.tones.selection import (
    find_tones,
    robust_fit,
    significant_only,
    typical_size,
    with_best_aliases,
)
from rsvib_torch.motion.vibration import Vibration, blind_frequencies
from rsvib_torch.numerics.tables import Array, median, select_stacks, table, take_stacks, valid_mean, without_nan
from rsvib_torch.registration.gradients import RowGradients


@dataclass(frozen=True, eq=False)
class FittedRows:
    """Displacements of the rows of B stacks, and the motion that was fitted to them."""

    measurements: Measurements  # displacements of blocks of scene rows, measured around the fit, with its weights
    fit: ToneFit  # the fit to them
    # motion in the measurements that the fit does not explain, before insignificant tones are left out
    other_motion: OtherMotion
    # (B, N, A) weights 0 ... 1 by which the information of each row was multiplied; 0 for outliers.
    robust_weights: Array
    aliasing: Array  # (B,) px, expected size of the bias of the displacements by aliasing
    uneven: Array  # (B, 2) px, differences of the displacements along a row that roll and zoom cannot explain
    frames: GroupedFrames  # the frames; without a pattern of columns if there was one
    row_variance: Array  # (B, M, S) residual variance of the S rows of the M groups of frames
    unknown: Array  # (B, A P, A P) covariance by the changes in the last rounds; 0 for stacks that converged
    abandoned: Array  # (B,) bool, stacks whose large residual ended the rounds early


def refine(
    frames: GroupedFrames,
    intervals: Array,
    start: ToneFit,
    tones: int | None,
    *,
    may_abandon: bool = False,
) -> FittedRows:
    """Refine a motion of row bands on the images: the last measurements and the fit; arguments as in ``Refinement``."""
    # 1. Rounds of measuring and fitting from the given start.
    refined = _rounds(frames, intervals, start, tones, may_abandon=may_abandon)
    # 2. Stacks with a pattern of columns are fitted again without it. A strong pattern biases its first estimate, and
    # is therefore subtracted twice.
    device = frames.groups[0].starts.device
    for _ in range(2):
        motion = motion_of_fit(shrunk(refined.fit, intervals), device)
        pattern = refined.frames.column_pattern(motion, refined.row_variance)
        has_pattern = table((pattern != 0).any(-1)).reshape(len(refined.abandoned), -1).any(1) & ~refined.abandoned
        if not has_pattern.any():
            break
        index = np.flatnonzero(has_pattern)
        cleaned = refined.frames.without(pattern)
        from_fit = take_stacks([refined.fit], index)
        refitted = _rounds(cleaned.stacks(index), intervals, from_fit, tones, search_round=0)
        refined = replace(_with_stacks(refined, refitted, index), frames=cleaned)
    # 3. A long exposure can make the start choose the wrong side of a blind frequency: the other side is tried as well,
    # one axis after the other.
    blurred = frames.differently_blurred(motion_of_fit(shrunk(start, intervals), device))
    # the axes without this risk, and those of abandoned stacks, count as tried
    tried = ~(blurred[:, None] | _is_nearly_blind(refined.fit, intervals)) | refined.abandoned[:, None]
    while not tried.all():
        frequencies, mirrored = mirrored_frequencies(refined.measurements, refined.fit, start, tried)
        if not mirrored.any():
            break
        tried = tried | mirrored
        active, index = strongest_only(refined.fit).active, np.flatnonzero(mirrored.any(-1))
        mirrored_fit, _ = robust_fit(refined.measurements, frequencies, active, start.drift_order)
        # a pattern that was subtracted does not appear again
        from_fit = take_stacks([mirrored_fit], index)
        refitted = _rounds(refined.frames.stacks(index), intervals, from_fit, tones, may_abandon=may_abandon)
        refined = with_better(refined, refitted, index)
    # 4. Tones that the exact fit does not confirm are left out.
    if tones is None:
        fit = significant_only(refined.measurements, refined.fit, intervals)
        if fit is not refined.fit:  # it was fitted again, so that its covariance lacks the changes in the last rounds
            refined = replace(refined, fit=replace(fit, covariance=fit.covariance + refined.unknown))
    # 5. The difference of the blur of the frames, by the final motion, contradicts a wrong exposure time.
    blur = table(refined.frames.blur_ratio(motion_of_fit(shrunk(refined.fit, intervals), device)))
    return replace(refined, other_motion=replace(refined.other_motion, blur=blur))


def _rounds(
    frames: GroupedFrames,
    intervals: Array,
    start: ToneFit,
    tones: int | None,
    *,
    may_abandon: bool = False,
    search_round: int = 1,
) -> FittedRows:
    """All rounds from a start; arguments as in ``Refinement``."""
    running = Refinement(frames, intervals, start, tones, may_abandon=may_abandon, search_round=search_round)
    results: list[FittedRows] = []
    stacks: list[Array] = []
    while True:
        running.step()
        finished = running.ended | running.settled
        if finished.any():
            finished_part = running.only(finished)
            results, stacks = [*results, finished_part.result()], [*stacks, finished_part.stacks]
        if finished.all():
            break
        running = running.only(~finished)
        running.accelerate()
    return replace(_joined_results(results, np.concatenate(stacks).argsort()), frames=frames)


def _joined_results(results: Sequence[FittedRows], index: Array) -> FittedRows:
    """``take_stacks`` of results with different numbers of tones."""
    count = max(result.fit.active.shape[-1] for result in results)
    roomy = [
        replace(rows, fit=with_tones(rows.fit, count), unknown=covariance_with_tones(rows.unknown, rows.fit, count))
        for rows in results
    ]
    return take_stacks(roomy, index)


def _with_stacks(result: FittedRows, replacement: FittedRows, index: Array) -> FittedRows:
    """The result of a batch, with the ``replacement`` of its stacks ``index``."""
    place = np.arange(len(result.unknown))
    place[index] = len(place) + np.arange(len(index))
    return _joined_results([result, replacement], place)


class Refinement:
    """State of the rounds that refine the motion of B stacks, from a fit to the offsets of row bands.

    ``intervals`` (M,) are the times in s between the frames that are compared; ``tones`` is the number of tones of each
    axis, None to select it by significance. ``may_abandon``: whether the motion is possibly of another kind than
    assumed (parallax instead of roll); stacks with a large residual after three rounds are then abandoned. Further
    tones are searched for in the round ``search_round``: the first round removes the error of the band offsets, and
    weak tones are significant after it.
    """

    def __init__(
        self,
        frames: GroupedFrames,
        intervals: Array,
        start: ToneFit,
        tones: int | None,
        *,
        may_abandon: bool,
        search_round: int,
    ) -> None:
        self.frames, self.fit = frames, start  # the fit of the last round
        # the fits around whose motions the next round measures and the last one measured
        self.around = self.warped_by = shrunk(start, intervals)
        self.round, self.search_round = 0, search_round  # the next round
        self.stacks = np.arange(len(start.centre))  # (B,) indices in the batch
        # (B,) bool: stacks that end without convergence, stacks that need no further round, stacks whose next round
        # would change little, and abandoned stacks
        self.ended = self.settled = self.converged = self.abandoned = np.zeros_like(start.centre, dtype=bool)
        self._intervals, self._tones, self._may_abandon = intervals, tones, may_abandon
        # exposures average out faster tones
        self._sample_interval = max(BLOCK_ROWS * frames.timing.row_time, 0.5 * frames.timing.exposure_time)
        self._blind = table(blind_frequencies(frames.timing, 0.5 / self._sample_interval))
        self._measured: MeasuredRows  # of the last round
        self._gradients: list[RowGradients] | None = None  # of the scene; None: compute them from the warped frames
        self._acceleration = Acceleration()
        self._step: Step  # of the last round
        self._stalled: Array  # (B, A) bool, after the last round
        # of the rounds since the search: (B, A) typical residuals in standard deviations, and fits of the same tones
        self._sizes: list[Array] = []
        self._fits: list[ToneFit] = []

    @property
    def motion(self) -> Vibration:
        """The motion around which the next round measures, on the device of the frames."""
        return motion_of_fit(self.around, self.frames.groups[0].starts.device)

    def step(self) -> None:
        """One round: measure the rows around the motion, fit the motion to them, decide how to continue."""
        number, previous = self.round, self.fit
        self.round += 1

        # 1. Measure the displacements of the rows around the motion.
        measured = self._measured = self.frames.measure(self.motion, self._gradients)
        measurements = measured.measurements
        residual = residual_of(measurements, previous)
        size = median(measurements.sizes(residual), 1)
        self._sizes = [] if number == self.search_round else [*self._sizes, size]  # fewer tones before the search

        # 2. Fit the motion to them, and keep the last fit of a stack whose fit diverges.
        if number == self.search_round:  # the noise of rows is nearly white: a further tone that explains 2 % counts
            scaled = replace(measurements, independent=measurements.independent_fraction(residual))
            start = with_best_aliases(scaled, strongest_only(self.fit))
            fit = find_tones(scaled, self._sample_interval, self._tones, start.drift_order, 0.02, start, self._blind)
        else:
            tones = previous.frequencies, previous.active, previous.drift_order
            fit = robust_fit(measurements, *tones, residual, steps=1)[0]
        fit = self.fit = self._bounded(fit, previous)
        same_tones = number > self.search_round and np.array_equal(previous.active, fit.active)
        self._fits = [*self._fits, fit] if same_tones else [fit]
        self.warped_by, self.around = self.around, shrunk(fit, self._intervals)
        self._gradients = measured.gradients

        # 3. Stacks that no further round would help: those whose rows are not measured, and those whose hypothesis
        # leaves a large residual.
        if self._may_abandon and self.round == _TRIED_ROUNDS:
            other_motion = conclude(self.frames, measured, self.fit).other_motion
            self.abandoned = np.any(other_motion.unexplained > _MAX_RESIDUAL * other_motion.permitted, -1)
        self.ended = self.abandoned | ~(measurements.weights > 0).any((1, 2)) | (self.round == _MAX_ROUNDS)

        # 4. Settled stacks: the next round would change the motion by much less than its standard deviation, or the
        # residual of an axis that is refused hardly decreases.
        self._step = Step.between(measurements, self.warped_by, self.around)
        converged = is_converged(previous, fit) & (number >= self.search_round)
        self._stalled = self._refused_for_good(measured)
        self.converged = np.all(converged, -1)
        self.settled = np.all(converged | self._stalled, -1) & ~self.ended

    def accelerate(self) -> None:
        """Accelerate the last step from the ones before; the gradients are kept where it is short."""
        measurements = self._measured.measurements
        self._acceleration.add(self._step, same_tones=len(self._fits) > 1)
        faster = self._acceleration.applied(measurements, self.fit)
        step = self._step
        if faster is not None:
            self.fit = self._bounded(faster, self.fit)
            self.around = shrunk(self.fit, self._intervals)
            step = Step.between(measurements, self.warped_by, self.around)
        if float(np.abs(step.change).max()) > _SAME_GRADIENTS:
            self._gradients = None

    def only(self, where: Array) -> "Refinement":
        """The refinement of the stacks where ``where`` (B,) is true."""
        if where.all():
            return self
        index, selection = np.flatnonzero(where), copy(self)
        selection.frames, selection._measured = self.frames.stacks(index), self._measured.stacks(index)
        for name in ("fit", "around", "warped_by", "_step"):
            setattr(selection, name, take_stacks([getattr(self, name)], index))
        selection._fits = [take_stacks([fit], index) for fit in self._fits]
        selection._acceleration = Acceleration([take_stacks([step], index) for step in self._acceleration.steps])
        selection._sizes = [size[index] for size in self._sizes]
        for name in ("stacks", "ended", "settled", "converged", "abandoned", "_stalled"):
            setattr(selection, name, getattr(self, name)[index])
        if self._gradients is not None:
            selection._gradients = selection._measured.gradients
        return selection

    def result(self) -> FittedRows:
        """The last measurements, with the exact fit to them.

        If the rounds did not converge, the error that remains is not known. The change of the displacements by the last
        round counts as unexplained motion, for all axes, because the displacement along one determines which rows
        are compared along the other: tones of 10 to 40 px in three frames with a long exposure were wrong, with a
        permitted residual. The changes of the parameters by the last rounds count as errors of unknown sign: tones near
        blind frequencies with long exposures had errors of 4 to 18 standard deviations without them.
        """
        fitted = replace(conclude(self.frames, self._measured, self.fit), abandoned=self.abandoned)
        unknown = ~(self.converged | self.abandoned)
        if not bool(unknown.any()):
            return fitted
        measurements, fit, other_motion = fitted.measurements, fitted.fit, fitted.other_motion
        change, permitted = Step.between(measurements, self.warped_by, self.around).change, other_motion.permitted
        distance = np.sqrt(without_nan(valid_mean(np.square(measurements.distances(change)), 1), 0.0))
        least = (distance * unknown[:, None] / permitted).max(-1, keepdims=True) * permitted
        changes = np.stack([past.about(fit.centre).parameters - fit.parameters for past in self._fits], -1)
        changes = changes.reshape(len(unknown), -1, len(self._fits)) * unknown[:, None, None]
        covariance = changes @ changes.mT
        return replace(
            fitted,
            other_motion=replace(other_motion, unexplained=np.maximum(other_motion.unexplained, least)),
            fit=replace(fit, covariance=fit.covariance + covariance),
            unknown=covariance,
        )

    def _bounded(self, fit: ToneFit, previous: ToneFit) -> ToneFit:
        """The fit, with the previous one for stacks whose fit diverges."""
        bounded = is_bounded(fit, self.frames.timing.exposure_time)
        if bool(bounded.all()):
            return fit
        if fit.active.shape != previous.active.shape:  # of a search: all stacks keep the tones that they had
            return previous
        return select_stacks(bounded, fit, previous)

    def _refused_for_good(self, measured: MeasuredRows) -> Array:
        """(B, A) bool, axes whose typical residual hardly decreased in two rounds, and which are refused because of it.

        A decrease by a quarter in two rounds is too slow to reach a permitted residual in the rounds that remain.
        """
        stalled = np.zeros_like(self.fit.active[..., 0])
        if len(self._sizes) > 2:
            stalled = self._sizes[-1] > 0.75 * self._sizes[-3]
        if not stalled.any():
            return stalled
        other_motion = conclude(self.frames, measured, self.fit).other_motion
        return stalled & (other_motion.unexplained > other_motion.permitted)


# rounds before the test; residual over the one that the verdict permits. Roll and zoom leave 0.1 of it, parallax 2 to
# 10 times it
_TRIED_ROUNDS, _MAX_RESIDUAL = 3, 2.0
_MAX_ROUNDS = 12  # exposures of 400 rows need more than six
_SAME_GRADIENTS = 0.05  # px; over smaller distances the gradients of the scene are the same


def conclude(frames: GroupedFrames, measured: MeasuredRows, fit: ToneFit) -> FittedRows:
    """The exact fit to the measurements themselves, with a covariance that accounts for correlated residuals."""
    measurements = measured.measurements
    residual = residual_of(measurements, fit)
    weighted = measurements.weighed(residual)
    fit = fitted_again(weighted, fit)
    tones = model_displacements(measurements, replace(fit, drift=np.zeros_like(fit.drift)))
    other_motion = OtherMotion.of(measurements, tones, residual, measured.differential())
    return FittedRows(
        weighted,
        fit,
        other_motion,
        robust_weights=weighted.weights / np.maximum(measurements.weights, 1e-300),
        aliasing=measured.aliasing(),
        uneven=measured.uneven(),
        frames=frames,
        row_variance=measured.row_variance(),
        unknown=np.zeros_like(fit.covariance),
        abandoned=np.zeros_like(fit.centre, dtype=bool),
    )


# Mirrored frequencies

# px of offset per px of displacement; with a gain of 0.05, a tone of 2.18 px was found as 0.61 +- 0.15 px on the wrong
# side of the blind frequency
_SMALL_GAIN = 0.3


def mirrored_frequencies(measurements: Measurements, fit: ToneFit, start: ToneFit, tried: Array) -> tuple[Array, Array]:
    """Frequencies of the strongest tones, mirrored at the nearest blind frequency on the axis with the larger residual.

    With two frames a time T apart, tones equally far above and below a blind frequency ``j / T`` have the same gain and
    differ only within a frame. The fit, refined from ``start``, may be at the wrong side. The result has frequencies
    (B, A, 1) in Hz and the axes (B, A) that are mirrored, at most one of each stack, where ``tried`` (B, A) is false:
    those with a residual of three standard deviations in the typical row, and with frequencies that a frame does not
    resolve.
    """
    strongest = strongest_only(fit)
    residual = without_nan(median(measurements.sizes(residual_of(measurements, fit)), 1), 0.0)  # (B, A)
    exposure_starts = measurements.exposure_starts
    duration = (exposure_starts.max(1) - exposure_starts.min(1)).max(-1)[:, None]
    interval = measurements.interval[:, None]
    frequency = strongest_only(start).frequencies[..., 0]
    mirrored = 2 * (frequency * interval).round() / interval - frequency
    unresolved = (np.abs(mirrored - frequency) * duration < 0.35) & (mirrored > 0) & strongest.active[..., 0]
    poor = (residual > 3.0) & (residual == residual.max(-1, keepdims=True))
    where = unresolved & ~tried & (poor | _is_nearly_blind(fit, interval[0]))
    if exposure_starts.shape[2] > 2:
        where = np.zeros_like(where)
    return np.where(where, mirrored, strongest.frequencies[..., 0])[..., None], where


def _is_nearly_blind(fit: ToneFit, intervals: Array) -> Array:
    """(B, A) bool, whether the strongest tone of an axis has a small gain: its mirrored frequency is near it."""
    strongest = strongest_only(fit)
    return strongest.active[..., 0] & (offset_gain(strongest.frequencies, intervals)[..., 0] < _SMALL_GAIN)


def with_better(result: FittedRows, other: FittedRows, index: Array) -> FittedRows:
    """The result of a batch, with the ``other`` result of its stacks ``index`` where that fits better.

    A fit is better if its residual of the typical row is smaller or the only one known, and it was not abandoned.
    """
    size = without_nan(typical_size(result.measurements, result.fit)[index], np.inf)
    better = np.flatnonzero((typical_size(other.measurements, other.fit) < size) & ~other.abandoned)
    return replace(_with_stacks(result, take_stacks([other], better), index[better]), abandoned=result.abandoned)
