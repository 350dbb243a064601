"""Search for another timing that a stack agrees with: frame period, readout direction, scan axis, lost frame.

The measurements of an attempt propose timings, and a detection with each of them decides. It does not prove the value:
a tone has the same phase after 1 / f more, so that several frame periods may agree.

1. The rows of a frame and the phase from frame to frame agree with one frame period. ``measured_period`` computes it
   from the fitted tones, to first order.
2. Where rows contradict the tones, ``searched_period`` finds the frame period or the readout direction with which one
   tone along each axis explains them, ``first_after_gap`` the place of a lost frame.
3. With the wrong scan axis, the halves of a row are exposed at different times and move apart.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import replace

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.pipeline import Attempt, Hypothesis, attempt
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.start import FieldScale
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements, residual_of
from rsvib_torch.detection.tones.selection import find_tones, robust_fit, typical_size
from rsvib_torch.detection.tones.uncertainty import linearised
from rsvib_torch.detection.verdict import contradicted_axes, halves_move_apart
from rsvib_torch.frames.prepare import GreyFrames
from rsvib_torch.motion.timing import RowTiming, SensorTiming, with_lost_frame
from rsvib_torch.numerics.tables import Array, median, split_axis, table, take_stacks
from rsvib_torch.registration.register import fits_frame
from rsvib_torch.results.reason import Reason

# timings of a stack, each of which takes a detection: 33 stacks agreed with the first to the third one, none with later
_MAX_TRIED = 3


def other_timings(stacks: GreyFrames, timing: SensorTiming, previous: Attempt) -> dict[int, Reason]:
    """The reasons against all axes of stacks that agree with another timing than the attempt, by their index."""
    if previous.fitted.refined is None:
        return {}
    rotates = halves_move_apart(previous.fitted.refined.other_motion).tolist()
    diagnoses = (
        _diagnosis(stacks.one(index), timing, previous, index, rotates=rotates[index]) for index in range(len(rotates))
    )
    return {index: diagnosis for index, diagnosis in enumerate(diagnoses) if diagnosis is not None}


def _diagnosis(
    stack: GreyFrames, timing: SensorTiming, previous: Attempt, index: int, *, rotates: bool
) -> Reason | None:
    """``other_timings`` for one stack; ``rotates``: whether the halves of its rows move apart."""
    # 1. The axes whose rows contradict the stated timing; if there are none, the axes with no reason but their tones.
    findings = previous.findings[index][:2]
    contradicted = contradicted_axes(findings)
    concerned = contradicted
    if not any(contradicted):
        concerned = [{reason.code for reason in reasons} <= {"tones_alias"} for reasons in findings]
    if not any(concerned):
        return None
    # 2. The first of the candidates with which detection is reliable along these axes. Tones that are found with one of
    # them may agree with a better one.
    candidates, num_tried = _candidates(stack, timing, previous, index, any(contradicted), rotates=rotates), 0
    while candidates and num_tried < _MAX_TRIED:
        candidate, num_tried = candidates.pop(0), num_tried + 1
        reordered, row_timing = stack.with_timing(candidate), candidate.in_row_order()
        scale = FieldScale(2, reordered.images.shape[-1], reordered.images.shape[-2])
        result = attempt(reordered, row_timing, previous.options, Hypothesis(scale, is_doubtful=True))
        if result.abandoned[0]:
            continue
        starts = table(candidate.frame_starts(stack.images.shape[1]))
        better = measured_period(result.fitted.measurements, result.fitted.fit, starts)
        if better is not None:
            candidates += _with_period(candidate, better, reordered.images.shape[-2])
            continue
        expected = concerned if candidate.scan_axis == timing.scan_axis else concerned[::-1]
        if not any(against and axis for against, axis in zip(result.findings[0], expected, strict=True)):
            return _between(timing, candidate)
    return None


def _candidates(
    stack: GreyFrames, timing: SensorTiming, previous: Attempt, index: int, contradicted: bool, *, rotates: bool
) -> list[SensorTiming]:
    """Timings with which one stack may agree; ``contradicted``: whether its rows contradict the stated one."""
    num_frames, height, width = stack.images.shape[1:]
    candidates: list[SensorTiming] = []
    if num_frames > 2:
        selection, starts = np.array([index]), table(timing.frame_starts(num_frames))
        measurements = take_stacks([previous.fitted.measurements], selection)
        fit = take_stacks([previous.fitted.fit], selection)
        candidates += _with_period(timing, measured_period(measurements, fit, starts), height)
        if contradicted:
            row_timing = timing.in_row_order()
            factor = searched_period(measurements, row_timing, starts)
            candidates += _with_period(timing, factor, height)
            if factor is None and timing.frame_start_times is None:
                frame = first_after_gap(take_stacks([previous.start.measurements], selection), row_timing, starts)
                candidates += [] if frame is None else [with_lost_frame(timing, num_frames, frame)]
    if contradicted and rotates and width <= timing.frame_rows and fits_frame(width, height, previous.options.bands):
        candidates.append(replace(timing, scan_axis="x" if timing.scan_axis == -2 else "y"))
    return candidates


def _with_period(timing: SensorTiming, factor: float | None, height: int) -> list[SensorTiming]:
    """A timing with a multiple of the frame period, or with reversed readout for a factor of -1, if it is possible."""
    if factor is None:
        return []
    if factor < 0:
        return [replace(timing, readout_direction="reverse" if timing.readout_direction == "forward" else "forward")]
    if timing.frame_start_times is not None:
        times = {name: getattr(timing, name) * factor for name in ("frame_rows", "exposure_rows")}
        return [replace(timing, row_time=timing.row_time / factor, **times)]
    rows = factor * timing.frame_rows
    return [replace(timing, frame_rows=rows)] if rows >= max(height, timing.exposure_rows) else []


def _between(declared: SensorTiming, agreeing: SensorTiming) -> Reason:
    """The reason that two timings differ; another row time also changes what is counted in rows."""
    for setting in ("readout_direction", "scan_axis"):
        values = {"stated": declared.to_dict()[setting], "agreeing": agreeing.to_dict()[setting]}
        if values["stated"] != values["agreeing"]:
            return Reason(f"other_{setting}", details=values)
    if declared.frame_start_times is None and agreeing.frame_start_times is not None:
        first = int(np.diff(agreeing.frame_start_times).argmax())
        return Reason("other_frame_times", details={"before": first, "after": first + 1})
    if declared.row_time != agreeing.row_time:
        return Reason("other_row_time", None, declared.row_time, agreeing.row_time)
    frame_rate = declared.frame_rate
    details = {"frame_rate": frame_rate, "row_time": 1 / (frame_rate * agreeing.frame_rows)}
    return Reason("other_frame_rows", None, declared.frame_rows, agreeing.frame_rows, details)


# Frame period of the fitted tones

# standard deviations, relative change of the frame period with which tones explain the rows better, from which on it is
# tried: of 121 stacks with right timing, 2.7 standard deviations at most, rms 0.9; smaller changes do not matter
_SIGNIFICANT, _SMALLEST = 3.5, 0.005


def measured_period(measurements: Measurements, fit: ToneFit, starts: Array) -> float | None:
    """Factor of the frame ``starts`` with which the tones of a fit explain the rows better, to first order.

    The measurements and the fit are those of one stack. None if the stated times explain them as well.
    """
    small = 1e-4
    later = small * (starts - starts.mean())[_frame_of_rows(measurements, starts)]
    above, below = (
        model_displacements(replace(measurements, exposure_starts=measurements.exposure_starts + delay), fit)
        for delay in (later, -later)
    )
    total = precision = chi_square = 0.0
    for axis, problem in linearised(measurements, fit)[:2]:
        response, _ = problem.unexplained((above - below)[..., axis, None] / (2 * small), axis)
        total += float((response[..., 0] * problem.residual).sum())
        precision += float(np.square(response).sum())
        chi_square += float(np.square(problem.residual).sum())
    change = total / max(precision, 1e-300)
    unexplained = max(1 - total * change / max(chi_square, 1e-300), 0.0)  # share of the square of the residual
    std = math.sqrt(unexplained / max(precision, 1e-300))
    return 1 + change if max(_SIGNIFICANT * std, _SMALLEST) < abs(change) < 0.5 else None


def _frame_of_rows(measurements: Measurements, starts: Array) -> Array:
    """Frame of each measured row, from the start times of the frames."""
    return np.maximum(np.searchsorted(starts, measurements.exposure_starts, side="right"), 1) - 1


# One tone along each axis with other start times of frames

_ITERATIONS = 5  # of fits; most factors are wrong, and their fits converge slowly


def _with_starts(
    measurements: Measurements, timing: RowTiming, starts: Array, other_starts: Array, frequencies: Array | None = None
) -> tuple[Measurements, ToneFit]:
    """Measurements of one stack with F ``other_starts`` (F, T) instead of its frame ``starts`` (T,), and their fits.

    The fits have one tone along each axis. They start at ``frequencies`` (F, A, 1) in Hz; None searches for them.
    """
    trial = measurements.repeated(len(other_starts))
    delays = (other_starts - starts)[np.arange(len(other_starts))[:, None, None], _frame_of_rows(trial, starts)]
    trial = replace(trial, exposure_starts=trial.exposure_starts + delays)
    if frequencies is None:
        interval = max(BLOCK_ROWS * timing.row_time, 0.5 * timing.exposure_time)
        return trial, find_tones(trial, interval, 1, stretches=False, iterations=_ITERATIONS)
    return trial, robust_fit(trial, frequencies, np.ones_like(frequencies, dtype=bool), iterations=_ITERATIONS)[0]


_ROWS = (32, 128)  # measured rows that are used in the search and its refinement; more rows take longer only
_SHORTEST, _LONGEST, _STEP = 0.8, 1.5, 0.02  # frame periods that are tried, over the stated one
_LEVELS, _POINTS = 4, 9  # refinement of the best one, each level in steps four times smaller
# of the square of the residual with the stated timing: 41 correct alternatives reached 0.1 or less after the first
# level. Of 17 wrong ones between 0.2 and 0.5, detection agreed with none
_SMALLER = 0.2
_MINIMA, _EQUAL = 4, 4.0  # minima that are refined, and their squared residual over the least to count as equal


def searched_period(measurements: Measurements, timing: RowTiming, starts: Array) -> float | None:
    """Factor c of the frame start times with which one tone along each axis explains the measurements best.

    A row ``i`` of frame ``p`` starts its exposure at ``c s_p + i row_time``: the rows of a frame and the phase from
    frame to frame must agree with the same frequency, which determines c. Reversed readout is c = -1, because a
    vibration in reversed time is a vibration. The measurements are those of one stack of at least three frames.

    Returns:
        c, 0.8 to 1.5, or -1; None if none explains the displacements clearly better than 1.
    """

    def fits(factors: Array, rows: int, frequencies: Array | None = None) -> tuple[Array, Array]:
        """Squared residuals of fits of one tone along each axis, and their frequencies, for each factor."""
        thinned = measurements.of_rows(slice(None, None, max(1, measurements.exposure_starts.shape[1] // rows)))
        other_starts = starts[0] + factors[:, None] * (starts - starts[0])
        trial, fit = _with_starts(thinned, timing, starts, other_starts, frequencies)
        return typical_size(trial, fit), fit.frequencies

    # 1. The stated timing, reversed readout, and other frame periods on a coarse grid.
    coarse = np.arange(_SHORTEST, _LONGEST, _STEP)
    sizes, frequencies = fits(np.concatenate([[1.0, -1.0], coarse]), _ROWS[0])
    (declared_size, reversed_size), sizes, frequencies = sizes[:2], sizes[2:], frequencies[2:]
    if reversed_size < min(sizes.min(), _SMALLER * declared_size):
        return -1.0
    # 2. The best minima of the grid, each refined in steps four times smaller.
    inner = (sizes[1:-1] < sizes[:-2]) & (sizes[1:-1] < sizes[2:])
    minima = sorted(np.flatnonzero(inner) + 1, key=sizes.__getitem__)[:_MINIMA]
    if not minima:
        return None
    factors, frequencies, step = coarse[minima], frequencies[minima], _STEP
    for _ in range(_LEVELS):
        trials = factors[:, None] + step * np.linspace(-1.0, 1.0, _POINTS)
        sizes, trial_frequencies = fits(trials.ravel(), _ROWS[1], np.repeat(frequencies, _POINTS, 0))
        sizes, trial_frequencies = sizes.reshape(trials.shape), split_axis(trial_frequencies, 0, *trials.shape)
        best = np.arange(len(trials)), sizes.argmin(1)
        least, factors, frequencies = sizes[best], trials[best], trial_frequencies[best]
        step /= 4.0
        if (least >= _SMALLER * declared_size).all():
            return None
    # 3. A tone has the same phase after 1 / f more, so that several frame periods may agree: the factor nearest to 1 is
    # the most probable.
    distance = np.where(least <= _EQUAL * least.min(), np.abs(factors - 1.0), np.inf)
    nearest = int(distance.argmin())
    if least[nearest] >= _SMALLER * declared_size:
        return None
    return float(factors[nearest])


# of the square of the residual of the bands with the stated times. Of 215 recordings with a lost frame, whose motion
# was drawn with up to three tones along each axis, 54 are diagnosed, all of them at the right frame
_SMALLER_OF_BANDS = 0.5


def first_after_gap(bands: Measurements, timing: RowTiming, starts: Array) -> int | None:
    """The frame before which a frame was lost, if one tone along each axis then explains the offsets of row bands.

    Rows are not measured in the frames on one side of the gap if the motion around which they are measured is that of
    the other side. The offsets are those of the pairs of consecutive frames of one stack.
    """
    pairs = len(starts) - 1
    frames = np.arange(pairs + 1)
    other_starts = starts + timing.frame_period * ((frames >= frames[:, None]) & (frames[:, None] > 0))
    trial, fit = _with_starts(bands, timing, starts, other_starts)
    sizes = median(split_axis(trial.sizes(residual_of(trial, fit)), 1, pairs, -1), 2)  # (F, P, A)
    declared_size, *sizes_with_gap = np.nanmean(np.square(sizes), (1, 2))
    best = int(np.argmin(sizes_with_gap))
    return best + 1 if sizes_with_gap[best] < _SMALLER_OF_BANDS * declared_size else None
