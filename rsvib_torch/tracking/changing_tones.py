"""Tones whose amplitude changes within a record, from the offsets of row bands: where a tracker begins.

The displacement along an axis is ``Re sum_k C_k(t) exp(2 pi i f_k t) + D(t)``, in which the C_k and the velocity of D
are straight between knots. It is linear for given frequencies, so that all frequencies are tried, one tone after
another. The offsets of the whole record distinguish frequencies that differ by multiples of the frame rate, which a
few frames of a tone that decays do not.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.start import measurements_of_curve
from rsvib_torch.detection.tones.fit import MIN_GAIN, offset_gain
from rsvib_torch.detection.tones.selection import F_THRESHOLD
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.numerics.tables import Array, table, true_runs, valid_mean
from rsvib_torch.options import MAX_TONES, RegistrationOptions
from rsvib_torch.registration import OffsetCurve

_KNOT_FRAMES = 8  # frame periods between knots: a tone that decays to a third within them is straight to 5 % of it
_STEPS = 3.0  # frequencies that are tried for each inverse distance of the knots
# px, rms of the offsets by a tone: smaller ones may be errors of the registration, and of rows that are measured around
# a motion that is known less well
_MIN_SIZE, _MIN_SIZE_OF_ROWS = 0.02, 0.1
# of the largest offsets of a pair, those of a pair at rest, and by how many times these its neighbours exceed it
_AT_REST, _SUDDEN = 0.05, 5.0
_MIN_BETTER = 25.0  # decrease of chi-square by which a tone must be better than one at another frequency


@dataclass(frozen=True, eq=False)
class ChangingTones:
    """Tones of one axis.

    Attributes:
        knots: (J,) s.
        frequencies: (K,) Hz.
        coefficients: (K, J) complex px, ``C_k`` at the knots.
        velocity: (J,) px/s at the knots.
        other: Hz, frequency of another tone that explains the offsets as well as one of these; None if there is none.
    """

    knots: Array
    frequencies: Array
    coefficients: Array
    velocity: Array
    other: float | None

    def missing(self, found: "ChangingTones", slowest: float) -> float | None:
        """Hz, the frequency of a tone of ``found`` above ``slowest`` that is none of these; None if there is none.

        Tones that are much larger than these are drifts, and much smaller ones errors of the measurement.
        """
        step = 2 * _step(self.knots)
        largest = np.abs(self.coefficients).mean(1).max(initial=0.0)
        for frequency, size in zip(
            found.frequencies.tolist(), np.abs(found.coefficients).mean(1).tolist(), strict=True
        ):
            is_known = bool((np.abs(self.frequencies - frequency) < step).any())
            if not is_known and max(0.05 * largest, 0.03) < size < 3.0 * largest:
                return float(frequency)
        return None

    def at(self, time: float) -> tuple[Array, float]:
        """``C_k exp(2 pi i f_k t)`` in px and the velocity in px/s at a time in s."""
        hats = _hats(np.array([time]), self.knots)[0]
        return self.coefficients @ hats * np.exp(2j * math.pi * self.frequencies * time), float(self.velocity @ hats)


def moving_parts(curve: OffsetCurve) -> tuple[list[slice], Array]:
    """Runs of two and more frames that vibrate all the time, where a vibration starts or stops suddenly.

    The second result is (T,) bool, frames at rest.

    A tone that stops between two knots looks like further tones: of 12 frames with 2 px before 12 at rest, none was
    reliable.
    """
    # 1. How much the rows of the two frames of each pair move apart, beside a drift.
    offsets, rows = table(curve.offsets[0]), table(curve.rows)  # (P, N, 2)
    centred = rows - rows.mean()
    offsets = offsets - valid_mean(offsets, 1)[:, None]
    slope = valid_mean(offsets * centred[:, None], 1)[:, None] / np.square(centred).mean()
    level = np.sqrt(valid_mean(np.square(offsets - slope * centred[:, None]), 1)).max(-1)
    # 2. Pairs at rest beside which it changes suddenly. The frame before them and the one after may rest in part.
    least = max(_MIN_SIZE, _AT_REST * float(level.max()))
    at_rest, moves = np.zeros(len(level) + 1, dtype=bool), np.ones(len(level) + 1, dtype=bool)
    for start, end in true_runs(level < least).tolist():
        beside = np.concatenate([level[max(start - 2, 0) : start], level[end : end + 2]])
        if beside.max(initial=0.0) > _SUDDEN * least:
            at_rest[start : end + 1] = True
            moves[max(start - 1, 0) : end + 2] = False
    # 3. The runs between them.
    return [slice(start, end) for start, end in true_runs(moves).tolist() if end - start > 1], at_rest


def changing_tones(
    curve: OffsetCurve, starts: Array, rows: RowTiming, bands: RegistrationOptions
) -> tuple[ChangingTones, ChangingTones]:
    """The tones of both axes of one stack, in row order, from the offsets of its row bands.

    ``starts`` are those of the frames, in s.
    """
    # 1. The offsets, and the middles of their exposures.
    banded = measurements_of_curve(curve, rows, bands.band_step)
    offsets = np.diff(banded.displacements[0], axis=1)[:, 0]  # (N, 2)
    times = banded.exposure_starts[0] + 0.5 * banded.exposure_time  # (N, 2)
    times[:, 1] -= offsets[:, 1] * rows.row_time
    # 2. Rows of content that moves along the scan are exposed later. By how much is taken from the tones along the
    # scan: with the measured offsets, a tone that frames do not show would explain these offsets by themselves.
    record = _Record.of(starts, rows, bands.band_rows)
    weights, moved = banded.weights[0] * banded.independent, np.zeros(len(times))
    for _ in range(2):
        shifted = times + np.stack([np.zeros_like(moved), moved * rows.row_time], 1)
        along_scan, moved = _AxisOffsets(shifted, offsets[:, 1], weights[:, 1], record).tones()
    return _AxisOffsets(shifted, offsets[:, 0], weights[:, 0], record).tones()[0], along_scan


def tones_of_rows(
    measured: Sequence[tuple[float, Measurements]], starts: Array, rows: RowTiming, band_rows: int
) -> list[ChangingTones]:
    """The tones of both axes from measured rows, which are ten times as accurate as bands.

    ``measured`` has the start of frames and the displacements of their rows and of those of the frame before;
    ``starts`` those of all frames.
    """
    times = np.concatenate([start + one.exposure_starts[0] + 0.5 * one.exposure_time for start, one in measured])
    offsets = np.concatenate([np.diff(one.displacements[0], axis=1)[:, 0] for _, one in measured])
    used = [one.weights[0] * one.independent * (one.num_differences[0] > 0)[:, None] for _, one in measured]
    record, weights = _Record.of(starts, rows, band_rows), np.concatenate(used)
    averaged = (rows.exposure_time, BLOCK_ROWS * rows.row_time)
    record = replace(record, averaged=averaged, smallest=_MIN_SIZE_OF_ROWS)
    return [_AxisOffsets(times, offsets[:, axis], weights[:, axis], record).tones()[0] for axis in range(2)]


def of_frames(curve: OffsetCurve, frames: slice) -> OffsetCurve:
    """The offsets between some frames."""
    used = (curve.pairs[:, 0] >= frames.start) & (curve.pairs[:, 1] < frames.stop)
    return replace(
        curve,
        pairs=curve.pairs[used] - frames.start,
        times=curve.times[used],
        later_times=curve.later_times[used],
        offsets=curve.offsets[:, used],
        quality=curve.quality[:, used],
    )


@dataclass(frozen=True, eq=False)
class _Record:
    """What the offsets of all axes of a record have in common."""

    knots: Array  # (J,) s
    intervals: Array  # s, between the frames
    tried: Array  # (F,) Hz
    averaged: tuple[float, float]  # s, over which exposure and band average
    smallest: float = _MIN_SIZE  # px

    @classmethod
    def of(cls, starts: Array, rows: RowTiming, band_rows: int) -> Self:
        """The record of frames that start at times in s."""
        end = starts[-1] + float(np.median(np.diff(starts)))
        knots = np.linspace(starts[0], end, 2 + round(len(starts) / _KNOT_FRAMES))
        averaged = (rows.exposure_time, band_rows * rows.row_time)
        # below two periods between knots, a tone is not distinguished from a drift
        step = _step(knots)
        tried = step * np.arange(2 * _STEPS, 0.5 / (step * averaged[1]))
        return cls(knots, np.diff(starts), tried, averaged)


def _step(knots: Array) -> float:
    """Hz, distance of the frequencies that are tried."""
    return float(1 / (_STEPS * (knots[1] - knots[0])))


def _hats(times: Array, knots: Array) -> Array:
    """(..., J) weights of the knots at times (...), which interpolate straight lines."""
    place = np.clip((times - knots[0]) / (knots[1] - knots[0]), 0, len(knots) - 1)
    return np.maximum(1 - np.abs(place[..., None] - np.arange(len(knots))), 0.0)


@dataclass(frozen=True, eq=False)
class _AxisOffsets:
    """N offsets along an axis between two times."""

    times: Array  # (N, 2) s
    offsets: Array  # (N,) px
    weights: Array  # (N,)
    record: _Record

    @cached_property
    def data(self) -> Array:
        """(N,) weighted offsets."""
        return np.sqrt(self.weights) * self.offsets

    @cached_property
    def drift(self) -> Array:
        """(N, J) weighted offsets by a velocity of 1 at each knot."""
        moved = _hats(self.times.mean(1), self.record.knots) * np.diff(self.times)
        return np.sqrt(self.weights)[:, None] * moved

    def columns(self, frequencies: Sequence[float] | Array) -> Array:
        """(N, J + 2 J K) weighted offsets by the drift and by tones of amplitude 1 at each knot."""
        parts, hats = [self.drift], _hats(self.times, self.record.knots)
        for frequency in frequencies:
            turned = hats * np.exp(2j * math.pi * frequency * self.times)[..., None]
            change = np.sqrt(self.weights)[:, None] * (turned[:, 1] - turned[:, 0])
            parts += [change.real, -change.imag]
        return np.concatenate(parts, 1)

    def is_blind(self, frequencies: Array) -> Array:
        """Whether all frames are displaced alike by a tone."""
        return np.asarray(offset_gain(frequencies, self.record.intervals) < MIN_GAIN)

    def found(self) -> tuple[list[float], float | None]:
        """Frequencies of the tones, strongest first, and that of another tone that explains as much as one of them."""
        found: list[float] = []
        other, count = None, (self.weights > 0).sum()
        step = _step(self.record.knots)
        left = self.record.tried[~self.is_blind(self.record.tried)]
        while len(found) < MAX_TONES and len(left):
            # 1. The tone that explains most beside those before, with its frequency to a tenth of a step.
            basis = np.linalg.qr(self.columns(found))[0]
            data = self.data - basis @ (basis.T @ self.data)
            power = self._explained(left, basis, data)
            near = left[power.argmax()] + step * np.linspace(-1, 1, 21)
            powers = self._explained(near, basis, data)
            frequency, most = float(near[powers.argmax()]), float(powers.max())
            # 2. Is it significant, and large enough?
            size = 2 * len(self.record.knots)
            noise = max((float(data @ data) - most) / max(count - size * (len(found) + 1.5), 1), 1e-300)
            is_large = math.sqrt(most / max(self.weights.sum(), 1e-300)) > self.record.smallest
            if not (is_large and most > F_THRESHOLD * size * noise):
                break
            apart = np.abs(left - frequency) > 3 * step
            if self.is_blind(np.array(frequency)):
                left = left[apart]
                continue
            # 3. Another frequency may explain the offsets as well.
            if apart.any() and most - power[apart].max() < _MIN_BETTER * noise:
                other = float(left[apart][power[apart].argmax()])
            found.append(frequency)
            left = left[np.abs(left - frequency) > 4 * step]
            # 4. What is left out of a tone looks like tones that are a multiple of the frame rate apart from it.
            interval = float(np.median(self.record.intervals))
            for sign in (-1, 1):
                turns = (left - sign * frequency) * interval
                left = left[np.abs(turns - turns.round()) > 2 * step * interval]
        return found, other

    def _explained(self, frequencies: Array, basis: Array, data: Array) -> Array:
        """(F,) decrease of the squares of data by a tone beside the columns of a basis."""
        powers = []
        for frequency in frequencies:
            added = self.columns([frequency])[:, len(self.record.knots) :]
            known, product = basis.T @ added, added.T @ data
            squares = added.T @ added - known.T @ known
            squares += 1e-9 * np.eye(len(squares)) * squares.trace()  # of what the basis explains, little is left
            powers.append(product @ np.linalg.solve(squares, product))
        return np.array(powers)

    def tones(self) -> tuple[ChangingTones, Array]:
        """The tones, and the offsets (N,) that they explain."""
        found, other = self.found()
        frequencies, count = np.array(found), len(self.record.knots)
        for last in (False, False, True):
            columns = self.columns(frequencies)
            solved = np.linalg.lstsq(columns, self.data, rcond=None)[0]
            parts = solved[count:].reshape(-1, 2, count)
            coefficients = parts[:, 0] + 1j * parts[:, 1]
            if not last:  # what turns the phase from knot to knot belongs to the frequency
                spacing = self.record.knots[1] - self.record.knots[0]
                turn = np.angle((coefficients[:, 1:] * coefficients[:, :-1].conj()).sum(1))
                frequencies = frequencies + turn / (2 * math.pi * spacing)
                # two that become equal would cancel each other, with amplitudes of 1e6 px
                apart = np.abs(np.subtract.outer(frequencies, frequencies)) > _step(self.record.knots)
                frequencies = frequencies[(apart | ~np.tri(len(frequencies), k=-1, dtype=bool)).all(1)]
        kept = np.prod([np.sinc(frequencies * seconds) for seconds in self.record.averaged], 0)
        coefficients = coefficients / np.maximum(kept, 0.1)[:, None]
        explained = columns @ solved / np.sqrt(np.maximum(self.weights, 1e-300))
        tones = ChangingTones(self.record.knots, frequencies, coefficients, solved[:count], other)
        return tones, np.where(self.weights > 0, explained, 0.0)
