"""Diagnosis of a wrong setting: another timing with which the frames agree, unlike the stated one.

``period_factor`` finds the frame period or the readout direction with which one tone along each axis explains the
measured displacements of the rows. ``other_timings`` confirms it by a detection with that timing.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import replace

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.pipeline import Attempt, Hypothesis, attempt
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.strips import FieldScale
from rsvib_torch.detection.tones.fit import MotionModel
from rsvib_torch.detection.tones.selection import find_tones, robust_fit, typical_size
from rsvib_torch.detection.verdict import contradicted_axes, halves_move_apart
from rsvib_torch.frames.grey import GreyFrames
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.numerics.tables import Array, split_axis, table, take_stacks
from rsvib_torch.registration.register import fits_frame
from rsvib_torch.results.reason import Reason


def other_timings(stacks: GreyFrames, timing: SensorTiming, found: Attempt) -> dict[int, Reason]:
    """The reasons against all axes of stacks that agree with another timing than the attempt, by index of the stack."""
    if found.fitted.refined is None:
        return {}
    diagnoses, rotates = {}, halves_move_apart(found.fitted.refined.other_motion).tolist()
    for index, findings in enumerate(found.findings):
        axes = contradicted_axes(findings)
        if any(axes):
            diagnosis = _diagnosis(stacks.one(index), timing, found, index, axes, rotates=rotates[index])
            if diagnosis is not None:
                diagnoses[index] = diagnosis
    return diagnoses


def _diagnosis(
    stack: GreyFrames, timing: SensorTiming, found: Attempt, index: int, axes: list[bool], *, rotates: bool
) -> Reason | None:
    """The reason against all axes of a stack that agrees with another timing; None if it agrees with none.

    ``axes`` (x, y) in row order contradict the stated one; ``rotates``: whether the halves of the rows move apart.
    """
    num_frames, height, width = stack.images.shape[1:]
    only = slice(index, index + 1)

    # 1. The candidates, each with the frequencies of one tone of each axis if they are known. The rows of a frame and
    # the phase from frame to frame agree with one period of the frames.
    candidates: list[tuple[SensorTiming, Array | None]] = []
    measurements = take_stacks([found.fitted.measurements], np.array([index]))
    agreeing = period_factor(measurements, timing.in_row_order(), num_frames) if num_frames > 2 else None
    if agreeing is not None:
        factor, tones = agreeing
        if factor < 0:
            is_forward = timing.readout_direction == "forward"
            candidates.append((replace(timing, readout_direction="reverse" if is_forward else "forward"), tones))
        elif timing.frame_start_times is not None:
            times = {name: getattr(timing, name) * factor for name in ("frame_rows", "exposure_rows")}
            candidates.append((replace(timing, row_time=timing.row_time / factor, **times), tones))
        elif factor * timing.frame_rows >= max(height, timing.exposure_rows):
            candidates.append((replace(timing, frame_rows=factor * timing.frame_rows), tones))
    # With the wrong scan axis, the halves of a row are exposed at different times and move apart.
    if rotates and width <= timing.frame_rows and fits_frame(width, height, found.options.bands):
        candidates.append((replace(timing, scan_axis="x" if timing.scan_axis == -2 else "y"), None))

    # 2. The first one with which detection is reliable along the axes that contradict the stated timing.
    for candidate, known in candidates:
        turned, curve, bands = stack, found.start.curve, None
        if (candidate.scan_axis, candidate.readout_direction) == (timing.scan_axis, timing.readout_direction):
            bands = replace(curve, offsets=curve.offsets[only], quality=curve.quality[only])
        else:
            turned = stack.with_timing(candidate)
        scale = FieldScale(2, turned.images.shape[-1], turned.images.shape[-2])
        hypothesis = Hypothesis(scale, is_doubtful=True, known_offsets=bands, frequencies=known)
        other = attempt(turned, candidate.in_row_order(), found.options, hypothesis)
        concerned = axes if candidate.scan_axis == timing.scan_axis else axes[::-1]
        refused = any(against and axis for against, axis in zip(other.findings[0], concerned, strict=True))
        if not other.abandoned[0] and not refused:
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

_ROWS = (32, 128)  # measured rows that are used in the search and its refinement; more rows take longer only
_SHORTEST, _LONGEST, _STEP = 0.8, 1.5, 0.02  # frame periods that are tried, over the stated one
_LEVELS, _POINTS = 4, 9  # refinement of the best one, each level in steps four times smaller
# of the square of the residual with the stated timing: 41 correct alternatives reached 0.1 or less after the first
# level. Of 17 wrong ones between 0.2 and 0.5, detection agreed with none
_SMALLER = 0.2
_ITERATIONS = 5  # of fits; most factors are wrong, and their fits converge slowly
_MINIMA, _EQUAL = 4, 4.0  # minima that are refined, and their squared residual over the least to count as equal


def period_factor(measurements: Measurements, timing: RowTiming, num_frames: int) -> tuple[float, Array] | None:
    """Factor c of the frame start times with which one tone along each axis explains the measurements best.

    A row ``i`` of frame ``p`` starts its exposure at ``c s_p + i row_time``: the rows of a frame and the phase from
    frame to frame must agree with the same frequency, which determines c. Reversed readout is c = -1, because a
    vibration in reversed time is a vibration. The measurements are those of one stack of at least three frames.

    Returns:
        c, 0.8 to 1.5, or -1, and the frequencies (1, 2, 1) in Hz of the tones; None if none explains the displacements
        clearly better than 1.
    """
    starts = table(timing.frame_starts(num_frames))
    interval = max(BLOCK_ROWS * timing.row_time, 0.5 * timing.exposure_time)

    def fits(factors: Array, rows: int, frequencies: Array | None = None) -> tuple[Array, Array]:
        """Square of the residual of one tone along each axis and its frequency, for each factor."""
        every = max(1, measurements.exposure_starts.shape[1] // rows)
        trial = measurements.of_rows(slice(None, None, every)).repeated(len(factors))
        frame = np.maximum(np.searchsorted(starts, trial.exposure_starts, side="right"), 1) - 1
        moved = (factors[:, None, None] - 1.0) * (starts - starts[0])[frame]
        trial = replace(trial, exposure_starts=trial.exposure_starts + moved)
        if frequencies is None:
            fit = find_tones(trial, interval, 1, stretches=False, iterations=_ITERATIONS)
        else:
            active = np.ones_like(frequencies, dtype=bool)
            fit, _ = robust_fit(trial, frequencies, active, MotionModel(), iterations=_ITERATIONS)
        return typical_size(trial, fit), fit.frequencies

    # 1. The stated timing, reversed readout, and other frame periods on a coarse grid.
    coarse = np.arange(_SHORTEST, _LONGEST, _STEP)
    sizes, frequencies = fits(np.concatenate([[1.0, -1.0], coarse]), _ROWS[0])
    (stated, reverse), reversed_tones, sizes, frequencies = sizes[:2], frequencies[1:2], sizes[2:], frequencies[2:]
    if reverse < min(sizes.min(), _SMALLER * stated):
        return -1.0, reversed_tones
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
    return float(factors[chosen]), frequencies[chosen : chosen + 1]
