"""The path of a camera and its vibration in a window of frames, from corners that are followed from frame to frame.

A corner at the place p (px from the centre of the frame) is exposed at the time t of its row. Between two frames it is
displaced by ``B(p) (P(t') - P(t)) + V(t') - V(t)``. The path P has the components x, y (px), roll (rad) and zoom, with
``B(p) = [[1, 0, -p_y, p_x], [0, 1, p_x, p_y]]``; the vibration V is a sum of tones along x and y. P is a cubic B-spline
with two knots per frame, which follows a hand. The amplitude and phase of a tone are a spline with a knot every four
frames, which follows a vibration that decays or grows. Tones are found in a periodogram from which everything that P
explains has been projected out. Both are fitted together, with weights that leave out moving objects: at first all that
is not of the layer of the corners, which a subject on 40 % of the frame would move the fit away from.
"""

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded, solve_triangular

from rsvib_torch.numerics.interpolation import spline_taps
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import Corners, reduction
from rsvib_torch.tracking.window_tones import Averaged, WindowTone, wave_columns

_MOST_TONES = 3  # of an axis in a window
_KNOTS = 2  # of the spline per frame; with one, residuals of hand-held clips are 1.7 times as large
_STIFFNESS = 1e-3  # of the third difference of the spline, in units of the information of a typical knot
_LEAST = 1e-9  # information of what is not determined, likewise
_FAST = 10.0  # Hz/s, from which on a tone is at a blind frequency for a moment only
_ENVELOPE = 4  # frames between the knots of a tone; a blow that decays with 0.3 s is followed at 30 frames per second
_STEADY = 0.1  # of a tone, by which neighbouring knots differ (standard deviation), where corners do not determine it
_CELLS = 24  # of the rows, in which the search for tones takes means; resolves tones of 12 periods per readout
_FINE = 64  # frequencies that are compared at a time
MIN_RATIO = 60.0  # of the variance that a tone explains and that of the rest; compression and parallax reach 40
_MIN_EXPLAINED = 0.03  # px rms, of the offsets that a tone explains; smaller ones are not visible in a video
_LOWEST = 0.6  # of the frame rate; the path follows slower motion
# Hz, or frame rates if that is more; rows that are read nearly at once would resolve any frequency, and the search
# would not end. With 2000 Hz alone, a tone of 2300 Hz at 1000 frames per second became two others
_HIGHEST, _FRAME_RATES = 2000.0, 4.0
_MIN_GAIN = 0.15  # |2 sin(pi f T)|; tones close to a multiple of the frame rate hardly change from frame to frame
# Tones of at most this gain of which more is left in a third of the rows or columns are left out: 0.1 to 0.8 of 20 of
# 24 tones by objects that move in some rows, below 0.03 of tones of cameras at such frequencies
_NEARLY_BLIND, _MAX_APART = 0.5, 0.1
# Other tones, likewise: 0.6 to 5 of roll and zoom, whose removal made a third of the frame wobble more; below 0.03 in
# 40 clips, 0.23 in nearly dark ones
_MOST_APART = 0.5
SIGNIFICANT = 3.0  # standard deviations of a tone
# standard deviations of a jump of its phase: at most 10 of 76 tones in H.264, 23 to 58 beside missing frames
_CERTAIN = 10.0
_MIN_SHARE = 2e-3  # of the largest variance that a tone of 1 px causes; others are hidden by the path
_MIN_SINC = 0.1  # of the amplitude that remains in the mean over the exposure
# rows of the patch of a corner, over which its displacement is a mean: amplitudes of 52 to 205 Hz are then right within
# 1 to 2 %, and 2 to 15 % too small without
_PATCH_ROWS = 10
_ALIASES = 2  # frequencies on each side of a tone that are compared with it
# of what the best of them leaves, that the next one leaves at least: 1.12 and more of 24 right tones; 1.00 to 1.07 of
# tones by noise, bars and texts beside the picture, and where a quarter of the rows has corners
_DISTINCT = 1.08
ROUNDS = 4  # of a robust fit
_HALF, _FOUR_FIFTHS = 1.177, 1.794  # standard deviations, below which that part of lengths of two normal components is
# Residual of the path of a layer over that of all corners, before tones are found: 0.07 to 0.63 beside a subject on 20
# to 40 % of the frame, 0.98 to 2.3 in clips with tones of 1.5 to 5 px
_EXPLAINS_MORE = 0.8
_SOFT = 3.0  # standard deviations, at which a corner has a quarter of the weight


