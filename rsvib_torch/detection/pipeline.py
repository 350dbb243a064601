"""One attempt to detect the vibration of B stacks, under one hypothesis on the motion and the timing.

``attempt`` reads from top to bottom: start, fit, uncertainty, verdict. It works in row order, with all components of
the motion in px. It does not raise an error if the hypothesis is wrong, but states for which stacks.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.refinement import FittedRows, refine, with_better
from rsvib_torch.detection.result import offset_curve
from rsvib_torch.detection.rows.displacements import MAX_GROUP_FRAMES, compared_intervals
from rsvib_torch.detection.rows.grouped_frames import GroupedStrips, grouped_frames, grouped_strips
from rsvib_torch.detection.start import BandStart, FieldScale, band_start, field_start
from rsvib_torch.detection.tones.fit import (
    ToneFit,
    displacement_std,
    motion_of_fit,
    residual_of,
    shrunk,
    tone_displacements,
)
from rsvib_torch.detection.tones.selection import LONG_GAP, find_tones, with_best_cycles
from rsvib_torch.detection.tones.uncertainty import (
    with_further_tones,
    with_unknown_amplitudes,
    with_unknown_image_motion,
    without_aliasing,
)
from rsvib_torch.detection.verdict import Findings, compared_bands, judged, scene_reasons, with_common_reasons
from rsvib_torch.frames.prepare import GreyFrames
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd, blind_frequencies
from rsvib_torch.numerics.tables import Array, table, tables, take_stacks
from rsvib_torch.options import MAX_TONES, DetectionMethod, RegistrationOptions
from rsvib_torch.registration import OffsetCurve


@dataclass(frozen=True)
class DetectionOptions:
    """Options of all attempts."""

    method: DetectionMethod  # how tones are fitted
    tones: int | None  # number of tones of each axis; None to select it by significance
    drift_order: int  # of the image motion: 1 for a uniform one, 2 for a uniformly accelerated one
    bands: RegistrationOptions  # registration of the row bands

    @property
    def max_tones(self) -> float:
        """Largest number of tones that are tried on an axis; infinite if the number is given."""
        return MAX_TONES if self.tones is None else math.inf


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Assumptions of an attempt on the motion, and the result of an earlier attempt."""

    scale: FieldScale  # components of the motion
    # whether the motion is assumed only because something contradicts a simpler one: roll and zoom because the halves
    # of the rows move apart, another timing because tones do not explain the rows. The attempt is then abandoned early
    # if a large residual remains.
    is_doubtful: bool = False
    translation: ToneFit | None = None  # fit without roll and zoom, from which a fit with roll or zoom starts


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of a method of detection."""

    fit: ToneFit  # the fit of all B stacks, with the covariance of its parameters
    measurements: Measurements  # the measurements with the weights of the fit
    offsets: OffsetCurve  # the same as offsets (B, P, N, A) between consecutive frames
    predicted: Array  # (B, P, N, A) px, the offsets that the fit predicts
    refined: FittedRows | None = None  # the complete result of the direct method; None if the fit is to bands


@dataclass(frozen=True, eq=False)
class Attempt:
    """Result of an attempt, for B stacks in row order."""

    options: DetectionOptions  # the options
    scale: FieldScale  # components of the motion
    start: BandStart  # offsets of the row bands
    fitted: Fitted  # measurements and the fit to them
    fit: ToneFit  # the same with all uncertainties in its covariance, also those of ``std_if_hidden_tone``
    vibration: Vibration  # its vibration, in px
    std: VibrationStd  # standard deviations of the vibration, in px, given the tones that were found
    std_if_hidden_tone: VibrationStd  # the same with the allowance for a further tone
    findings: tuple[Findings, ...]  # for each stack and each axis the reasons against it
    interval: float  # seconds between the first two frames

    @property
    def abandoned(self) -> Array:
        """(B,) bool, stacks for which the hypothesis is wrong."""
        refined = self.fitted.refined
        return np.zeros_like(self.fit.centre, dtype=bool) if refined is None else refined.abandoned

    @property
    def visible(self) -> Array:
        """(B,) bool, stacks of which rows or bands were measured."""
        return np.any(self.fitted.measurements.weights > 0, (1, 2))


def attempt(stacks: GreyFrames, timing: RowTiming, options: DetectionOptions, hypothesis: Hypothesis) -> Attempt:
    """Detect the vibration of B stacks under a hypothesis; the sensor is in row order."""
    directly, scale = options.method == "direct", hypothesis.scale
    num_frames, height = stacks.images.shape[1:3]

    # 1. Start: the offsets of row bands between consecutive frames, and the tones that are known.
    if scale.same_for_all_columns:
        start = band_start(stacks, timing, options.bands, mere_start=directly)
    else:
        start = field_start(stacks, timing, options.bands, scale, hypothesis.translation)

    # 2. Fit: tones and image motion, to the bands or to the rows.
    fitted = fit_directly(start, stacks, timing, options, hypothesis) if directly else fit_bands(start, timing, options)

    # 3. Uncertainty: errors that the residual does not show. Aliasing biases the displacements, and the record may
    # contain a further tone. The displacement is computed for every eighth row of all frames.
    intervals = compared_intervals(timing, num_frames, MAX_GROUP_FRAMES if directly else 2)
    row_starts = table(timing.row_starts(num_frames, height)[:, ::8].flatten())
    measurements, fit, refined = fitted.measurements, fitted.fit, fitted.refined
    gaps = table(timing.frame_starts(num_frames).diff())
    if len(gaps) and gaps.max() > LONG_GAP * gaps.min():
        fit = with_best_cycles(measurements, fit, float(gaps.max()))
    if refined is not None:
        fit = without_aliasing(measurements, fit, refined.aliasing)
        unexplained, span = refined.other_motion.unexplained, measurements.span
        fit = with_unknown_amplitudes(fit, refined.aliasing, unexplained, intervals, timing.exposure_time, span=span)
    known_std = displacement_std(fit, row_starts, timing.exposure_time)
    fits = [*with_further_tones(measurements, fit, row_starts, number_is_known=options.tones is not None)]
    interval = float(intervals[0])
    if refined is not None:
        fits = [with_unknown_image_motion(fit, interval, timing.exposure_time) for fit in fits]
    (vibration, std), (_, std_if_hidden_tone) = (fit.vibration() for fit in fits)
    fit = fits[1].fit

    # 4. Verdict: for each axis, the reasons against it, from the rows or the bands that the vibration was fitted to.
    findings = judged(
        vibration,
        std_if_hidden_tone,
        _band_offsets(start, fit, options, height) if refined is None else refined.other_motion,
        intervals=intervals,
        displacement=tone_displacements(fit, row_starts, timing.exposure_time).std(1),
        known_std=known_std,
        timing=timing,
        max_tones=options.max_tones,
        radius=scale.radius,
    )
    if scale.same_for_all_columns:
        findings = tuple(map(with_common_reasons, scene_reasons(start.curve, scale.width), findings))
    return Attempt(options, scale, start, fitted, fit, vibration, std, std_if_hidden_tone, findings, interval)


def _band_offsets(start: BandStart, fit: ToneFit, options: DetectionOptions, height: int) -> dict[str, Array]:
    """``compared_bands`` of the offsets of the row bands and of those that a fit predicts."""
    (offsets, rows), predicted = tables(start.curve.offsets, start.curve.rows), start.predicted(fit)
    # an image motion may carry bands out of the later frame
    later, half = rows + predicted[..., 1], 0.5 * options.bands.band_rows
    visible = (later >= half) & (later <= height - 1 - half)
    flat = (len(offsets), -1, offsets.shape[-1])
    return compared_bands(offsets.reshape(flat), predicted.reshape(flat), visible.reshape(flat[:2]))


# Methods of detection


def fit_bands(start: BandStart, timing: RowTiming, options: DetectionOptions) -> Fitted:
    """The paper's method: tones are fitted to the offsets of row bands."""
    fit = _tones_of_bands(start, timing, options)
    weighted = start.measurements.reweighted(residual_of(start.measurements, fit))
    return Fitted(fit, weighted, start.curve, start.predicted(fit))


