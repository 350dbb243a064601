"""Row time from frames whose motion is a sum of tones.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from rsvib_torch.detection.measurements import Measurements, OtherMotion
from rsvib_torch.detection.refinement import refine
from rsvib_torch.detection.rows.displacements import compared_intervals
from rsvib_torch.detection.rows.grouped_frames import grouped_frames
from rsvib_torch.detection.start import band_curve, measurements_of_curve
from rsvib_torch.detection.tones.fit import MotionModel, ToneFit, fit_tones, motion_of_fit, residual_of, shrunk
from rsvib_torch.detection.tones.selection import robust_fit
from rsvib_torch.detection.tones.uncertainty import linearised
from rsvib_torch.detection.verdict import residual_reasons, with_remedy
from rsvib_torch.frames.grey import GreyFrames
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.numerics.tables import Array, table, tensor
from rsvib_torch.options import MAX_TONES, RegistrationOptions
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason
from rsvib_torch.row_time.row_tones import (
    MAX_CHI_SQUARE,
    Candidate,
    FramePlaces,
    RowRecord,
    RowTimeFit,
    RowTones,
    candidates,
    find_row_tones,
    fit_row_tones,
)

MAX_STARTS = 5  # row times that are tried; of 8 random pairs of tones, 2 need a second
# Chi-square of the frequencies of tones per row and per frame at a row time. Of 78 recordings whose row time was within
# the limits, at most 5.5 for the bands and 8.9 for the rows; of 5 with a wrong result within wrong limits, 32 and more
_MAX_CONTRADICTION = 20.0


@dataclass(frozen=True)
class CameraClock:
    """What is known about the timing of a camera."""

    period: float  # frame period in s
    num_rows: int  # rows of a frame
    low: float  # shortest possible row time in s
    high: float  # longest possible row time in s
    directions: tuple[float, ...]  # possible readout directions: 1.0 forward, -1.0 reverse
    exposure_time: float | None  # in s; None if unknown

    def timing(self, row_time: float, exposure_time: float | None = None) -> RowTiming:
        """Timing in row order with a row time, whose sign is its direction."""
        size = abs(row_time)
        exposure = exposure_time or self.exposure_time or size
        return RowTiming(size, exposure / size, max(self.period / size, self.num_rows))

    def allows(self, row_time: float) -> bool:
        """Whether a signed row time in s is possible."""
        return self.low <= abs(row_time) <= self.high and math.copysign(1.0, row_time) in self.directions


def turned(stack: GreyFrames, direction: float) -> GreyFrames:
    """The frames with their rows in readout order."""
    if direction > 0:
        return stack
    return replace(stack, images=stack.images.flip(-2), valid=None if stack.valid is None else stack.valid.flip(-2))


def bands_of_frames(
    stack: GreyFrames, clock: CameraClock, options: RegistrationOptions
) -> tuple[OffsetCurve, FramePlaces]:
    """Offsets of the row bands of one stack, and their frame rows; they do not depend on the row time."""
    timing = clock.timing(clock.high)
    curve = band_curve(stack.images, stack.valid, timing, options, mere_start=True)
    pairs, count = curve.quality.shape[1:]
    rows = torch.stack([curve.rows.expand(pairs, count), curve.rows + curve.offsets[0, ..., 1].nan_to_num(0.0)], -1)
    frames = curve.pairs[:, None].expand(pairs, count, 2).flatten(0, 1)
    measured = measurements_of_curve(curve, timing, options.band_step)
    places = FramePlaces(measured, table(rows.flatten(0, 1))[None], table(frames.double())[None], clock.period)
    return curve, places


def row_time_of_tones(
    stack: GreyFrames, clock: CameraClock, options: RegistrationOptions, places: FramePlaces
) -> RowTimeFit | None:
    """Row time from the tones in the motion of one stack in image order; None if there is no tone.

    The tones of the bands, with independent frequencies per row and per frame, give the possible row times. With one of
    them, rows are measured, and the row time is fitted with all tones. These rows then give the possible row times once
    more, with a hundred times smaller errors.
    """
    highest = 0.5 / options.band_step
    tones = [find_row_tones(RowRecord.of(places, axis, clock.num_rows, clock.high), highest) for axis in range(2)]
    if not any(len(one.tones) for one in tones):
        return None
    possible = _possible(tones, clock)
    if not possible:
        return None
    of_bands = possible[0].chi_square
    # all of them give nearly the same displacements; low frequencies, of long row times, blur the frames least
    starts = sorted((one.row_time for one in _as_good_as_the_first(possible)), key=abs, reverse=True)
    tried, results = list[float](), list[RowTimeFit]()
    while starts and len(tried) < MAX_STARTS:
        tried.append(starts.pop(0))
        measured = _measured_with(tried[-1], turned(stack, tried[-1]), clock, options, tones)
        if measured is None:
            continue
        found, found_tones = measured
        possible = _possible(found_tones, clock, math.copysign(1.0, found.row_time))
        best = _as_good_as_the_first(possible)
        mine = min(possible, key=lambda one: abs(one.row_time - found.row_time), default=None)
        if mine is not None and all(mine is not one for one in best):
            if all(abs(possible[0].row_time / one - 1) > 0.01 for one in tried):
                starts.insert(0, possible[0].row_time)
            continue
        others = tuple(one for one in best if abs(one.row_time - found.row_time) > 5 * (one.std + found.std))
        # Further tones explain the rows at a wrong row time as well, but contradict the tones of the bands.
        contradiction = max(of_bands, 0.0 if mine is None else mine.chi_square)
        findings = found.findings
        if contradiction > _MAX_CONTRADICTION:
            findings = (*findings, Reason("row_time_contradicted", None, contradiction, _MAX_CONTRADICTION))
        results.append(replace(found, others=others, findings=findings))
        if not findings:
            return results[-1]
    return min(results, key=lambda one: len(one.findings), default=None)


def _possible(tones: list[RowTones], clock: CameraClock, direction: float = 1.0) -> list[Candidate]:
    """Row times that agree with the tones of frames whose rows are in an assumed readout order, the best first."""
    frequencies, covariances = map(np.concatenate, zip(*(one.frequencies() for one in tones), strict=True))
    found = candidates(frequencies, covariances, clock.period, clock.low, clock.high)
    found = [replace(one, row_time=direction * one.row_time) for one in found]
    return [one for one in found if clock.allows(one.row_time)]


def _as_good_as_the_first(possible: list[Candidate]) -> list[Candidate]:
    return [one for one in possible if one.chi_square <= possible[0].chi_square + MAX_CHI_SQUARE]


def _tones_at(tones: list[RowTones], row_time: float, period: float) -> tuple[Array, Array]:
    """Frequencies (1, 2, K) in Hz of tones of both axes at a row time, and which of them exist."""
    count = max(1, *(len(one.tones) for one in tones))
    frequencies = np.zeros((1, 2, count))
    active = np.zeros_like(frequencies, dtype=bool)
    for axis, one in enumerate(tones):
        nu, phi = one.tones[:, 2:].T
        frequencies[0, axis, : len(nu)] = np.abs(phi + (nu * period / row_time - phi).round()) / period
        active[0, axis, : len(nu)] = True
    return frequencies, active


def _findings(measured: Measurements, fit: ToneFit, other: OtherMotion) -> tuple[Reason, ...]:
    """Reasons against the tones of a fit, and with it against its row time."""
    residual, reasons = residual_of(measured, fit), list[Reason]()
    other = replace(other, unexplained=measured.unexplained(residual), correlated=measured.correlated(residual))
    quantities = {**vars(other), "permitted": other.permitted}
    for axis, name in enumerate(AXIS_NAMES[:2]):
        names = ("unexplained", "correlated", "size", "permitted")
        numbers = {quantity: float(quantities[quantity][0, axis]) for quantity in names}
        reasons += with_remedy(residual_reasons(name, numbers), "use frames in which the vibration is steady")
        count = int(fit.active[0, axis].sum())
        if count >= MAX_TONES:
            reasons.append(Reason("too_many_tones", name, count, MAX_TONES))
    return tuple(reasons)


def _measured_with(
    row_time: float, stack: GreyFrames, clock: CameraClock, options: RegistrationOptions, tones: list[RowTones]
) -> tuple[RowTimeFit, list[RowTones]] | None:
    """Direct measurement, and the fit of tones and row time, repeated until the row time is the one assumed.

    The tones of the rows have independent frequencies per row and per frame. None if too few rows are measured.
    """
    direction, size = math.copysign(1.0, row_time), abs(row_time)
    frequencies, active = _tones_at(tones, row_time, clock.period)
    timing = clock.timing(size)
    curve = band_curve(stack.images, stack.valid, timing, options, mere_start=True)
    start, _ = robust_fit(measurements_of_curve(curve, timing, options.band_step), frequencies, active, MotionModel())
    intervals, device = compared_intervals(timing, stack.images.shape[1]), stack.images.device
    exposure = None
    for _ in range(4):
        rows = grouped_frames(stack.images, stack.valid, timing, motion_of_fit(shrunk(start, intervals), device))
        found = refine(rows, intervals, start, None)
        if found.measurements.independent <= 0:  # too few rows agree with each other
            return None
        places = FramePlaces.of(found.measurements, clock.period, size, clock.num_rows)
        previous = size
        size, std, start = _fit_row_time(places, size, found.fit)
        size = min(max(size, 0.5 * clock.low), clock.period / clock.num_rows)
        if clock.exposure_time is None:
            exposure = _exposure(found.other_motion, timing)
        timing = clock.timing(size, None if exposure is None else exposure[0])
        if abs(size - previous) < 0.3 * std:
            break
    found_tones = [_row_tones(places, start, axis, size, clock) for axis in range(2)]
    against = _findings(places.timed(size), start, found.other_motion)
    exposure_time, exposure_std = exposure or (None, None)
    return RowTimeFit(direction * size, std, (), exposure_time, exposure_std, against), found_tones


def _fit_row_time(places: FramePlaces, row_time: float, fit: ToneFit) -> tuple[float, float, ToneFit]:
    """Row time in s, its standard deviation, and the tones, by Gauss-Newton with all tones fitted in every step."""
    std, exposure = 0.0, places.measurements.exposure_time
    for _ in range(12):
        measured = places.timed(row_time)
        fit = fit_tones(measured, fit.frequencies, fit.active, fit.model)
        # derivatives of the displacements by the row time: velocity times row
        motion, starts = motion_of_fit(fit), tensor(measured.exposure_starts)
        velocity = (motion.displacement(starts + exposure) - motion.displacement(starts)) / exposure
        by_row_time = measured.relative(table(velocity) * places.rows[..., None])[..., None]
        # the part of the change by the row time that no change of the tones cancels
        information = step = 0.0
        for axis, problem in linearised(measured, fit):
            unexplained = problem.unexplained(by_row_time[:, :, :, axis], axis)[0][0, :, 0]
            information += float(np.square(unexplained).sum())
            step += float(unexplained @ problem.residual[0])
        information = max(information, 1e-300)
        std, step = information**-0.5, step / information
        row_time = row_time + min(max(step, -0.02 * row_time), 0.02 * row_time)
        if abs(step) < 1e-2 * std:
            break
    measured = places.timed(row_time)
    return row_time, std, fit_tones(measured, fit.frequencies, fit.active, fit.model)


def _row_tones(places: FramePlaces, fit: ToneFit, axis: int, row_time: float, clock: CameraClock) -> RowTones:
    """The tones of a fit, fitted again with independent frequencies per row and per frame."""
    active = fit.active[0, axis]
    coefficients, frequencies = fit.coefficients[0, axis][active], fit.frequencies[0, axis][active]
    # the record of ``fit`` has another middle than that of the rows
    record = RowRecord.of(places, axis, clock.num_rows, row_time)
    middle = places.frames[0] * clock.period + places.rows[0] * row_time - record.frames * clock.period
    middle = (middle - record.rows * row_time).mean() + 0.5 * places.measurements.exposure_time
    turned = coefficients * np.exp(2j * math.pi * frequencies * (middle - fit.centre))
    turned = turned * np.sinc(frequencies * places.measurements.exposure_time)
    tones = np.stack([turned.real, turned.imag, frequencies * row_time, frequencies * clock.period], -1)
    return fit_row_tones(record, np.concatenate([tones.ravel(), fit.drift[0, axis, :1] * clock.period]))


def _exposure(other: OtherMotion, timing: RowTiming) -> tuple[float, float] | None:
    """Exposure time in s and its standard deviation from the difference of the blur between frames; None if unknown."""
    ratio, std, size = other.blur[0].tolist()
    # interpolation errors change ratio * size by about 0.005, finite differences change the ratio by a fifth
    uncertainty = math.hypot(std, 0.005 / max(size, 1e-12), 0.2 * ratio)
    if ratio < 3 * uncertainty:
        return None
    exposure = min(timing.exposure_time * math.sqrt(ratio), timing.frame_period)
    return exposure, 0.5 * exposure * uncertainty / ratio