@dataclass(frozen=True, eq=False)
class WindowPath:
    """Path and tones in one window of frames."""

    origin: float  # s, the time origin of the tones: the middle of the window
    start: float  # s, of the first knot
    step: float  # s, between knots
    knots: Array  # (N, 4) coefficients of the spline
    tones: tuple[WindowTone, ...]
    residual: float  # px, robust standard deviation of the offsets of corners along one axis
    residual_of_most: float  # px, likewise; where the path is that of a layer, from four fifths of all corners
    # how the rows are read instead, if the corners contradict the stated readout, and px, median residuals by the path
    # with the stated and with this readout
    other_readout: tuple[str, float, float] | None = None
    # part of the stated time of the readout, by which the path and the tones displace the rows; 0: as columns do
    part: float = 1.0
    blur: tuple[float, float] = (0.0, 0.0)  # ``blur_ratio``; 0 if it is unknown
    # other readouts that explain the corners as well, and the frequencies of their tones
    agreeing: tuple[str, ...] = ()

    def path(self, times: Array, derivative: int = 0) -> Array:
        """(N, 4) components of the path, or their derivatives, at times (N,) in s."""
        index, weights = spline_taps(times, self.start, self.step, len(self.knots), derivative=derivative)
        return np.einsum("nk,nka->na", weights, self.knots[index])


def _basis(index: NDArray[np.int64], factors: Array, count: int) -> Array:
    """(N, 2, count) B-splines from ``spline_taps`` at both times (N, 2)."""
    basis = np.zeros((*index.shape[:2], count))
    np.put_along_axis(basis, index, factors, -1)
    return basis


def _gain(frequency: Array | float, interval: float) -> Array:
    """Offset from frame to frame by a tone of amplitude 1."""
    return np.asarray(np.abs(2 * np.sin(math.pi * frequency * interval)))


def robust_weights(distance: Array, std: Array | float) -> Array:
    """Weights of residuals of the size ``distance`` with standard deviations, which are at least 0.001 px."""
    return 1.0 / (1.0 + (distance / (_SOFT * np.maximum(std, 1e-3))) ** 2) ** 2


@cache
def _squared_differences(count: int, order: int) -> Array:
    """Matrix (count, count) of the sum of the squares of the differences of some ``order`` between neighbours."""
    differences = np.diff(np.eye(count), order, axis=0)
    return np.asarray(differences.T @ differences)


class _Band:
    """Normal equations whose matrix is a band: ``matrix[i - j, j]`` is the entry of row i and column j, i >= j."""

    def __init__(self, blocks: Sequence[NDArray[np.int64]], count: int) -> None:
        """Equations of ``count`` unknowns; each of the blocks lists those that its entries depend on."""
        self.blocks, self.parts = blocks, list[tuple[NDArray[np.int64], NDArray[np.int64]]]()
        self.matrix, self.right = np.zeros((1 + max(int(np.ptp(index)) for index in blocks), count)), np.zeros(count)
        for index in blocks:
            row, column = np.nonzero(index[:, None] >= index)
            place = (index[row] - index[column]) * count + index[column]
            self.parts.append((row * len(index) + column, place))

    def clear(self) -> None:
        """Begin with no equations."""
        self.matrix[:] = self.right[:] = 0.0

    def add(self, number: int, columns: Array, values: Array, weights: Array) -> None:
        """Add the equations ``columns @ unknowns = values`` of a block (C-contiguous matrices)."""
        heavy, (inside, place) = columns.T * weights, self.parts[number]
        self.matrix.reshape(-1)[place] += (heavy @ columns).reshape(-1)[inside]
        self.right[self.blocks[number]] += heavy @ values

    def stiffen(self, index: NDArray[np.int64], order: int, weight: float) -> None:
        """Keep the differences of some ``order`` between neighbouring unknowns, with rising numbers, small."""
        squares = _squared_differences(len(index), order)
        for lag in range(order + 1):
            later, earlier = index[lag:], index[: len(index) - lag]
            self.matrix[later - earlier, earlier] += weight * squares.diagonal(lag)

    def solve(self) -> tuple[Array, Callable[[Array], Array]]:
        """The unknowns, and a function that solves for other right sides."""
        factor = cholesky_banded(self.matrix, lower=True, check_finite=False), True
        return cho_solve_banded(factor, self.right), lambda right: np.asarray(cho_solve_banded(factor, right))