def fit_directly(
    start: BandStart, stacks: GreyFrames, timing: RowTiming, options: DetectionOptions, hypothesis: Hypothesis
) -> Fitted:
    """The fit to bands, refined on the images row by row."""
    # The gradients of rows reach a few tenths of a pixel, so that a start with an error of 0.15 px converges.
    fit = _tones_of_bands(start, timing, options, accuracy=0.15)
    intervals = compared_intervals(timing, stacks.images.shape[1])
    motion = motion_of_fit(shrunk(fit, intervals), stacks.images.device)
    scale, doubtful = hypothesis.scale, hypothesis.is_doubtful
    if scale.same_for_all_columns:
        frames = grouped_frames(stacks.images, stacks.valid, timing, motion)
    else:  # pairs take several times as long, and are not needed to show that there is no roll
        frames = grouped_strips(stacks.images, stacks.valid, timing, motion, scale, pairs=not doubtful)
    refined = refine(frames, intervals, fit, options.tones, may_abandon=doubtful)
    # The offsets of bands that move within their height contain twice the frequency of a tone. It may be fitted by a
    # nearly blind tone larger than the frame (3 of 200 recordings in four and eight frames), or no tone may be found (1
    # of 60 in two frames, with another axis that was wrong). Where rows contradict the fit, one tone per axis is tried.
    contradicted = ~refined.other_motion.explained & ~refined.abandoned
    if options.tones is None and contradicted.any():
        index = np.flatnonzero(contradicted)
        single = _tones_of_bands(start, timing, replace(options, tones=1), accuracy=0.15)
        again = refine(frames.stacks(index), intervals, take_stacks([single], index), None, may_abandon=doubtful)
        explained = np.flatnonzero(again.other_motion.explained)
        if len(explained):
            refined = with_better(refined, take_stacks([again], explained), index[explained])
    # Roll and zoom that were confirmed are fitted again in pairs, if the exposures blur the frames differently, and in
    # narrower strips, if the start did not show them: roll of 2 mrad in 256 columns had a bias of 0.4 %.
    if isinstance(frames, GroupedStrips) and not bool(refined.abandoned.all()):
        motion = motion_of_fit(shrunk(refined.fit, intervals), stacks.images.device)
        if not frames.suits(motion) or (doubtful and frames.differently_blurred(motion).any()):
            frames = grouped_strips(stacks.images, stacks.valid, timing, motion, scale)
            refined = replace(refine(frames, intervals, refined.fit, options.tones), abandoned=refined.abandoned)
    group_frames = [group.size for group in refined.frames.groups for _ in range(group.count)]
    curve = offset_curve(refined.measurements, refined.fit, refined.robust_weights, group_frames, stacks.images.device)
    return Fitted(refined.fit, refined.measurements, *curve, refined)


def _tones_of_bands(start: BandStart, timing: RowTiming, options: DetectionOptions, accuracy: float = 0.0) -> ToneFit:
    """Tones and image motion of the offsets of row bands; further tones until residuals are below ``accuracy`` px."""
    interval = options.bands.band_step * timing.row_time
    blind = table(blind_frequencies(timing, 0.5 / interval))
    tones, order = options.tones, options.drift_order
    return find_tones(start.measurements, interval, tones, order, start=start.fit, blind=blind, accuracy=accuracy)
