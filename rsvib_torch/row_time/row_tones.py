"""Tones with independent frequencies per row and per frame: what frames determine without the row time.

The displacement of row r of frame g by a tone is ``Re C exp(2 pi i (nu r + phi g))`` with ``nu = f T_row`` cycles per
row and ``phi = f P`` cycles per frame of period P. Frames determine phi up to a whole number k. Each k is a candidate
``f = (phi + k) / P``, ``T_row = nu P / (phi + k)``; a negative row time means the opposite readout direction. Tones of
different frequencies have only some row times in common.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.optimize import least_squares

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import MIN_GAIN
from rsvib_torch.detection.tones.selection import F_THRESHOLD
from rsvib_torch.numerics.tables import Array
from rsvib_torch.results.reason import Reason

MAX_CHI_SQUARE = 30.0  # above that of the best row time, for another one that explains the frames as well
MIN_SHARE = 0.2  # of the residual sum of squares that a further tone must explain


@dataclass(frozen=True, eq=False)
class FramePlaces:
    """Frame rows and frames of measurements of one stack, from which their times follow for any row time."""

    measurements: Measurements  # the displacements (B = 1); their times are replaced
    rows: Array  # (1, N, G) frame rows
    frames: Array  # (1, N, G) indices of the frames
    period: float  # frame period in s

    @classmethod
    def of(cls, measured: Measurements, period: float, row_time: float, num_rows: int) -> Self:
        """Places of measurements that were timed with a row time in s, of frames of a number of rows."""
        blank = 0.5 * (period - num_rows * row_time)  # rows up to half of the blanking outside of a frame are its rows
        frames = np.floor((measured.exposure_starts + blank) / period)
        return cls(measured, (measured.exposure_starts - frames * period) / row_time, frames, period)

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

    def of_first_frames(self, count: int) -> "FramePlaces":
        """The rows that were measured in the first frames only."""
        rows = (self.frames[0] - self.frames.min()).max(-1) < max(count, 1 + np.ptp(self.frames[0, 0]))
        measured = self.measurements.of_rows(slice(0, int(rows.argmin()) or None))
        number = measured.visible.shape[1]
        return FramePlaces(measured, self.rows[:, :number], self.frames[:, :number], self.period)


@dataclass(frozen=True, eq=False)
class RowRecord:
    """Displacements of scene rows along one axis, with the frames and the frame rows that they were measured in."""

    measurements: Measurements  # the displacements (B = 1); their times are not used
    axis: int
    rows: Array  # (N, G) frame rows, from the middle row
    frames: Array  # (N, G) indices of the frames, from the middle frame
    row_part: float  # assumed ratio of row time to frame period, for the drift of rows within a frame

    @classmethod
    def of(cls, places: FramePlaces, axis: int, num_rows: int, row_time: float) -> Self:
        """The record of frames of a number of rows and an assumed row time in s."""
        centred = places.centred(num_rows)
        return cls(places.measurements, axis, centred.rows[0], centred.frames[0], row_time / places.period)

    @property
    def values(self) -> Array:
        """(N, G) px, displacements less their mean over the frames that contain the scene row."""
        return self.measurements.displacements[0, ..., self.axis]

    @property
    def weights(self) -> Array:
        """(N,) px^-2."""
        return self.measurements.inverse_variances[0, :, self.axis]

    def relative(self, values: Array) -> Array:
        """Values (N, G, ...) less their mean over the frames that contain the row; 0 in other frames."""
        return self.measurements.relative(values[None])[0]

    @property
    def num_measurements(self) -> float:
        """Number of independent differences."""
        return float(self.measurements.num_measurements[0, self.axis])


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


def _model(record: RowRecord, values: Array) -> tuple[Array, Array]:
    """Displacements (N, G) of parameters (4 K + 1,), and their derivatives (N, G, 4 K + 1)."""
    real, imaginary, nu, phi = values[:-1].reshape(-1, 4).T
    rows, frames = record.rows[..., None], record.frames[..., None]
    angle = 2 * math.pi * (nu * rows + phi * frames)
    cosine, sine = np.cos(angle), np.sin(angle)
    by_angle = -2 * math.pi * (real * sine + imaginary * cosine)
    columns = np.stack([cosine, -sine, by_angle * rows, by_angle * frames], -1).reshape(*record.rows.shape, -1)
    drift = record.frames + record.row_part * record.rows
    value = (real * cosine - imaginary * sine).sum(-1) + values[-1] * drift
    return record.relative(value), record.relative(np.concatenate([columns, drift[..., None]], -1))


def fit_row_tones(record: RowRecord, start: Array, *, iterations: int = 20) -> RowTones:
    """Weighted least squares from start parameters (4 K + 1,)."""
    root = np.sqrt(record.weights)[:, None]
    found = least_squares(
        lambda values: (root * (_model(record, values)[0] - record.values)).ravel(),
        start,
        lambda values: (root[..., None] * _model(record, values)[1]).reshape(-1, len(values)),
        method="lm",
        x_scale="jac",
        max_nfev=2 * iterations,
    )
    spare = max(1.0, record.num_measurements - len(start))
    covariance = np.linalg.pinv(found.jac.T @ found.jac, hermitian=True) * (2 * found.cost / spare)
    return RowTones(found.x, covariance, record.values - _model(record, found.x)[0], 2 * found.cost)


def _linear(record: RowRecord, values: Array, nu: float, phi: float) -> Array:
    """Parameters with a further tone of given frequencies, whose coefficient is fitted to the residual."""
    extended = np.concatenate([values[:-1], [0.0, 0.0, nu, phi], values[-1:]])
    value, columns = _model(record, extended)
    root = np.sqrt(record.weights)[:, None]
    columns = (root[..., None] * columns[..., -5:-3]).reshape(-1, 2)
    extended[-5:-3] = np.linalg.lstsq(columns, (root * (record.values - value)).ravel())[0]
    return extended


def _peaks(record: RowRecord, residual: Array, highest: float, count: int) -> list[tuple[float, float]]:
    """The strongest peaks (nu, phi) of the periodogram of the differences between neighbouring frames."""
    seen = record.measurements.visible[0]
    weight = (record.weights[:, None] * seen[:, 1:] * seen[:, :-1]).ravel()
    difference = np.diff(residual, axis=1).ravel()
    difference = difference - (weight * difference).sum() / max(weight.sum(), 1e-300)
    rows, frames = record.rows[:, :-1].ravel(), record.frames[:, :-1].ravel()
    nu = np.arange(0.0, highest, 1 / (4 * (np.ptp(record.rows) + 1)))
    phi = np.arange(0.0, 1.0, 1 / (8 * (round(np.ptp(record.frames)) + 1)))
    along = weight * difference * np.exp(-2j * math.pi * nu[:, None] * rows)
    power = np.abs(along @ np.exp(-2j * math.pi * phi[:, None] * frames).T)
    largest = maximum_filter(power, 3, mode=("constant", "wrap"), cval=-1.0)
    best = np.argsort(np.where(power == largest, -power, 1.0), axis=None, kind="stable")[:count]
    return [(float(nu[i]), float(phi[j])) for i, j in zip(*np.unravel_index(best, power.shape), strict=True)]


def find_row_tones(record: RowRecord, highest: float) -> RowTones:
    """Find and fit the tones of one axis up to ``highest`` cycles per row, until the next one is not significant."""
    found = fit_row_tones(record, np.zeros(1))
    for _ in range(4):
        tried = [
            fit_row_tones(record, _linear(record, found.values, nu, phi), iterations=40)
            for nu, phi in _peaks(record, found.residual, highest, 4)
        ]
        # nearly blind tones have arbitrary amplitudes, and explain nothing that others do not
        tried = [fit for fit in tried if np.all(2 * np.abs(np.sin(math.pi * fit.tones[:, 3])) > MIN_GAIN)]
        if not tried:
            break
        trial = min(tried, key=lambda fit: fit.cost)
        spare = record.num_measurements - len(trial.values)
        needed = max(F_THRESHOLD * 4 * trial.cost / max(spare, 1.0), MIN_SHARE * found.cost)
        if spare < len(trial.values) or found.cost - trial.cost <= needed:
            break
        found = trial
    return found


# Candidates


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
    exposure_time: float | None = None  # in s, measured from the blur; None if it was not
    exposure_std: float | None = None  # its standard deviation
    findings: tuple[Reason, ...] = ()  # reasons why the row time is not certain


def candidates(frequencies: Array, covariances: Array, period: float, low: float, high: float) -> list[Candidate]:
    """All row times with ``low <= |T_row| <= high`` that are a local minimum of chi-square, the best first.

    Frequencies (K, 2) are in cycles per row and per frame, with covariances (K, 2, 2); times are in s.
    """
    (nu, phi), floor = frequencies.T, 1e-5  # cycles, error of phi that is assumed in addition

    def misfit(inverse: float) -> tuple[Array, Array]:
        """Distance (K,) from a whole number in cycles and its variance, for ``P / T_row``."""
        value = nu * inverse - phi
        variance = inverse**2 * covariances[:, 0, 0] - 2 * inverse * covariances[:, 0, 1] + covariances[:, 1, 1]
        return value - np.round(value), variance + floor**2

    found: list[Candidate] = []
    for tone in range(len(nu)):
        near, far = float(nu[tone]) * period / high, float(nu[tone]) * period / low
        for sign in (1.0, -1.0):
            lowest, highest = sorted((sign * near, sign * far))
            for k in range(math.ceil(lowest - float(phi[tone])), math.floor(highest - float(phi[tone])) + 1):
                inverse = float((phi[tone] + k) / max(nu[tone], 1e-12))
                for _ in range(5):
                    distance, variance = misfit(inverse)
                    information = (np.square(nu) / variance).sum()
                    inverse -= float((nu * distance / variance).sum() / information)
                distance, variance = misfit(inverse)
                row_time = period / inverse
                std = abs(row_time / inverse) / math.sqrt((np.square(nu) / variance).sum())
                if not low <= abs(row_time) <= high or any(
                    abs(row_time - other.row_time) < 1e-3 * std + 1e-9 * high for other in found
                ):
                    continue
                found.append(Candidate(row_time, std, float((np.square(distance) / variance).sum())))
    return sorted(found, key=lambda candidate: candidate.chi_square)
