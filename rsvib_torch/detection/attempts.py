"""The hypotheses that detection tries, one after the other.

1. The motion is a translation: all columns of a row are displaced alike.
2. If the halves of the rows move apart as roll and zoom cause it, or if roll and zoom are requested: a motion with
   roll and zoom. All stacks of a batch then have these components.
3. If only the halves of the rows move apart: each half by itself. Halves at unequal distances move apart uniformly
   (parallax) and vibrate alike, which confirms the translation.
4. If the tones of the translation do not explain the rows: another timing (``other_timings``), which then is the reason
   against the axes. ``period_factor`` finds the frame period or the readout direction with which one tone along each
   axis explains the measured displacements of the rows, and a detection with that timing confirms it. The vibration is
   that of the stated timing.

The findings of an attempt (``pipeline``) decide whether the next hypothesis is tried, and whether it was abandoned,
whether it is accepted.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import replace

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.pipeline import Attempt, DetectionOptions, Hypothesis, attempt
from rsvib_torch.detection.result import DetectionResult, assembled
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.start import FieldScale, strips_fit
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements, tone_displacements
from rsvib_torch.detection.tones.selection import MIN_SIGNIFICANCE, find_tones, robust_fit, typical_size
from rsvib_torch.detection.tones.uncertainty import linearised
from rsvib_torch.detection.verdict import contradicted_axes, halves_move_apart, rotation_possible
from rsvib_torch.frames.prepare import GreyFrames
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.numerics.tables import Array, split_axis, table, take_stacks
from rsvib_torch.registration.register import fits_frame
from rsvib_torch.results.reason import Reason


def detect_tones(
    stacks: GreyFrames, timing: SensorTiming, options: DetectionOptions, axes: tuple[int, int], camera: Camera | None
) -> DetectionResult:
    """Detect the tones of B stacks, with as many components as were requested or as the frames require.

    ``axes`` are the numbers of components that are measured in any case, and at most; the camera is in row order.
    """
    height, width = stacks.images.shape[-2:]
    row_timing, num_frames = timing.in_row_order(), stacks.images.shape[1]

    # 1. Translation.
    translation = attempt(stacks, row_timing, options, Hypothesis(FieldScale(2, width, height)))

    # 2. Roll and zoom, if they may be the cause of what the translation of any stack does not explain. A requested
    # component is measured in any case; frames that are too narrow for strips of columns are refused by an error then.
    least_axes, most_axes = axes
    refined = translation.fitted.refined
    requested = camera is not None or least_axes > 2
    possible = False
    if refined is not None and most_axes > 2 and strips_fit(height, width, options.bands):
        possible = bool(rotation_possible(refined.other_motion, refined.uneven, height / width).any())
    if requested or possible:
        hypothesis = Hypothesis(
            FieldScale(most_axes, width, height, camera),
            is_doubtful=not requested,
            translation=translation.fit,
        )
        rotation = attempt(stacks, row_timing, options, hypothesis)
        if requested or not rotation.abandoned.all():  # parallax otherwise
            moving = _moving_axes(rotation, least_axes)
            if requested or moving > 2:
                return _assembled(rotation, timing, num_frames).with_axes(moving)

    # 3. The same vibration of both halves.
    translation = _without_parallax(stacks, row_timing, options, translation)

    # 4. Another timing, for stacks whose rows the tones do not explain. The axes of a stack have one timing: of 9
    # reliable axes beside a contradicted one, 3 were wrong.
    result = _assembled(translation, timing, num_frames)
    reliable, findings = result.reliable.clone(), list(result.findings)
    for index, reason in other_timings(stacks, timing, translation).items():
        reliable[index] = False
        findings[index] = tuple((reason, *of_axis) for of_axis in findings[index])
    return replace(result, reliable=reliable, findings=tuple(findings))


def _assembled(found: Attempt, timing: SensorTiming, num_frames: int) -> DetectionResult:
    """The results of an attempt in image axes."""
    fitted = found.fitted
    return assembled(
        found.fit,
        found.std,
        found.std_if_hidden_tone,
        (fitted.offsets, fitted.predicted),
        found.findings,
        timing,
        scale=found.scale,
        num_frames=num_frames,
        interval=found.interval,
        blur=None if fitted.refined is None else fitted.refined.other_motion.blur,
    )


# -, px; differences between displacements of a half and of the whole. Of 16 recordings with parallax, 5 were accepted
# with these limits, none wrong. They and those that chose the limits are the same
_MAX_UNLIKE, _MAX_UNLIKE_PX = 0.01, 0.01


def _without_parallax(stacks: GreyFrames, timing: RowTiming, options: DetectionOptions, found: Attempt) -> Attempt:
    """The attempt without the reason that the halves of the rows move apart, for stacks whose halves vibrate alike.

    Roll moves the halves of a row apart along y and zoom along x, so that their tones differ. A uniform roll or zoom
    displaces the rows by an amount that is repeated in each frame, which no tone explains in three frames.
    """
    num_frames, height, width = stacks.images.shape[1:]
    half = width // 2
    if found.fitted.refined is None or num_frames < 3 or not fits_frame(height, half, options.bands):
        return found
    row_starts = table(timing.row_starts(num_frames, height)[:, ::8].flatten())
    findings = list(found.findings)
    for index, against in enumerate(found.findings):
        # 1. Stacks that are refused along an axis for this reason only.
        if not any({reason.code for reason in of_axis} == {"halves_apart"} for of_axis in against):
            continue
        # 2. Each half must be reliable along both axes, with the displacements of the whole.
        stack = stacks.one(index)
        whole = tone_displacements(found.fit, row_starts, timing.exposure_time)[index]
        allowed = np.maximum(_MAX_UNLIKE * whole.std(0), _MAX_UNLIKE_PX)
        for part in (slice(0, half), slice(width - half, width)):
            of_half = attempt(stack.columns(part), timing, options, Hypothesis(FieldScale(2, half, height)))
            moved = tone_displacements(of_half.fit, row_starts, timing.exposure_time)[0] - whole
            if any(of_half.findings[0]) or (moved.std(0) > allowed).any():
                break
        else:
            findings[index] = tuple(
                tuple(reason for reason in of_axis if reason.code != "halves_apart") for of_axis in against
            )
    return replace(found, findings=tuple(findings))


def _moving_axes(found: Attempt, least: int) -> int:
    """Number of components up to the last one with a significant tone in any stack, at least ``least``."""
    significant = found.vibration.amplitude > MIN_SIGNIFICANCE * found.std_if_hidden_tone.amplitude
    moving = significant.any(0).any(-1).tolist()
    return max([least, *(axis + 1 for axis in range(2, len(moving)) if moving[axis])])


# Other timings


def other_timings(stacks: GreyFrames, timing: SensorTiming, found: Attempt) -> dict[int, Reason]:
    """The reasons against all axes of stacks that agree with another timing than the attempt, by index of the stack."""
    if found.fitted.refined is None:
        return {}
    diagnoses, rotates = {}, halves_move_apart(found.fitted.refined.other_motion).tolist()
    for index in range(len(found.findings)):
        diagnosis = _diagnosis(stacks.one(index), timing, found, index, rotates=rotates[index])
        if diagnosis is not None:
            diagnoses[index] = diagnosis
    return diagnoses


def _diagnosis(stack: GreyFrames, timing: SensorTiming, found: Attempt, index: int, *, rotates: bool) -> Reason | None:
    """The reason against all axes of a stack that agrees with another timing; None if it agrees with none.

    ``rotates``: whether the halves of the rows move apart.
    """
    num_frames, height, width = stack.images.shape[1:]
    findings = found.findings[index][:2]

    def with_period(stated: SensorTiming, factor: float | None) -> list[SensorTiming]:
        """The timing with a multiple of the frame period, or with reversed readout for a factor of -1."""
        if factor is None:
            return []
        if factor < 0:
            return [
                replace(stated, readout_direction="reverse" if stated.readout_direction == "forward" else "forward")
            ]
        if stated.frame_start_times is not None:
            times = {name: getattr(stated, name) * factor for name in ("frame_rows", "exposure_rows")}
            return [replace(stated, row_time=stated.row_time / factor, **times)]
        rows = factor * stated.frame_rows
        return [replace(stated, frame_rows=rows)] if rows >= max(height, stated.exposure_rows) else []

    # 1. The candidates. The rows of a frame and the phase from frame to frame agree with one period of the frames: that
    # of the fitted tones is measured; where rows contradict them, one tone along each axis is tried with other periods.
    candidates: list[SensorTiming] = []
    fitted, axes = found.fitted, contradicted_axes(findings)
    measurements = take_stacks([fitted.measurements], np.array([index]))
    fit = take_stacks([fitted.fit], np.array([index]))
    if num_frames > 2:
        candidates = with_period(timing, other_period(measurements, fit, timing.in_row_order(), num_frames))
        if any(axes):
            candidates += with_period(timing, period_factor(measurements, timing.in_row_order(), num_frames))
    # With the wrong scan axis, the halves of a row are exposed at different times and move apart.
    if any(axes) and rotates and width <= timing.frame_rows and fits_frame(width, height, found.options.bands):
        candidates.append(replace(timing, scan_axis="x" if timing.scan_axis == -2 else "y"))

    # 2. The first one with which detection is reliable along the axes that contradict the stated timing, or, if only
    # the tones do, along all that are refused for nothing else; its own tones may agree with a better one.
    concerned = axes if any(axes) else [{reason.code for reason in one} <= {"tones_alias"} for one in findings]
    if not any(concerned):
        return None
    for candidate in candidates:
        turned, row_timing = stack.with_timing(candidate), candidate.in_row_order()
        scale = FieldScale(2, turned.images.shape[-1], turned.images.shape[-2])
        other = attempt(turned, row_timing, found.options, Hypothesis(scale, is_doubtful=True))
        if other.abandoned[0]:
            continue
        better = other_period(other.fitted.measurements, other.fitted.fit, row_timing, num_frames)
        if better is not None and len(candidates) < _MOST_TRIED:
            candidates += with_period(candidate, better)
        same = concerned if candidate.scan_axis == timing.scan_axis else concerned[::-1]
        if better is None and not any(against and axis for against, axis in zip(other.findings[0], same, strict=True)):
            return _between(timing, candidate)
    return None


def _between(stated: SensorTiming, agreeing: SensorTiming) -> Reason:
    """The reason that two timings differ; another row time also changes what is counted in rows."""
    for setting in ("readout_direction", "scan_axis"):
        values = {"stated": stated.to_dict()[setting], "agreeing": agreeing.to_dict()[setting]}
        if values["stated"] != values["agreeing"]:
            return Reason(f"other_{setting}", details=values)
    if stated.row_time != agreeing.row_time:
        return Reason("other_row_time", None, stated.row_time, agreeing.row_time)
    frame_rate = stated.frame_rate
    details = {"frame_rate": frame_rate, "row_time": 1 / (frame_rate * agreeing.frame_rows)}
    return Reason("other_frame_rows", None, stated.frame_rows, agreeing.frame_rows, details)


# Frame period

_MOST_TRIED = 5  # timings of a stack
# standard deviations, relative change of the frame period with which tones explain the rows better, from which on it is
# tried: of 121 stacks with right timing, 2.7 standard deviations at most, rms 0.9; smaller changes do not matter
_SIGNIFICANT, _SMALLEST = 3.5, 0.005


def other_period(measurements: Measurements, fit: ToneFit, timing: RowTiming, num_frames: int) -> float | None:
    """Factor of the frame start times with which the tones of a fit explain the rows better, to first order.

    The measurements and the fit are those of one stack. None if the stated times explain them as well.
    """
    starts, small = table(timing.frame_starts(num_frames)), 1e-4
    later = small * (starts - starts.mean())[_frame_of_rows(measurements, starts)]
    shifted = (replace(measurements, exposure_starts=measurements.exposure_starts + one) for one in (later, -later))
    above, below = (model_displacements(one, fit) for one in shifted)
    total = precision = chi_square = 0.0
    for axis, problem in linearised(measurements, fit)[:2]:
        response, _ = problem.unexplained((above - below)[..., axis, None] / (2 * small), axis)
        total += float((response[..., 0] * problem.residual).sum())
        precision += float(np.square(response).sum())
        chi_square += float(np.square(problem.residual).sum())
    change = total / max(precision, 1e-300)
    left = max(1 - total * change / max(chi_square, 1e-300), 0.0)  # of the square of the residual
    std = math.sqrt(left / max(precision, 1e-300))
    return 1 + change if max(_SIGNIFICANT * std, _SMALLEST) < abs(change) < 0.5 else None


def _frame_of_rows(measurements: Measurements, starts: Array) -> Array:
    """Frame of each measured row, from the start times of the frames."""
    return np.maximum(np.searchsorted(starts, measurements.exposure_starts, side="right"), 1) - 1


_ROWS = (32, 128)  # measured rows that are used in the search and its refinement; more rows take longer only
_SHORTEST, _LONGEST, _STEP = 0.8, 1.5, 0.02  # frame periods that are tried, over the stated one
_LEVELS, _POINTS = 4, 9  # refinement of the best one, each level in steps four times smaller
# of the square of the residual with the stated timing: 41 correct alternatives reached 0.1 or less after the first
# level. Of 17 wrong ones between 0.2 and 0.5, detection agreed with none
_SMALLER = 0.2
_ITERATIONS = 5  # of fits; most factors are wrong, and their fits converge slowly
_MINIMA, _EQUAL = 4, 4.0  # minima that are refined, and their squared residual over the least to count as equal


def period_factor(measurements: Measurements, timing: RowTiming, num_frames: int) -> float | None:
    """Factor c of the frame start times with which one tone along each axis explains the measurements best.

    A row ``i`` of frame ``p`` starts its exposure at ``c s_p + i row_time``: the rows of a frame and the phase from
    frame to frame must agree with the same frequency, which determines c. Reversed readout is c = -1, because a
    vibration in reversed time is a vibration. The measurements are those of one stack of at least three frames.

    Returns:
        c, 0.8 to 1.5, or -1; None if none explains the displacements clearly better than 1.
    """
    starts = table(timing.frame_starts(num_frames))
    interval = max(BLOCK_ROWS * timing.row_time, 0.5 * timing.exposure_time)

    def fits(factors: Array, rows: int, frequencies: Array | None = None) -> tuple[Array, Array]:
        """Square of the residual of one tone along each axis and its frequency, for each factor."""
        every = max(1, measurements.exposure_starts.shape[1] // rows)
        trial = measurements.of_rows(slice(None, None, every)).repeated(len(factors))
        moved = (factors[:, None, None] - 1.0) * (starts - starts[0])[_frame_of_rows(trial, starts)]
        trial = replace(trial, exposure_starts=trial.exposure_starts + moved)
        if frequencies is None:
            fit = find_tones(trial, interval, 1, stretches=False, iterations=_ITERATIONS)
        else:
            active = np.ones_like(frequencies, dtype=bool)
            fit, _ = robust_fit(trial, frequencies, active, iterations=_ITERATIONS)
        return typical_size(trial, fit), fit.frequencies

    # 1. The stated timing, reversed readout, and other frame periods on a coarse grid.
    coarse = np.arange(_SHORTEST, _LONGEST, _STEP)
    sizes, frequencies = fits(np.concatenate([[1.0, -1.0], coarse]), _ROWS[0])
    (stated, reverse), sizes, frequencies = sizes[:2], sizes[2:], frequencies[2:]
    if reverse < min(sizes.min(), _SMALLER * stated):
        return -1.0
    # 2. The best minima of the grid, each refined in steps four times smaller.
    inner = (sizes[1:-1] < sizes[:-2]) & (sizes[1:-1] < sizes[2:])
    minima = sorted(np.flatnonzero(inner) + 1, key=sizes.__getitem__)[:_MINIMA]
    if not minima:
        return None
    factors, frequencies, step = coarse[minima], frequencies[minima], _STEP
    for _ in range(_LEVELS):
        near = factors[:, None] + step * np.linspace(-1.0, 1.0, _POINTS)
        sizes, found = fits(near.ravel(), _ROWS[1], np.repeat(frequencies, _POINTS, 0))
        sizes, found = sizes.reshape(near.shape), split_axis(found, 0, *near.shape)
        best = np.arange(len(near)), sizes.argmin(1)
        least, factors, frequencies = sizes[best], near[best], found[best]
        step /= 4.0
        if (least >= _SMALLER * stated).all():
            return None
    # 3. A tone has the same phase after 1 / f more, so that several frame periods may agree: the next to 1 is probable.
    distance = np.where(least <= _EQUAL * least.min(), np.abs(factors - 1.0), np.inf)
    chosen = int(distance.argmin())
    if least[chosen] >= _SMALLER * stated:
        return None
    return float(factors[chosen])
