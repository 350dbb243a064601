"""Row time from frames whose motion is a sum of tones.

The displacement of row r of frame g by a tone is ``Re C exp(2 pi i (nu r + phi g))`` with ``nu = f T_row`` cycles per
row and ``phi = f P`` cycles per frame of period P. Frames determine phi up to a whole number k. Each k is a candidate
``f = (phi + k) / P``, ``T_row = nu P / (phi + k)``; a negative row time means the opposite readout direction. Tones of
different frequencies have only some row times in common.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from scipy.optimize import least_squares

from rsvib_torch.detection.measurements import Measurements, OtherMotion
from rsvib_torch.detection.refinement import refine
from rsvib_torch.detection.rows.displacements import compared_intervals
from rsvib_torch.detection.rows.grouped_frames import grouped_frames
from rsvib_torch.detection.start import band_curve, measurements_of_curve
from rsvib_torch.detection.tones.fit import (
    MIN_GAIN,
    MotionModel,
    ToneFit,
    fit_tones,
    motion_of_fit,
    residual_of,
    shrunk,
)
from rsvib_torch.detection.tones.selection import F_THRESHOLD, robust_fit
from rsvib_torch.detection.tones.uncertainty import linearised
from rsvib_torch.detection.verdict import residual_reasons, with_remedy
from rsvib_torch.frames.grey import GreyFrames
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.numerics.tables import Array, scaled_inverse, table, tensor
from rsvib_torch.options import MAX_TONES, RegistrationOptions
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason

_MAX_CHI_SQUARE = 30.0  # above that of the best row time, for another one that explains the frames as well
_LARGEST_STEP = 0.02  # of the row time, in an iteration
_MIN_SHARE = 0.2  # of the residual sum of squares that a further tone must explain
_MAX_STARTS = 5  # row times that are tried; of 8 random pairs of tones, 2 need a second
# Chi-square of the frequencies of tones per row and per frame at a row time. Of 78 recordings whose row time was within
# the limits, at most 5.5 for the bands and 8.9 for the rows; of 5 with a wrong result within wrong limits, 32 and more
_MAX_CONTRADICTION = 20.0


@dataclass(frozen=True)
class Candidate:
    """A row time that agrees with the tones."""

    row_time: float  # seconds, negative for a reverse readout
    std: float  # its standard deviation
    # sum over the tones of the squared distance of ``nu P / T_row - phi`` from a whole number, over its variance
    chi_square: float


@dataclass(frozen=True, eq=False)
class RowTimeFit:
    """Row time of the frames of one stack."""

    row_time: float  # seconds, negative for a reverse readout
    std: float  # its standard deviation
    others: tuple[Candidate, ...] = ()  # other row times that explain the frames as well
    findings: tuple[Reason, ...] = ()  # reasons why the row time is not certain
    # largest standard deviation over the row time of a certain result; frequencies have the same relative error
    permitted: float = 0.01


@dataclass(frozen=True, eq=False)
class FramePlaces:
    """Frame rows and frames of measurements of one stack, from which their times follow for any row time."""

    measurements: Measurements  # the displacements (B = 1); their times are replaced
    rows: Array  # (1, N, G) frame rows
    frames: Array  # (1, N, G) indices of the frames
    period: float  # frame period in s
    row_time: float  # s, assumed for the drift of rows within a frame

    @classmethod
    def of(cls, measured: Measurements, period: float, row_time: float, num_rows: int) -> Self:
        """Places of measurements that were timed with a row time in s, of frames of a number of rows."""
        blank = 0.5 * (period - num_rows * row_time)  # rows up to half of the blanking outside of a frame are its rows
        frames = np.floor((measured.exposure_starts + blank) / period)
        return cls(measured, (measured.exposure_starts - frames * period) / row_time, frames, period, row_time)

    def times(self, row_time: float) -> Array:
        """(1, N, G) s, exposure starts with a row time in s."""
        return self.frames * self.period + self.rows * row_time

    def timed(self, row_time: float) -> Measurements:
        """The measurements with the times of a row time in s."""
        return replace(self.measurements, exposure_starts=self.times(row_time))

    def centred(self, num_rows: int) -> "FramePlaces":
        """Rows and frames that count from the middle row and the middle frame."""
        middle = 0.5 * (self.frames.min() + self.frames.max())
        return replace(self, rows=self.rows - 0.5 * (num_rows - 1), frames=self.frames - middle)

    def values(self, axis: int) -> tuple[Array, Array]:
        """(N, G) px, displacements along an axis less their mean over the frames, and (N, 1) px^-1, their weights."""
        measured = self.measurements
        return measured.displacements[0, ..., axis], np.sqrt(measured.inverse_variances[0, :, axis])[:, None]


@dataclass(frozen=True, eq=False)
class RowTones:
    """Fitted tones of one axis."""

    values: Array  # (4 K + 1,) parameters: Re C, Im C in px, nu, phi of each tone, and the drift in px per frame
    covariance: Array  # (4 K + 1, 4 K + 1)
    residual: Array  # (N, G) px
    cost: float  # weighted square of the residual

    @property
    def tones(self) -> Array:
        """(K, 4) parameters of the tones."""
        return self.values[:-1].reshape(-1, 4)

    def frequencies(self) -> tuple[Array, Array]:
        """(K, 2) cycles per row and per frame, and their covariances (K, 2, 2)."""
        tone = np.arange(len(self.tones))
        blocks = self.covariance[:-1, :-1].reshape(len(tone), 4, len(tone), 4)
        return self.tones[:, 2:], blocks[tone, 2:, tone, 2:]


def _model(places: FramePlaces, values: Array) -> tuple[Array, Array]:
    """Displacements (N, G) of parameters (4 K + 1,), and their derivatives (N, G, 4 K + 1)."""
    real, imaginary, nu, phi = values[:-1].reshape(-1, 4).T
    rows, frames = places.rows[..., None], places.frames[..., None]
    angle = 2 * math.pi * (nu * rows + phi * frames)
    cosine, sine = np.cos(angle), np.sin(angle)
    by_angle = -2 * math.pi * (real * sine + imaginary * cosine)
    columns = np.stack([cosine, -sine, by_angle * rows, by_angle * frames], -1).reshape(*places.rows.shape, -1)
    drift = places.times(places.row_time) / places.period
    value, relative = (real * cosine - imaginary * sine).sum(-1) + values[-1] * drift, places.measurements.relative
    return relative(value)[0], relative(np.concatenate([columns, drift[..., None]], -1))[0]


def fit_row_tones(places: FramePlaces, axis: int, start: Array, *, iterations: int = 20) -> RowTones:
    """Weighted least squares from start parameters (4 K + 1,)."""
    measured, root = places.values(axis)
    found = least_squares(
        lambda values: (root * (_model(places, values)[0] - measured)).ravel(),
        start,
        lambda values: (root[..., None] * _model(places, values)[1]).reshape(-1, len(values)),
        method="lm",
        x_scale="jac",
        max_nfev=2 * iterations,
    )
    spare = max(1.0, float(places.measurements.num_measurements[0, axis]) - len(start))
    covariance = scaled_inverse(found.jac.T @ found.jac) * (2 * found.cost / spare)
    return RowTones(found.x, covariance, measured - _model(places, found.x)[0], 2 * found.cost)


def _linear(places: FramePlaces, axis: int, values: Array, nu: float, phi: float) -> Array:
    """Parameters with a further tone of given frequencies, whose coefficient is fitted to the residual."""
    extended = np.concatenate([values[:-1], [0.0, 0.0, nu, phi], values[-1:]])
    value, columns = _model(places, extended)
    measured, root = places.values(axis)
    columns = (root[..., None] * columns[..., -5:-3]).reshape(-1, 2)
    extended[-5:-3] = np.linalg.lstsq(columns, (root * (measured - value)).ravel())[0]
    return extended


def _peaks(places: FramePlaces, axis: int, residual: Array, highest: float, count: int) -> list[tuple[float, float]]:
    """The strongest peaks (nu, phi) of the periodogram of the differences between neighbouring frames."""
    seen = places.measurements.visible[0]
    weight = (np.square(places.values(axis)[1]) * seen[:, 1:] * seen[:, :-1]).ravel()
    difference = np.diff(residual, axis=1).ravel()
    difference = difference - (weight * difference).sum() / max(weight.sum(), 1e-300)
    rows, frames = places.rows[0, :, :-1].ravel(), places.frames[0, :, :-1].ravel()
    nu = np.arange(0.0, highest, 1 / (4 * (np.ptp(places.rows) + 1)))
    phi = np.arange(0.0, 1.0, 1 / (8 * (round(np.ptp(places.frames)) + 1)))
    along = weight * difference * np.exp(-2j * math.pi * nu[:, None] * rows)
    power = np.abs(along @ np.exp(-2j * math.pi * phi[:, None] * frames).T)
    largest = maximum_filter(power, 3, mode=("constant", "wrap"), cval=-1.0)
    best = np.argsort(np.where(power == largest, -power, 1.0), axis=None, kind="stable")[:count]
    return [(float(nu[i]), float(phi[j])) for i, j in zip(*np.unravel_index(best, power.shape), strict=True)]


def find_row_tones(places: FramePlaces, axis: int, highest: float) -> RowTones:
    """Find and fit the tones of one axis up to ``highest`` cycles per row, until the next one is not significant.

    ``places`` are centred.
    """
    found = fit_row_tones(places, axis, np.zeros(1))
    for _ in range(4):
        tried = [
            fit_row_tones(places, axis, _linear(places, axis, found.values, nu, phi), iterations=40)
            for nu, phi in _peaks(places, axis, found.residual, highest, 4)
        ]
        # nearly blind tones have arbitrary amplitudes, and explain nothing that others do not
        tried = [fit for fit in tried if np.all(2 * np.abs(np.sin(math.pi * fit.tones[:, 3])) > MIN_GAIN)]
        if not tried:
            break
        trial = min(tried, key=lambda fit: fit.cost)
        spare = float(places.measurements.num_measurements[0, axis]) - len(trial.values)
        needed = max(F_THRESHOLD * 4 * trial.cost / max(spare, 1.0), _MIN_SHARE * found.cost)
        if spare < len(trial.values) or found.cost - trial.cost <= needed:
            break
        found = trial
    return found


def candidates(frequencies: Array, covariances: Array, period: float, low: float, high: float) -> list[Candidate]:
    """All row times with ``low <= |T_row| <= high`` that are a local minimum of chi-square, the best first.

    Frequencies (K, 2) are in cycles per row and per frame, with covariances (K, 2, 2); times are in s.
    """
    (nu, phi), floor = frequencies.T, 1e-5  # cycles, error of phi that is assumed in addition

    def misfit(inverse: Array) -> tuple[Array, Array]:
        """Distances (N, K) from a whole number in cycles and their variances, for N values of ``P / T_row``."""
        inverse = inverse[:, None]
        value = nu * inverse - phi
        variance = inverse**2 * covariances[:, 0, 0] - 2 * inverse * covariances[:, 0, 1] + covariances[:, 1, 1]
        return value - np.round(value), variance + floor**2

    most = math.ceil(float(nu.max(initial=0.0)) * period / low) + 1
    turns = np.arange(-most, most + 1)
    inverse = ((phi[:, None] + turns) / np.maximum(nu, 1e-12)[:, None]).ravel()
    inverse = inverse[(np.abs(inverse) * low <= period) & (np.abs(inverse) * high >= period)]
    for _ in range(5):
        distance, variance = misfit(inverse)
        inverse = inverse - (nu * distance / variance).sum(-1) / (np.square(nu) / variance).sum(-1)
    distance, variance = misfit(inverse)
    chi_square, row_times = (np.square(distance) / variance).sum(-1), period / inverse
    stds = np.abs(row_times / inverse) / np.sqrt((np.square(nu) / variance).sum(-1))
    found: list[Candidate] = []
    for one in map(Candidate, row_times.tolist(), stds.tolist(), chi_square.tolist()):
        known = any(abs(one.row_time - other.row_time) < 1e-3 * one.std + 1e-9 * high for other in found)
        if low <= abs(one.row_time) <= high and not known:
            found.append(one)
    return sorted(found, key=lambda candidate: candidate.chi_square)


@dataclass(frozen=True)
class CameraClock:
    """What is known about the timing of a camera."""

    period: float  # frame period in s
    num_rows: int  # rows of a frame
    low: float  # shortest possible row time in s
    high: float  # longest possible row time in s
    directions: tuple[float, ...]  # possible readout directions: 1.0 forward, -1.0 reverse
    exposure_time: float | None  # in s; None if unknown

    def timing(self, row_time: float) -> RowTiming:
        """Timing in row order with a row time, whose sign is its direction."""
        size = abs(row_time)
        return RowTiming(size, (self.exposure_time or size) / size, max(self.period / size, self.num_rows))

    def near(self, fit: RowTimeFit) -> "CameraClock":
        """The clock with the row times that a fit allows only."""
        size, reach = abs(fit.row_time), 4.0 * fit.std
        low, high = max(self.low, size - reach), min(self.high, size + reach)
        return replace(self, low=low, high=high, directions=(math.copysign(1.0, fit.row_time),))

    def allows(self, row_time: float) -> bool:
        """Whether a signed row time in s is possible."""
        return self.low <= abs(row_time) <= self.high and math.copysign(1.0, row_time) in self.directions


def turned(stack: GreyFrames, direction: float) -> GreyFrames:
    """The frames with their rows in readout order."""
    if direction > 0:
        return stack
    return replace(stack, images=stack.images.flip(-2), valid=None if stack.valid is None else stack.valid.flip(-2))


def bands_of_frames(stack: GreyFrames, clock: CameraClock, options: RegistrationOptions) -> FramePlaces:
    """Offsets of the row bands of one stack with their frame rows; they do not depend on the row time."""
    timing = clock.timing(clock.high)
    curve = band_curve(stack.images, stack.valid, timing, options, mere_start=True)
    pairs, count = curve.quality.shape[1:]
    rows = torch.stack([curve.rows.expand(pairs, count), curve.rows + curve.offsets[0, ..., 1].nan_to_num(0.0)], -1)
    frames = curve.pairs[:, None].expand(pairs, count, 2).flatten(0, 1)
    measured = measurements_of_curve(curve, timing, options.band_step)
    of_rows, of_frames = table(rows.flatten(0, 1))[None], table(frames.double())[None]
    return FramePlaces(measured, of_rows, of_frames, clock.period, clock.high)


def row_time_of_tones(
    stack: GreyFrames, clock: CameraClock, options: RegistrationOptions, places: FramePlaces
) -> RowTimeFit | None:
    """Row time from the tones in the motion of one stack in image order; None if there is no tone.

    The tones of the bands, with independent frequencies per row and per frame, give the possible row times. With one of
    them, rows are measured, and the row time is fitted with all tones. These rows then give the possible row times once
    more, with a hundred times smaller errors.
    """
    highest = 0.5 / options.band_step
    tones = [find_row_tones(places.centred(clock.num_rows), axis, highest) for axis in range(2)]
    if not any(len(one.tones) for one in tones):
        return None
    possible = _possible(tones, clock)
    if not possible:
        return None
    of_bands = possible[0].chi_square
    # all of them give nearly the same displacements; low frequencies, of long row times, blur the frames least
    starts = sorted((one.row_time for one in _as_good_as_the_first(possible)), key=abs, reverse=True)
    tried, results = list[float](), list[RowTimeFit]()
    while starts and len(tried) < _MAX_STARTS:
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
    return [one for one in possible if one.chi_square <= possible[0].chi_square + _MAX_CHI_SQUARE]


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
    for _ in range(4):
        rows = grouped_frames(stack.images, stack.valid, timing, motion_of_fit(shrunk(start, intervals), device))
        found = refine(rows, intervals, start, None)
        if found.measurements.independent <= 0:  # too few rows agree with each other
            return None
        places = FramePlaces.of(found.measurements, clock.period, size, clock.num_rows)
        previous = size
        size, std, start = _fit_row_time(places, size, found.fit)
        size = min(max(size, 0.5 * clock.low), clock.period / clock.num_rows)
        timing = clock.timing(size)
        if abs(size - previous) < 0.3 * std:
            break
    found_tones = [_row_tones(places, start, axis, size, clock) for axis in range(2)]
    against = _findings(places.timed(size), start, found.other_motion)
    return RowTimeFit(direction * size, std, findings=against), found_tones


def _fit_row_time(places: FramePlaces, row_time: float, fit: ToneFit) -> tuple[float, float, ToneFit]:
    """Row time in s, its standard deviation, and the tones, by Gauss-Newton with all tones fitted in every step."""
    exposure = places.measurements.exposure_time

    change = std = math.inf
    for _ in range(12):
        measured = places.timed(row_time)
        fit = fit_tones(measured, fit.frequencies, fit.active, fit.model)
        # derivatives of the displacements by the row time: velocity times row
        motion, starts = motion_of_fit(fit), tensor(measured.exposure_starts)
        velocity = (motion.displacement(starts + exposure) - motion.displacement(starts)) / exposure
        by_row_time = measured.relative(table(velocity) * places.rows[..., None])[..., None]
        # the part of the change by the row time that no change of the tones cancels
        information, step = 1e-300, 0.0
        for axis, problem in linearised(measured, fit):
            unexplained = problem.unexplained(by_row_time[:, :, :, axis], axis)[0][0, :, 0]
            information += float(np.square(unexplained).sum())
            step += float(unexplained @ problem.residual[0])
        std = information**-0.5
        if abs(change) < 1e-2 * std:
            break
        change = float(np.clip(step / information, -_LARGEST_STEP * row_time, _LARGEST_STEP * row_time))
        row_time += change
    return row_time, std, fit


def _row_tones(places: FramePlaces, fit: ToneFit, axis: int, row_time: float, clock: CameraClock) -> RowTones:
    """The tones of a fit, fitted again with independent frequencies per row and per frame."""
    active = fit.active[0, axis]
    coefficients, frequencies = fit.coefficients[0, axis][active], fit.frequencies[0, axis][active]
    # the record of ``fit`` has another middle than that of the rows
    centred = replace(places.centred(clock.num_rows), row_time=row_time)
    middle = (places.times(row_time) - centred.times(row_time)).mean() + 0.5 * places.measurements.exposure_time
    turned = coefficients * np.exp(2j * math.pi * frequencies * (middle - fit.centre))
    turned = turned * np.sinc(frequencies * places.measurements.exposure_time)
    tones = np.stack([turned.real, turned.imag, frequencies * row_time, frequencies * clock.period], -1)
    start = np.concatenate([tones.ravel(), fit.drift[0, axis, :1] * clock.period])
    return fit_row_tones(centred, axis, start)
