"""Row time from frames whose motion is a sum of tones.

The displacement of row r of frame g by a tone is ``Re C exp(2 pi i (nu r + phi g))`` with ``nu = f T_row`` cycles per
row and ``phi = f P`` cycles per frame of period P. Neither depends on the row time. Frames determine phi up to a whole
number k: each k is a candidate ``f = (phi + k) / P``, ``T_row = nu P / (phi + k)``; a negative row time means the
opposite readout direction. Tones of different frequencies have only some row times in common.

Rows are measured around a motion on a clock of its own, whose unit is the frame period. Its row time is so short that a
tone of any nu and phi has a frequency on it.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import block_diag
from scipy.ndimage import maximum_filter
from scipy.optimize import least_squares

from rsvib_torch.detection.measurements import Measurements, OtherMotion
from rsvib_torch.detection.rows.grouped_frames import grouped_frames
from rsvib_torch.detection.start import band_curve, measurements_of_curve
from rsvib_torch.detection.tones.fit import MIN_GAIN
from rsvib_torch.detection.tones.selection import F_THRESHOLD
from rsvib_torch.detection.verdict import residual_reasons, with_remedy
from rsvib_torch.frames.prepare import GreyFrames
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.tables import Array, scaled_inverse, tensor
from rsvib_torch.options import MAX_TONES, RegistrationOptions
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason

_FRAME_ROWS = 2.0**24  # row times of a frame period of the clock; phases within a frame are then right to 1e-5 turns
_ROUNDS = 12  # of measurements of the rows
_ROUND_OF_PATTERN = 1  # in which the motion is known roughly, and a pattern of columns is subtracted
# px, that tones leave after three rounds if they are not the motion; long exposures, whose rows are not known at first,
# leave 0.25 px in the first round, and 0.1 px in the third
_HOPELESS = 0.5
_CONVERGED = 0.1  # standard deviations by which the last round changes tones
# of the residual sum of squares that a further tone must explain, in bands and in rows, whose noise is nearly white
_SHARE_OF_BANDS, _SHARE_OF_ROWS = 0.2, 0.02
_MIN_SINC = 0.1  # of the amplitude that remains in the mean over the exposure; tones below are not undone
_FLOOR = 1e-5  # cycles, error of phi that is assumed in addition
# Chi-square above that of the best row time, of another one that explains the frames as well, and of one that may be
# that of the exposure: 3 standard deviations
_MAX_CHI_SQUARE, _PROBABLE = 30.0, 9.0
# Chi-square of the frequencies of tones per row and per frame at a row time. Of 78 recordings whose row time was within
# the limits, at most 5.5 for the bands and 8.9 for the rows; of 5 with a wrong result within wrong limits, 32 and more
_MAX_CONTRADICTION = 20.0


@dataclass(frozen=True)
class Candidate:
    """A row time that agrees with the tones."""

    row_time: float  # seconds, negative for a reverse readout
    std: float  # its standard deviation
    chi_square: float  # of the distances of ``nu P / T_row - phi`` of the tones from whole numbers


@dataclass(frozen=True)
class CameraClock:
    """What is known about the timing of a camera."""

    period: float  # frame period in s
    low: float  # shortest possible row time in s
    high: float  # longest possible row time in s
    directions: tuple[float, ...]  # possible readout directions: 1.0 forward, -1.0 reverse
    exposure_time: float  # in s; 0 if unknown

    def allows(self, row_time: float) -> bool:
        """Whether a signed row time in s is possible."""
        return self.low <= abs(row_time) <= self.high and math.copysign(1.0, row_time) in self.directions


@dataclass(frozen=True, eq=False)
class _MeasuredRows:
    """Displacements of rows (or bands) of one stack, by row and frame instead of time."""

    measurements: Measurements  # the displacements (B = 1)
    rows: Array  # (1, N, G) rows from the middle of the frame
    frames: Array  # (1, N, G) frames from the middle one
    advance: float  # part of the frame period from row to row, for an image motion; from a first row time

    @classmethod
    def of(cls, measured: Measurements, num_frames: int, num_rows: int, advance: float) -> Self:
        frames = np.round(measured.exposure_starts)
        rows = (measured.exposure_starts - frames) * _FRAME_ROWS
        return cls(measured, rows - 0.5 * (num_rows - 1), frames - 0.5 * (num_frames - 1), advance)

    def model(self, values: Array) -> tuple[Array, Array]:
        """Relative displacements (1, N, G) by parameters (4 K + 1,), and their derivatives (1, N, G, 4 K + 1).

        The parameters are Re C, Im C in px, nu, phi of each tone, and the image motion in px per frame.
        """
        real, imaginary, nu, phi = values[:-1].reshape(-1, 4).T
        rows, frames = self.rows[..., None], self.frames[..., None]
        angle = 2 * math.pi * (nu * rows + phi * frames)
        cosine, sine = np.cos(angle), np.sin(angle)
        by_angle = -2 * math.pi * (real * sine + imaginary * cosine)
        columns = np.stack([cosine, -sine, by_angle * rows, by_angle * frames], -1).reshape(*self.rows.shape, -1)
        time = self.frames + self.advance * self.rows
        value, relative = (real * cosine - imaginary * sine).sum(-1) + values[-1] * time, self.measurements.relative
        return relative(value), relative(np.concatenate([columns, time[..., None]], -1))

    def residual(self, tones: list["_Tones"]) -> Array:
        """(1, N, G, 2) px, displacements without those by the tones of both axes."""
        return self.measurements.displacements - np.stack([self.model(fit.values)[0] for fit in tones], -1)


@dataclass(frozen=True, eq=False)
class _Tones:
    """Fitted tones of one axis."""

    values: Array  # (4 K + 1,) parameters, see ``_MeasuredRows.model``
    covariance: Array  # (4 K + 1, 4 K + 1)
    residual: Array  # (N, G) px
    cost: float  # weighted square of the residual

    @property
    def tones(self) -> Array:
        """(K, 4) parameters of the tones."""
        return self.values[:-1].reshape(-1, 4)


def _fitted(rows: _MeasuredRows, axis: int, start: Array) -> _Tones:
    """Weighted least squares from start parameters (4 K + 1,)."""
    measured = rows.measurements.displacements[..., axis]
    root = np.sqrt(rows.measurements.inverse_variances[..., axis])[..., None]
    solution = least_squares(
        lambda values: (root * (rows.model(values)[0] - measured)).ravel(),
        start,
        lambda values: (root[..., None] * rows.model(values)[1]).reshape(-1, len(values)),
        method="lm",
        x_scale="jac",
        max_nfev=80,
    )
    spare = max(1.0, float(rows.measurements.num_measurements[0, axis]) - len(start))
    covariance = scaled_inverse(solution.jac.T @ solution.jac) * (2 * solution.cost / spare)
    return _Tones(solution.x, covariance, (measured - rows.model(solution.x)[0])[0], 2 * solution.cost)


def _with_tone(rows: _MeasuredRows, axis: int, tones: _Tones, nu: float, phi: float) -> _Tones:
    """The fit with a further tone of given frequencies at first, whose coefficient fits the residual."""
    values = np.concatenate([tones.values[:-1], [0.0, 0.0, nu, phi], tones.values[-1:]])
    root = np.sqrt(rows.measurements.inverse_variances[0, :, axis])[:, None]
    columns = (root[..., None] * rows.model(values)[1][0, ..., -5:-3]).reshape(-1, 2)
    values[-5:-3] = np.linalg.lstsq(columns, (root * tones.residual).ravel())[0]
    return _fitted(rows, axis, values)


def _peaks(rows: _MeasuredRows, axis: int, residual: Array, highest: float, count: int) -> list[tuple[float, float]]:
    """The strongest peaks (nu, phi) of the periodogram of the differences between neighbouring frames."""
    visible = rows.measurements.visible[0]
    weight = (rows.measurements.inverse_variances[0, :, axis, None] * visible[:, 1:] * visible[:, :-1]).ravel()
    difference = np.diff(residual, axis=1).ravel()
    difference = difference - (weight * difference).sum() / max(weight.sum(), 1e-300)
    row, frame = rows.rows[0, :, :-1].ravel(), rows.frames[0, :, :-1].ravel()
    # Not 0 and 1/2, where a slow tone does not have a sign.
    nu = np.arange(0.5, highest * 4 * (np.ptp(row) + 1)) / (4 * (np.ptp(row) + 1))
    count_of_phi = 8 * (round(np.ptp(rows.frames)) + 1)
    phi = (np.arange(count_of_phi) + 0.5) / count_of_phi
    along = weight * difference * np.exp(-2j * math.pi * nu[:, None] * row)
    power = np.abs(along @ np.exp(-2j * math.pi * phi[:, None] * frame).T)
    largest = maximum_filter(power, 3, mode=("constant", "wrap"), cval=-1.0)
    best = np.argsort(np.where(power == largest, -power, 1.0), axis=None, kind="stable")[:count]
    return [(float(nu[i]), float(phi[j])) for i, j in zip(*np.unravel_index(best, power.shape), strict=True)]


def _with_further_tones(rows: _MeasuredRows, axis: int, highest: float, share: float, known: Array) -> _Tones:
    """Known tones (4 K + 1,) of an axis, and further ones while they are significant, up to ``highest`` cycles per row.

    A further tone must explain a ``share`` of the residual.
    """
    best = _fitted(rows, axis, known)
    while len(best.tones) < MAX_TONES:
        tried = [_with_tone(rows, axis, best, *peak) for peak in _peaks(rows, axis, best.residual, highest, 4)]
        # nearly blind tones have arbitrary amplitudes, and explain nothing that others do not
        tried = [fit for fit in tried if np.all(2 * np.abs(np.sin(math.pi * fit.tones[:, 3])) > MIN_GAIN)]
        if not tried:
            break
        trial = min(tried, key=lambda fit: fit.cost)
        spare = float(rows.measurements.num_measurements[0, axis]) - len(trial.values)
        needed = max(F_THRESHOLD * 4 * trial.cost / max(spare, 1.0), share * best.cost)
        if spare < len(trial.values) or best.cost - trial.cost <= needed:
            break
        best = trial
    return best


def _motion(tones: list[_Tones], timing: RowTiming, num_frames: int, num_rows: int) -> Vibration:
    """The motion (1, 2, K) on the clock of the rows, on which phi continues from frame to frame."""
    parameters = np.zeros((2, 3 * max(1, *(len(fit.tones) for fit in tones)) + 3))
    for fit, of_axis in zip(tones, parameters, strict=True):
        amplitude, frequency, phase = of_axis[:-3].reshape(3, -1)[:, : len(fit.tones)]
        real, imaginary, nu, phi = fit.tones.T
        frequency[:] = phi + np.round(nu * _FRAME_ROWS - phi)
        # The mean over an exposure that begins with a row is that of its middle, times a sinc.
        within = frequency * timing.exposure_time
        sinc = np.sinc(within)
        coefficient = (real + 1j * imaginary) / np.where(np.abs(sinc) < _MIN_SINC, np.inf, sinc)
        turns = nu * 0.5 * (num_rows - 1) + phi * 0.5 * (num_frames - 1) + 0.5 * within
        amplitude[:], phase[:] = np.abs(coefficient), np.angle(coefficient) + 0.5 * math.pi - 2 * math.pi * turns
        of_axis[-3] = fit.values[-1]
    return Vibration.from_parameters(tensor(parameters[None]))


def candidates(tones: list[_Tones], clock: CameraClock) -> list[Candidate]:
    """All possible row times that are a local minimum of chi-square, the best first."""
    nu, phi = np.concatenate([fit.tones[:, 2:] for fit in tones]).T
    of_nu, mixed, of_phi = (
        block_diag(*(fit.covariance[i:-1:4, j:-1:4] for fit in tones)) for i, j in ((2, 2), (2, 3), (3, 3))
    )

    # 1. Values of P / T_row with which a tone has a whole number of further turns per frame.
    most = math.ceil(float(np.abs(nu).max(initial=0.0)) * clock.period / clock.low) + 1
    turns = np.arange(-most, most + 1)
    inverse = ((phi[:, None] + turns) / np.maximum(np.abs(nu), 1e-12)[:, None] * np.sign(nu)[:, None]).ravel()
    inverse = inverse[(np.abs(inverse) * clock.low <= clock.period) & (np.abs(inverse) * clock.high >= clock.period)]

    # 2. Generalised least squares: the distances of all tones from their whole numbers are errors of nu and phi.
    def weighted() -> tuple[Array, Array, Array]:
        """Distances d, and d and nu times the inverse covariance of d, each (N, K)."""
        scale = inverse[:, None, None]
        distance = nu * inverse[:, None] - phi
        distance = distance - np.round(distance)
        variance = scale**2 * of_nu - scale * (mixed + mixed.T) + of_phi + _FLOOR**2 * np.eye(len(nu))
        solved = np.linalg.solve(variance, np.stack([distance, np.broadcast_to(nu, distance.shape)], -1))
        return distance, solved[..., 0], solved[..., 1]

    for _ in range(5):
        distance, _, by_nu = weighted()
        inverse = inverse - (by_nu * distance).sum(-1) / (by_nu @ nu)
    distance, by_distance, by_nu = weighted()
    chi_square, row_times = (distance * by_distance).sum(-1), clock.period / inverse
    stds = np.abs(row_times / inverse) / np.sqrt(by_nu @ nu)

    # 3. Different ones that are possible.
    possible: list[Candidate] = []
    for candidate in map(Candidate, row_times.tolist(), stds.tolist(), chi_square.tolist()):
        least = 1e-3 * candidate.std + 1e-9 * clock.high
        is_known = any(abs(candidate.row_time - other.row_time) < least for other in possible)
        if clock.allows(candidate.row_time) and not is_known:
            possible.append(candidate)
    return sorted(possible, key=lambda candidate: candidate.chi_square)


def row_times_of_tones(
    stack: GreyFrames, clock: CameraClock, options: RegistrationOptions
) -> tuple[list[Candidate], list[Reason]]:
    """Row times that agree with the tones of one stack in image order, the best first, and reasons against all of them.

    There are none without tones.
    """
    num_frames, num_rows = stack.images.shape[1:3]

    # 1. The tones of row bands.
    timing = RowTiming(1 / _FRAME_ROWS, 1.0, _FRAME_ROWS)
    curve = band_curve(stack.images, stack.valid, timing, options, mere_start=True)
    bands = _MeasuredRows.of(measurements_of_curve(curve, timing, options.band_step), num_frames, num_rows, 0.0)
    highest = 0.5 / options.band_step
    tones = [_with_further_tones(bands, axis, highest, _SHARE_OF_BANDS, np.zeros(1)) for axis in range(2)]
    possible = candidates(tones, clock) if any(len(fit.tones) for fit in tones) else []
    if not possible:
        return [], []

    # 2. The tones of rows, which are measured around the motion. Which rows an exposure blurs depends on the row time:
    # of those that agree with the tones, the longest one blurs least.
    for number in range(_ROUNDS):
        row_time = max((one.row_time for one in _explaining(possible, _PROBABLE)), key=abs)
        exposed = max(1.0, clock.exposure_time / abs(row_time))
        timing = replace(timing, exposure_rows=exposed)
        motion = _motion(tones, timing, num_frames, num_rows).to(stack.images.device)
        if number == 0:
            frames = grouped_frames(stack.images, stack.valid, timing, motion)
        measured = replace(frames, timing=timing).measure(motion)
        if not (measured.measurements.weights > 0).any():
            return [], []
        if number == _ROUND_OF_PATTERN and (pattern := frames.column_pattern(motion, measured.row_variance())).any():
            frames = frames.without(pattern)
            measured = replace(frames, timing=timing).measure(motion)
        rows = _MeasuredRows.of(measured.measurements, num_frames, num_rows, row_time / clock.period)
        rows = replace(rows, measurements=rows.measurements.weighed(rows.residual(tones)))
        before = tones
        tones = [
            _with_further_tones(rows, axis, highest, _SHARE_OF_ROWS, fit.values)
            if number > 1
            else _fitted(rows, axis, fit.values)
            for axis, fit in enumerate(tones)
        ]
        possible = candidates(tones, clock)
        if not possible:
            return [], []
        unexplained = float(rows.measurements.unexplained(rows.residual(tones)).max())
        if number > 1 and (all(map(_is_converged, before, tones)) or unexplained > _HOPELESS):
            break

    # 3. The row times that agree with the tones, and the verdict.
    best, *others = _explaining(possible, _MAX_CHI_SQUARE)
    others = [one for one in others if abs(one.row_time - best.row_time) > 5 * (one.std + best.std)]
    reasons = _findings(rows, tones, measured.differential())
    if best.chi_square > _MAX_CONTRADICTION:
        reasons.append(Reason("row_time_contradicted", None, best.chi_square, _MAX_CONTRADICTION))
    return [best, *others], reasons


def _explaining(possible: list[Candidate], further: float) -> list[Candidate]:
    """Row times, the best first, whose chi-square is at most by ``further`` above the least."""
    return [one for one in possible if one.chi_square <= possible[0].chi_square + further]


def _is_converged(before: _Tones, after: _Tones) -> bool:
    change = after.values - before.values if len(after.values) == len(before.values) else math.inf
    return bool((np.abs(change) <= _CONVERGED * np.sqrt(after.covariance.diagonal())).all())


def _findings(rows: _MeasuredRows, tones: list[_Tones], differential: Array) -> list[Reason]:
    """Reasons against tones, and with them against their row time."""
    residual, measured, reasons = rows.residual(tones), rows.measurements, list[Reason]()
    of_tones = [replace(fit, values=np.append(fit.values[:-1], 0.0)) for fit in tones]
    other = OtherMotion.of(measured, measured.displacements - rows.residual(of_tones), residual, differential)
    quantities = {**vars(other), "permitted": other.permitted}
    for axis, name in enumerate(AXIS_NAMES[:2]):
        names = ("unexplained", "correlated", "size", "permitted")
        numbers = {quantity: float(quantities[quantity][0, axis]) for quantity in names}
        reasons += with_remedy(residual_reasons(name, numbers), "use frames in which the vibration is steady")
    return reasons