class WindowFit:
    """The robust fit of path and tones to the corners of one window."""

    def __init__(self, corners: Corners, interval: float, averaged: Averaged) -> None:
        self.corners, self.interval, self.averaged = corners, interval, averaged
        self.step = interval / _KNOTS
        self.start, end = float(corners.times.min()), float(corners.times.max())
        self.origin = 0.5 * (self.start + end)
        self.count = math.ceil((end - self.start) / self.step) + 3
        self.times = corners.times - self.origin
        # Roll and zoom are fitted as the displacement in px at the farthest corner.
        self.reach = max(1.0, float(np.abs(corners.places).max()))
        index, weights = spline_taps(corners.times, self.start, self.step, self.count)
        factors = corners.factors / np.array([1.0, 1.0, self.reach, self.reach])
        # Columns of the path, for the few knots that a pair of frames depends on: every component of a knot at the
        # places of the corners.
        self.pairs: list[tuple[slice, NDArray[np.int64], Array]] = []  # corners, unknowns, columns (2, n, unknowns)
        self.envelope_step = _ENVELOPE * interval
        self.envelope_knots = max(4, math.ceil((end - self.start) / self.envelope_step) + 3)
        taps = self.envelope(self.times)
        self.envelopes: list[tuple[NDArray[np.int64], Array]] = []  # knots of a tone, and their values (n, 2, knots)
        ends = np.append(np.nonzero(np.diff(corners.pairs))[0] + 1, len(factors))
        for begin, stop in pairwise((0, *ends)):
            part = slice(int(begin), int(stop))
            low, knots = int(index[part].min()), int(index[part].max()) + 1
            basis = np.diff(_basis(index[part] - low, weights[part], knots - low), axis=1)[:, 0]
            columns = np.einsum("nac,nk->anck", factors[part], basis).reshape(2, len(basis), -1)
            unknowns = (np.arange(4)[:, None] * self.count + np.arange(low, knots)).ravel()
            self.pairs.append((part, unknowns, columns))
            knots_of_tone = np.arange(taps[0][part].min(), taps[0][part].max() + 1)
            self.envelopes.append(
                (knots_of_tone, _basis(taps[0][part] - knots_of_tone[0], taps[1][part], len(knots_of_tone)))
            )
        self.tones: list[WindowTone] = []
        self.layer, self.weights = np.ones(len(factors), bool), np.ones(len(factors))
        self.sigma = math.inf  # px, standard deviation of a corner of the layer along one axis
        self.distance = np.zeros(len(factors))  # px, of all corners from what is explained
        self.unexplained = math.inf  # px^2, mean over the pairs of the square of the median residual
        self.knots = np.zeros((4, self.count))

    def explained(self, knots: Array) -> Array:
        """(N, 2) px, offsets of the corners by a path with these knots (4, count)."""
        offsets = np.empty_like(self.corners.offsets)
        for part, unknowns, columns in self.pairs:
            offsets[part] = (columns @ knots.ravel()[unknowns]).T
        return offsets

    def envelope(self, times: Array) -> tuple[NDArray[np.int64], Array]:
        """Knots of a tone at times in s from the middle, and their values."""
        return spline_taps(times, self.start - self.origin, self.envelope_step, self.envelope_knots)

    def solve(self, rounds: int = 2) -> None:
        """Fit path and tones; each round corrects the weights and the frequencies."""
        # Unknowns are numbered by the times of their knots, so that the normal matrix is a band.
        knots = np.tile(self.step * np.arange(self.count), 4)
        knots_of_tones = np.tile(self.envelope_step * np.arange(self.envelope_knots), 2 * len(self.tones))
        place = np.argsort(np.argsort(np.concatenate([knots, knots_of_tones]), kind="stable"))
        of_path, of_tones = place[: len(knots)], place[len(knots) :].reshape(len(self.tones), 2, self.envelope_knots)
        blocks = [
            np.concatenate([of_path[unknowns], of_tones[..., knots].ravel()])
            for (_, unknowns, _), (knots, _) in zip(self.pairs, self.envelopes, strict=True)
        ]
        band = _Band(blocks, len(place))
        for _ in range(rounds):
            for tone in self.tones:
                if tone.knots.any():
                    tone.correct_frequency(0.25 / (self.times.max() - self.times.min()))
            # 1. Columns of the path and the tones, for the few knots that a pair of frames depends on.
            band.clear()
            waves, columns = [tone.waves(self.times, self.averaged) for tone in self.tones], []
            for number, ((part, _, path), (_, values)) in enumerate(zip(self.pairs, self.envelopes, strict=True)):
                waving = np.zeros((len(self.tones), *path.shape[:2], 2 * values.shape[-1]))
                for tone, wave, of_axis in zip(self.tones, waves, waving, strict=True):
                    of_axis[tone.axis] = wave_columns(wave[part], values)
                columns.append(np.concatenate([path, *waving], -1).reshape(2 * path.shape[1], -1))
                band.add(number, columns[-1], self.corners.offsets[part].T.ravel(), np.tile(self.weights[part], 2))
            # 2. The solution with a stiff path, and tones that are steady where nothing determines them.
            diagonal = band.matrix[0, of_path]
            typical, mean = max(float(np.median(diagonal)), 1e-9), float(diagonal.mean())
            band.matrix[0] += _LEAST * typical
            for index in of_path.reshape(4, -1):
                band.stiffen(index, 3, _STIFFNESS * typical)
            for tone, parts in zip(self.tones, of_tones, strict=True):
                spread = _STEADY * np.sqrt(np.square(np.abs(tone.knots)).mean())
                for index in parts:
                    band.stiffen(index, 1, (self.sigma / spread) ** 2 if spread > 0 else 1e-3 * mean)
            solution, solved = band.solve()
            self.knots = solution[of_path].reshape(4, -1)
            # 3. Weights by the residuals, and the tones.
            residual = self.corners.offsets.copy()
            for (part, *_), index, of_pair in zip(self.pairs, blocks, columns, strict=True):
                residual[part] -= (of_pair @ solution[index]).reshape(2, -1).T
            self.distance = length = np.hypot(*residual.T)
            self.sigma = max(float(np.median(length[self.layer])) / _HALF, 1e-3)
            medians = self._medians(length)
            self.weights = self._weights(length, self.sigma, medians / _HALF)
            self.unexplained = float(np.square(medians).mean())
            for tone, (real, imaginary) in zip(self.tones, solution[of_tones], strict=True):
                tone.knots = real + 1j * imaginary
        for tone, parts in zip(self.tones, of_tones, strict=True):
            index = parts.ravel()
            tone.set_std(self.sigma**2 * solved(np.eye(len(place))[:, index])[index])

    def _medians(self, distance: Array) -> Array:
        """Median of the layer of every pair of frames."""
        return np.array([np.median(distance[part][self.layer[part]]) for part, *_ in self.pairs])

    def _weights(self, distance: Array, std: float, of_pairs: Array) -> Array:
        """Weights of residuals with a standard deviation, or that of their pair if it is larger.

        A vibration that is not found yet displaces all corners of a pair.
        """
        counts = [part.stop - part.start for part, *_ in self.pairs]
        return robust_weights(distance, np.repeat(np.maximum(std, of_pairs), counts))

    def add_tones(self, tones: Sequence[tuple[int, float]], slope: float = 0.0) -> None:
        """Add tones of some axes and frequencies to those that ``solve`` fits."""
        for axis, frequency in tones:
            knots = np.zeros(self.envelope_knots, complex)
            tone = WindowTone(axis, frequency, knots, self.start - self.origin, self.envelope_step, slope)
            self.tones.append(tone)

    def with_aliases(self, axis: int, frequency: float, slope: float, limits: Array) -> list["WindowFit"]:
        """The fit with a tone or one of its aliases between ``limits`` in Hz, the best first.

        Frequencies one period per frame apart differ within the readout only, where the path follows a part of the
        tone: they are compared by what remains of both axes.
        """
        aliases = frequency + np.arange(-_ALIASES, _ALIASES + 1) / self.interval
        inside = (aliases > limits[0]) & (aliases < limits[1]) & self.is_apart(axis, aliases)
        trials = list[WindowFit]()
        for alias in aliases[inside | (aliases == frequency)].tolist():
            trials.append(trial := copy(self))
            trial.tones, trial.weights = [*map(copy, self.tones)], self.layer.astype(np.float64)
            trial.add_tones([(axis, alias)], slope)
            trial.solve(1)
        return sorted(trials, key=lambda trial: trial.unexplained)

    def with_distinct_tones(self, limits: Array) -> "WindowFit | None":
        """The fit with a better alias of a tone, or without a tone that an alias explains as well; None without both.

        As long as other tones are not known, they hide which alias leaves less.
        """
        for tone in self.tones:
            without = copy(self)
            without.tones = [other for other in self.tones if other is not tone]
            best, *worse = without.with_aliases(tone.axis, tone.frequency, tone.slope, limits)
            if worse and worse[0].unexplained < _DISTINCT * best.unexplained:
                return without
            if abs(best.tones[-1].frequency - tone.frequency) * self.interval > 0.5:
                return best
        return None

    def of_layer(self) -> "WindowFit":
        """The path of the layer of the corners; this one, if it explains about as much of all corners.

        A vibration of several px makes layers of the rows that move alike.
        """
        if self.corners.layer.all():
            return self
        layer_fit = copy(self)
        layer_fit.layer, layer_fit.weights = self.corners.layer, self.corners.layer.astype(np.float64)
        layer_fit.solve(ROUNDS)
        return layer_fit if np.median(layer_fit.distance) < _EXPLAINS_MORE * np.median(self.distance) else self

    def keep_tones(self) -> None:
        """Leave out insignificant tones, and those that thirds of the rows or columns contradict."""
        waves, residual = [], self.corners.offsets - self.explained(self.knots)
        for tone in self.tones:
            index, factors = self.envelope(self.times)
            waves.append(tone.waves(self.times, self.averaged) * (factors * tone.knots[index]).sum(-1))
            residual[:, tone.axis] -= (waves[-1][:, 1] - waves[-1][:, 0]).real
        root = np.sqrt(self.weights)
        # thirds of the rows and of the columns: roll and zoom displace opposite sides in opposite directions
        across = self.corners.places[:, 0]
        sides = np.stack([self.corners.rows, (across - across.min()) / max(float(np.ptp(across)), 1.0)])
        thirds = np.minimum(3 * sides, 2).astype(np.int64)
        parts = [of_side == third for of_side in thirds for third in range(3)]
        for tone, (early, late) in zip(self.tones, (wave.T for wave in waves), strict=True):
            columns = root[:, None] * np.stack([(late - early).real, (early - late).imag], -1)
            weighted = root * residual[:, tone.axis]
            tone.jump = self._jump(root, columns[:, 1], -0.5 * root * (early + late).imag, weighted)
            fits = [np.linalg.lstsq(columns[part], weighted[part])[0] for part in parts]
            tone.left_in_third = max(float(np.hypot(*solution)) for solution in fits)

        def is_kept(tone: WindowTone, wave: NDArray[np.complex128]) -> bool:
            least = _NEARLY_BLIND if tone.left_in_third > _MAX_APART else _MIN_GAIN
            is_visible = abs(tone.slope) > _FAST or _gain(tone.frequency, self.interval) > least
            return bool(
                is_visible
                and tone.left_in_third < _MOST_APART
                and tone.size > SIGNIFICANT * tone.amplitude_std
                and 0.5 * np.square(np.abs(wave[:, 1] - wave[:, 0])).mean() > _MIN_EXPLAINED**2
            )

        self.tones = [tone for tone, wave in zip(self.tones, waves, strict=True) if is_kept(tone, wave)]

    def _jump(self, root: Array, turned: Array, parted: Array, weighted: Array) -> float:
        """``WindowTone.jump``, from what is left of the offsets (N,), times the root of their weights.

        Offsets change by ``turned`` (N,) if the phase changes by 1 rad in both frames, and by ``parted`` (N,) if it
        does so between them. Beside these, a path of the pair is a polynomial over the rows.
        """
        polynomial = root[:, None] * (self.corners.rows[:, None] - 0.5) ** np.arange(4)
        columns, largest = np.concatenate([polynomial, np.stack([turned, parted, weighted], -1)], 1), 0.0
        for part, *_ in self.pairs:
            if (freedom := part.stop - part.start - 6) > 15:
                triangle = np.asarray(np.linalg.qr(columns[part], "r"))
                if abs(triangle[5, 6]) > _CERTAIN * abs(triangle[6, 6]) / math.sqrt(freedom):
                    largest = max(largest, abs(float(triangle[5, 6] / triangle[5, 5])))
        return largest

    def path(self) -> WindowPath:
        """The result of the fit."""
        knots = self.knots.T / np.array([1.0, 1.0, self.reach, self.reach])
        residual = residual_of_most = float(np.median(self.distance)) / _HALF
        if not self.layer.all():  # with a subject on 40 % of the frame, tones of 0.1 px were found that are none
            residual_of_most = float(np.quantile(self.distance, 0.8)) / _FOUR_FIFTHS
        tones = tuple(self.tones)
        return WindowPath(self.origin, self.start, self.step, knots, tones, residual, residual_of_most)

    def is_apart(self, axis: int, frequencies: Array) -> NDArray[np.bool_]:
        """Whether frequencies are those of none of the tones of an axis, nor of a change of their amplitudes."""
        resolved = max(2.0 / (self.times.max() - self.times.min()), 0.5 / self.envelope_step)
        tones = np.array([tone.frequency for tone in self.tones if tone.axis == axis])
        return np.asarray((frequencies > 0) & (np.abs(frequencies[:, None] - tones) > resolved).all(1))

    def searched(self, readout: float) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Frequencies (F,) in Hz above those that a path follows, up to those that rows resolve in a ``readout`` in s.

        Also whether the exposure leaves a tone of a frequency (F,), and whether it changes from frame to frame (F,).
        """
        step = 0.3 / (self.times.max() - self.times.min())
        highest = min(0.5 * _CELLS / readout, max(_HIGHEST, _FRAME_RATES / self.interval))
        frequencies = np.arange(_LOWEST / self.interval, highest, step)
        is_resolved = np.abs(np.prod(np.sinc(frequencies[:, None] * np.array(self.averaged)), 1)) > _MIN_SINC
        is_visible = is_resolved & (_gain(frequencies, self.interval) > _MIN_GAIN)
        return frequencies, is_resolved, is_visible

    def strongest(
        self, axis: int, frequencies: Array, mask: NDArray[np.bool_], *, slope: float = 0.0, turns: float = 0.0
    ) -> tuple[float, float, float]:
        """The frequency that explains most of an axis, its ratio of variances, and the offsets by it (px rms).

        It is one of those ``mask`` of evenly spaced frequencies, all of which change by ``slope`` in Hz/s, and whose
        phase advances by further ``turns`` from the first to the last row, but not from frame to frame.
        """
        # 1. Means of the offsets along the axis in cells of rows, without those by the other components.
        other_knots = self.knots.copy()
        other_knots[axis] = 0.0
        offsets = (self.corners.offsets - self.explained(other_knots))[:, axis]
        row = np.clip(self.corners.rows * _CELLS, 0, _CELLS - 1).astype(np.int64)
        _, cell = np.unique(self.corners.pairs * _CELLS + row, return_inverse=True)
        # Corners far from the median of their cell do not count. The weights of the fit so far would also leave out
        # what vibrates most, and another alias of the tone would explain the rest better.
        order, sizes = np.lexsort((offsets, cell)), np.bincount(cell)
        middle = np.cumsum(sizes) - sizes + (sizes - 1) // 2
        deviation = np.abs(offsets - offsets[order[middle]][cell])
        weights = self._weights(deviation, 1.5 * float(np.median(deviation)), 1.5 * self._medians(deviation))
        total = np.maximum(np.bincount(cell, weights), 1e-9)
        early, late, residual = (np.bincount(cell, weights * values) / total for values in (*self.times.T, offsets))
        times, root = np.stack([early, late], -1), np.sqrt(total)
        # 2. Project out what the path and the tones so far explain.
        taps = spline_taps(times + self.origin, self.start, self.step, self.count)
        basis = np.diff(_basis(*taps, self.count), axis=1)[:, 0]
        values = _basis(*self.envelope(times), self.envelope_knots)
        tones = [wave_columns(tone.waves(times, self.averaged), values) for tone in self.tones if tone.axis == axis]
        known = np.concatenate([basis, *tones], 1) * root[:, None]
        gram = known.T @ known
        typical = max(float(np.median(gram.diagonal()[: self.count])), 1e-9)
        gram[: self.count, : self.count] += _STIFFNESS * typical * _squared_differences(self.count, 3)
        gram[np.diag_indices(len(gram))] += _LEAST * typical
        factor = cho_factor(gram, lower=True)
        residual = residual * root
        residual = residual - known @ cho_solve(factor, known.T @ residual)
        before = float(residual @ residual)
        half = solve_triangular(factor[0], known.T, lower=True).astype(np.float32)
        # 3. What a tone of each frequency explains of the rest: the fit of a cosine and a sine. Waves are products of
        # those of a coarse and a fine grid of frequencies, in a tenth of the time of sines and cosines.
        fine = np.exp(2j * math.pi * (frequencies[1] - frequencies[0]) * np.arange(_FINE)[:, None, None] * times.T)
        fine, single_rest, parts = fine.astype(np.complex64), residual.astype(np.float32), []
        of_rows = np.bincount(cell, weights * self.corners.rows) / total
        swept = root * np.exp(1j * math.pi * (slope * times.T**2 + 2 * turns * of_rows))
        for first in frequencies[::_FINE]:
            both = fine * (swept * np.exp(2j * math.pi * first * times.T)).astype(np.complex64)
            waves = both[:, 1] - both[:, 0]
            wave = np.stack([waves.real, waves.imag])  # cosine and sine (2, F, cells)
            hidden = wave @ half.T
            cc, ss = np.square(wave).sum(-1) - np.square(hidden).sum(-1)
            cs = (wave[0] * wave[1]).sum(-1) - (hidden[0] * hidden[1]).sum(-1)
            parts.append(np.stack([cc, ss, cs, *(wave @ single_rest)]))
        cc, ss, cs, c, s = np.concatenate(parts, -1)[:, : len(frequencies)]
        determinant = cc * ss - cs**2
        size = 0.5 * (cc + ss)  # of what remains of a wave; its phase must be determined as well
        is_visible = mask & (size > _MIN_SHARE * size[mask].max(initial=0.0)) & (determinant > 1e-2 * size**2)
        explained = (ss * c**2 - 2 * cs * c * s + cc * s**2) / np.where(is_visible, determinant, np.inf)
        # 4. The highest peak; a maximum at the edge of a band of frequencies belongs to a tone outside of it.
        inner = mask[2:] & mask[:-2] & (explained[1:-1] >= explained[:-2]) & (explained[1:-1] >= explained[2:])
        explained[1:-1] *= inner
        explained[[0, -1]] = 0.0
        best = int(explained.argmax())
        freedom = max(len(residual) - len(gram) - 3, 1)
        ratio = 0.5 * explained[best] / max((before - explained[best]) / freedom, 1e-12)
        return float(frequencies[best]), float(ratio), math.sqrt(explained[best] / float(total.sum()))


def averaging(exposure: float, row_time: float, size: tuple[int, int]) -> Averaged:
    """The times over which the displacement of a corner of frames (H, W) is a mean."""
    return exposure, _PATCH_ROWS * reduction(*size) * row_time


def fit_window(
    corners: Corners,
    interval: float,
    averaged: Averaged,
    readout: float,
    has_tones: bool = True,
    slopes: Sequence[float] | Array = (0.0,),
) -> WindowFit:
    """Fit of path and tones to the ``corners`` of all pairs of a window of frames, an ``interval`` in s apart.

    A corner is displaced by the mean of the displacement over the times ``averaged``; the ``readout`` takes from the
    first to the last row (s). Without ``has_tones``, no tones are looked for; ``slopes`` in Hz/s are those of tones.
    """
    fit = WindowFit(corners, interval, averaged)
    fit.solve(ROUNDS)
    fit = fit.of_layer()
    frequencies, is_resolved, is_visible = fit.searched(readout)
    limits = frequencies[is_visible][[0, -1]] if is_visible.any() else np.zeros(2)  # Hz
    axes = [0, 1] if has_tones and is_visible.sum() > 2 else []
    # Strongest tones by axis and slope. A tone of one axis does not change those of the other.
    peaks: dict[tuple[int, float], tuple[float, float, float]] = {}
    left_out = np.zeros((2, len(frequencies)), bool)
    while axes:
        for axis, slope in ((axis, float(slope)) for axis in axes for slope in slopes):
            if (axis, slope) not in peaks:
                mask = is_resolved if abs(slope) > _FAST else is_visible
                mask = mask & fit.is_apart(axis, frequencies) & ~left_out[axis]
                peaks[axis, slope] = fit.strongest(axis, frequencies, mask, slope=slope)
        (axis, slope), (frequency, ratio, offsets) = max(peaks.items(), key=lambda item: item[1][1])
        if ratio < MIN_RATIO or offsets < _MIN_EXPLAINED:
            break
        best, *_ = fit.with_aliases(axis, frequency, slope, limits)
        peaks = {of: value for of, value in peaks.items() if of[0] != axis}
        best.solve()
        if any(_gain(tone.frequency, interval) < _MIN_GAIN for tone in best.tones if abs(tone.slope) <= _FAST):
            # It has been corrected to a frequency that frames do not show. A part of the picture that moves by itself
            # displaces the same rows again and again: without vibration, it became tones of up to 70 px.
            blind = round(frequency * interval) / interval
            step = frequencies[1] - frequencies[0]
            left_out[axis] |= np.abs(frequencies - blind) <= abs(frequency - blind) + step
            continue
        fit = best
        axes = [axis for axis in (0, 1) if sum(one.axis == axis for one in fit.tones) < _MOST_TONES]
    # Tones that others explain in the end, that are none of all rows, or whose aliases explain them as well.
    number = -1
    for _ in range(4 * _MOST_TONES):
        if len(fit.tones) == number:
            break
        number = len(fit.tones)
        fit.solve()
        fit.keep_tones()
        changed = fit.with_distinct_tones(limits)
        if changed is not None:
            fit, number = changed, -1
    return fit
