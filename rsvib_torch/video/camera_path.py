"""The path of a camera and its vibration, from corners that are followed from frame to frame.

A corner at the place p (px from the centre of the frame) is exposed at the time t of its row. Between two frames it is
displaced by ``B(p) (P(t') - P(t)) + V(t') - V(t)``. The path P has the components x, y (px), roll (rad) and zoom, with
``B(p) = [[1, 0, -p_y, p_x], [0, 1, p_x, p_y]]``; the vibration V is a sum of tones along x and y. P is a cubic B-spline
with two knots per frame, which follows a hand. Tones are found in a periodogram from which everything that P explains
has been projected out. Both are fitted together, with weights that leave out moving objects.
"""

import math
from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.splines import spline_taps
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import Corners, reduction

WINDOW_FRAMES = 96  # of one fit; amplitudes and frequencies may change from window to window
_MOST_TONES = 3  # of an axis in a window
_KNOTS = 2  # of the spline per frame; with one, residuals of hand-held clips are 1.7 times as large
_STIFFNESS = 1e-3  # of the third difference of the spline, in units of the information of a typical knot
_CELLS = 24  # of the rows, in which the search for tones takes means; resolves tones of 12 periods per readout
_MIN_RATIO = 60.0  # of the variance that a tone explains and that of the rest; compression and parallax reach 40
_MIN_EXPLAINED = 0.03  # px rms, of the offsets that a tone explains; smaller ones are not visible in a video
_LOWEST = 0.6  # of the frame rate; the path follows slower motion
_MIN_GAIN = 0.15  # |2 sin(pi f T)|; tones close to a multiple of the frame rate hardly change from frame to frame
_MIN_SINC = 0.1  # of the amplitude that remains in the mean over the exposure
# rows of the patch of a corner, over which its displacement is a mean: amplitudes of 52 to 205 Hz are then right within
# 1 to 2 %, and 2 to 15 % too small without
_PATCH_ROWS = 10
_ALIASES = 2  # frequencies on each side of a tone that are compared with it
_ROUNDS = 4  # of a robust fit
_SOFT = 3.0  # standard deviations, at which a corner has a quarter of the weight


Averaged = tuple[float, float]  # s, the exposure, and the time in which the rows of the patch of a corner are read


@dataclass(eq=False)
class Tone:
    """A tone of one axis of the vibration in a window."""

    axis: int  # 0: x, 1: y
    frequency: float  # Hz
    coefficient: complex = 0.0  # px; the displacement is Re c exp(2 pi i f (t - origin))
    amplitude_std: float = math.inf  # px
    frequency_std: float = math.inf  # Hz

    def at(self, time: float, weight: float = 1.0) -> "Tone":
        """The tone with the time origin moved to a time in s, and multiplied by a weight."""
        turned = weight * self.coefficient * complex(np.exp(2j * math.pi * self.frequency * time))
        return replace(self, coefficient=turned, amplitude_std=weight * self.amplitude_std)

    def columns(self, times: Array, averaged: Averaged) -> Array:
        """(N, 3), offsets between both times (N, 2) by Re c, Im c and a change of the frequency in Hz."""
        waves = np.exp(2j * math.pi * self.frequency * times) * np.prod(np.sinc(self.frequency * np.array(averaged)))
        slope = 2j * math.pi * times * waves * self.coefficient
        return np.stack([part[:, 1] - part[:, 0] for part in (waves.real, -waves.imag, slope.real)], -1)


@dataclass(frozen=True, eq=False)
class WindowPath:
    """Path and tones in one window of frames."""

    origin: float  # s, the time origin of the tones: the middle of the window
    start: float  # s, of the first knot
    step: float  # s, between knots
    knots: Array  # (N, 4) coefficients of the spline
    tones: tuple[Tone, ...]
    residual: float  # px, robust standard deviation of the offsets of corners along one axis

    def path(self, times: Array, derivative: int = 0) -> Array:
        """(N, 4) components of the path, or their derivatives, at times (N,) in s."""
        index, weights = spline_taps(times, self.start, self.step, len(self.knots), derivative=derivative)
        return np.einsum("nk,nka->na", weights, self.knots[index])


def _differences(index: NDArray[np.int64], factors: Array, count: int) -> Array:
    """(N, count), differences between both times (N, 2) of the B-splines from ``spline_taps``."""
    basis = np.zeros((len(index), count))
    np.add.at(basis, (np.arange(len(index))[:, None, None], index), factors * [[-1.0], [1.0]])
    return basis


def _robust_weights(distance: Array, std: float) -> Array:
    """Weights of residuals of the size ``distance`` with a standard deviation, which is at least 0.001 px."""
    return 1.0 / (1.0 + (distance / (_SOFT * max(std, 1e-3))) ** 2) ** 2


class _WindowFit:
    """The robust fit of path and tones to the corners of one window."""

    def __init__(self, corners: Corners, interval: float, averaged: Averaged) -> None:
        self.corners, self.step, self.averaged = corners, interval / _KNOTS, averaged
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
        ends = np.append(np.nonzero(np.diff(corners.pairs))[0] + 1, len(factors))
        for begin, stop in pairwise((0, *ends)):
            part = slice(int(begin), int(stop))
            low, knots = int(index[part].min()), int(index[part].max()) + 1
            basis = _differences(index[part] - low, weights[part], knots - low)
            columns = np.einsum("nac,nk->anck", factors[part], basis).reshape(2, len(basis), -1)
            unknowns = (np.arange(4)[:, None] * self.count + np.arange(low, knots)).ravel()
            self.pairs.append((part, unknowns, columns))
        third = np.diff(np.eye(self.count), 3, axis=0)
        self.penalty = third.T @ third
        self.tones: list[Tone] = []
        self.weights = np.ones(len(factors))
        self.sigma = math.inf
        self.knots = np.zeros((4, self.count))

    def explained(self, knots: Array) -> Array:
        """(N, 2) px, offsets of the corners by a path with these knots (4, count)."""
        offsets = np.empty_like(self.corners.offsets)
        for part, unknowns, columns in self.pairs:
            offsets[part] = (columns @ knots.ravel()[unknowns]).T
        return offsets

    def solve(self, rounds: int = 2) -> None:
        """Fit path and tones; each round corrects the weights and, to first order, the frequencies."""
        size, extra = 4 * self.count, 3 * len(self.tones)
        limit = 0.25 / (self.times.max() - self.times.min())  # Hz, of a change, which is linear within a period
        for _ in range(rounds):
            waves = np.zeros((2, len(self.times), extra))
            for number, tone in enumerate(self.tones):
                waves[tone.axis, :, 3 * number : 3 * number + 3] = tone.columns(self.times, self.averaged)
            gram, right = np.zeros((size + extra, size + extra)), np.zeros(size + extra)
            for part, unknowns, columns in self.pairs:
                both = np.concatenate([columns, waves[:, part]], -1).reshape(2 * columns.shape[1], -1)
                index = np.concatenate([unknowns, np.arange(size, size + extra)])
                heavy = both.T * np.tile(self.weights[part], 2)
                gram[np.ix_(index, index)] += heavy @ both
                right[index] += heavy @ self.corners.offsets[part].T.ravel()
            self._regularise(gram, size)
            factor = cho_factor(gram, lower=True, overwrite_a=True, check_finite=False)
            solution = cho_solve(factor, right)
            self.knots = solution[:size].reshape(4, self.count)
            residual = self.corners.offsets - self.explained(self.knots) - (waves @ solution[size:]).T
            length = np.hypot(*residual.T)
            self.sigma = max(float(np.median(length)) / 1.177, 1e-3)  # of two normal components: 1.177 std
            self.weights = _robust_weights(length, self.sigma)
            variance = np.abs(cho_solve(factor, np.eye(size + extra)[:, size:])[size:].diagonal())
            for number, tone in enumerate(self.tones):
                part = slice(size + 3 * number, size + 3 * number + 3)
                real, imaginary, change = solution[part]
                tone.frequency += float(np.clip(change, -limit, limit)) * (tone.coefficient != 0)
                tone.coefficient = complex(real, imaginary)
                of_tone = variance[3 * number : 3 * number + 3]
                tone.amplitude_std = self.sigma * math.sqrt(of_tone[:2].max())
                tone.frequency_std = self.sigma * math.sqrt(of_tone[2])

    def _regularise(self, gram: Array, size: int) -> None:
        """Add the stiffness of the path, whose columns are the first ones, and a little for what is not determined."""
        typical = max(float(np.median(gram.diagonal()[:size])), 1e-9)
        for first in range(0, size, self.count):
            part = slice(first, first + self.count)
            gram[part, part] += _STIFFNESS * typical * self.penalty
        gram[np.diag_indices(len(gram))] += 1e-9 * typical

    def with_tone(self, tone: Tone) -> "_WindowFit":
        """The fit with one more tone."""
        other = copy(self)
        other.tones, other.weights = [*(copy(one) for one in self.tones), tone], np.ones_like(self.weights)
        other.solve(_ROUNDS)
        return other

    def is_apart(self, axis: int, frequencies: Array) -> NDArray[np.bool_]:
        """Whether frequencies are those of none of the tones of an axis, which the window does not separate."""
        resolved = 2.0 / (self.times.max() - self.times.min())
        others = [tone.frequency for tone in self.tones if tone.axis == axis]
        return np.all([np.abs(frequencies - other) > resolved for other in others] or [frequencies > 0], axis=0)

    def strongest(self, axis: int, frequencies: Array) -> tuple[Tone, float, float]:
        """The tone that explains most of an axis, its ratio of variances, and the offsets that it explains (px rms)."""
        # 1. Means of the offsets along the axis in cells of rows, without those by the other components.
        others = self.knots.copy()
        others[axis] = 0.0
        offsets = (self.corners.offsets - self.explained(others))[:, axis]
        row = np.clip(self.corners.rows * _CELLS, 0, _CELLS - 1).astype(np.int64)
        _, cell = np.unique(self.corners.pairs * _CELLS + row, return_inverse=True)
        # Corners far from the median of their cell do not count. The weights of the fit so far would also leave out
        # what vibrates most, and another alias of the tone would explain the rest better.
        order, sizes = np.lexsort((offsets, cell)), np.bincount(cell)
        middle = np.cumsum(sizes) - sizes + (sizes - 1) // 2
        apart = np.abs(offsets - offsets[order[middle]][cell])
        weights = _robust_weights(apart, 1.5 * float(np.median(apart)))
        total = np.maximum(np.bincount(cell, weights), 1e-9)
        early, late, rest = (np.bincount(cell, weights * values) / total for values in (*self.times.T, offsets))
        times, root = np.stack([early, late], -1), np.sqrt(total)
        # 2. Project out what the path and the tones so far explain.
        basis = _differences(*spline_taps(times + self.origin, self.start, self.step, self.count), self.count)
        tones = [tone.columns(times, self.averaged)[:, :2] for tone in self.tones if tone.axis == axis]
        known = np.concatenate([basis, *tones], 1) * root[:, None]
        gram = known.T @ known
        self._regularise(gram, self.count)
        factor = cho_factor(gram, lower=True)
        rest = rest * root
        rest = rest - known @ cho_solve(factor, known.T @ rest)
        before = float(rest @ rest)
        half = solve_triangular(factor[0], known.T, lower=True).astype(np.float32)
        # 3. What a tone of each frequency explains of the rest: the fit of a cosine and a sine.
        explained = np.zeros(len(frequencies))
        single_rest, single_root = rest.astype(np.float32), root.astype(np.float32)[:, None]
        for some in np.array_split(np.arange(len(frequencies)), max(1, len(frequencies) // 256)):
            angles = 2 * math.pi * frequencies[some] * times[..., None]
            cosine = ((np.cos(angles[:, 1]) - np.cos(angles[:, 0])) * single_root).astype(np.float32)
            sine = ((np.sin(angles[:, 1]) - np.sin(angles[:, 0])) * single_root).astype(np.float32)
            hidden = half @ cosine, half @ sine
            cc = np.square(cosine).sum(0) - np.square(hidden[0]).sum(0)
            ss = np.square(sine).sum(0) - np.square(hidden[1]).sum(0)
            cs = (cosine * sine).sum(0) - (hidden[0] * hidden[1]).sum(0)
            c, s = single_rest @ cosine, single_rest @ sine
            determinant = cc * ss - cs**2
            is_visible = determinant > 1e-2 * (cc + cs).max() ** 2
            explained[some] = (ss * c**2 - 2 * cs * c * s + cc * s**2) / np.where(is_visible, determinant, np.inf)
        # 4. The highest peak; a maximum at the edge of a band of frequencies belongs to a tone outside of it.
        spacing = np.diff(frequencies)
        inner = np.maximum(spacing[1:], spacing[:-1]) < 1.5 * spacing.min(initial=np.inf)
        inner &= (explained[1:-1] >= explained[:-2]) & (explained[1:-1] >= explained[2:])
        explained[1:-1] *= inner
        explained[[0, -1]] = 0.0
        best = int(explained.argmax())
        freedom = max(len(rest) - len(gram) - 3, 1)
        ratio = 0.5 * explained[best] / max((before - explained[best]) / freedom, 1e-12)
        return Tone(axis, float(frequencies[best])), float(ratio), math.sqrt(explained[best] / float(total.sum()))


def fit_window(corners: Corners, interval: float, averaged: Averaged, readout: float) -> WindowPath:
    """Path and tones of the ``corners`` of all pairs of a window of frames, which are an ``interval`` in s apart.

    A corner is displaced by the mean of the displacement over the times ``averaged``; the ``readout`` takes from the
    first to the last row (s).
    """
    fit = _WindowFit(corners, interval, averaged)
    fit.solve(_ROUNDS)
    # Frequencies above those that the path follows, up to those that rows and exposure resolve, without blind ones.
    step = 0.3 / (fit.times.max() - fit.times.min())
    highest = min(0.5 * _CELLS / readout, 1.0 / max(*averaged, 1e-9))
    frequencies = np.arange(_LOWEST / interval, highest, step)
    is_visible = np.abs(2 * np.sin(math.pi * frequencies * interval)) > _MIN_GAIN
    frequencies = frequencies[is_visible & (np.prod(np.sinc(frequencies[:, None] * np.array(averaged)), 1) > _MIN_SINC)]
    axes = [0, 1] if len(frequencies) else []
    while axes:
        found = [fit.strongest(axis, frequencies[fit.is_apart(axis, frequencies)]) for axis in axes]
        tone, ratio, offsets = max(found, key=lambda item: item[1])
        if ratio < _MIN_RATIO or offsets < _MIN_EXPLAINED:
            break
        # Frequencies one period per frame apart differ within the readout only, where the path follows a part of the
        # tone: they are compared by what remains of both axes.
        aliases = tone.frequency + np.arange(-_ALIASES, _ALIASES + 1) / interval
        inside = (aliases > frequencies[0]) & (aliases < frequencies[-1])
        aliases = aliases[inside & fit.is_apart(tone.axis, aliases)]
        trials = [fit.with_tone(replace(tone, frequency=float(frequency))) for frequency in aliases]
        fit = min(trials, key=lambda trial: trial.sigma)
        axes = [axis for axis in (0, 1) if sum(one.axis == axis for one in fit.tones) < _MOST_TONES]
    fit.solve()
    knots = fit.knots.T / np.array([1.0, 1.0, fit.reach, fit.reach])
    return WindowPath(fit.origin, fit.start, fit.step, knots, tuple(fit.tones), fit.sigma)


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The path and the vibration of a camera over all frames of a video; windows overlap by half."""

    windows: tuple[WindowPath, ...]

    def _weights(self, times: Array) -> Array:
        """(W, N) weights of the windows at times, which change linearly between the middles of neighbours."""
        centres = [window.origin for window in self.windows]
        return np.stack([np.interp(times, centres, unit) for unit in np.eye(len(centres))])

    def _mean(self, times: Array, values: Callable[[WindowPath], Array]) -> Array:
        """(N, 4) mean of values (N, 4) of the windows at times."""
        total = np.zeros((len(times), 4))
        for weight, window in zip(self._weights(times), self.windows, strict=True):
            if weight.any():
                total += weight[:, None] * values(window)
        return total

    def places(self, times: Array) -> Array:
        """(N, 4) components of the path at increasing times (N,) in s, 0 at the first."""
        steps = self._mean(0.5 * (times[1:] + times[:-1]), lambda window: np.diff(window.path(times), axis=0))
        return np.concatenate([np.zeros((1, 4)), np.cumsum(steps, 0)])

    def derivatives(self, times: Array, order: int) -> Array:
        """(N, 4) first or second derivative of the components of the path, per s or s^2."""
        return self._mean(times, lambda window: window.path(times, order))

    def tones(self, time: float) -> list[Tone]:
        """Tones around a time in s, which is the origin of their phases."""
        weights = self._weights(np.array([time]))[:, 0]
        return [
            tone.at(time - window.origin, float(weight))
            for weight, window in zip(weights, self.windows, strict=True)
            if weight > 0
            for tone in window.tones
        ]

    def nearest(self, time: float) -> WindowPath:
        """The window whose middle is nearest to a time in s."""
        return min(self.windows, key=lambda window: abs(window.origin - time))


def camera_path(pairs: Iterable[Corners | None], timing: SensorTiming, size: tuple[int, int]) -> CameraPath:
    """Path of a camera from the corners of all pairs of neighbouring frames (None where there are too few).

    A ``ValueError`` is raised if no window of frames has corners in a quarter of its pairs.
    """
    readout = timing.row_time * size[0 if timing.scan_axis == -2 else 1]
    averaged = timing.exposure_time, _PATCH_ROWS * reduction(*size) * timing.row_time
    windows: list[WindowPath] = []
    waiting: list[Corners | None] = []

    def fit() -> None:
        known = [pair for pair in waiting if pair is not None]
        if len(known) >= max(2, len(waiting) // 4):
            windows.append(fit_window(Corners.joined(known), timing.frame_period, averaged, readout))

    fitted = 0
    for pair in pairs:
        waiting.append(pair)
        if len(waiting) == WINDOW_FRAMES:
            fit()
            waiting, fitted = waiting[WINDOW_FRAMES // 2 :], WINDOW_FRAMES // 2
    if len(waiting) > fitted:
        fit()
    if not windows:
        raise ValueError(
            "no motion was found that the corners of the frames have in common: the frames show different scenes, or "
            "no detail"
        )
    return CameraPath(tuple(windows))


def shake(corners: Corners) -> tuple[Array, float]:
    """How a frame moves against the one before: (2,) px of its centre, and px rms of twelfths of its rows beside that.

    The motion of the frame is a displacement with roll and zoom; rows that move apart from it show a rolling shutter.
    """
    columns = corners.factors
    weight = np.ones(len(columns))
    for _ in range(_ROUNDS):
        heavy = columns * weight[:, None, None]
        gram = np.einsum("nai,naj->ij", heavy, columns) + 1e-9 * np.eye(4)
        motion = np.linalg.solve(gram, np.einsum("nai,na->i", heavy, corners.offsets))
        rest = corners.offsets - columns @ motion
        length = np.hypot(*rest.T)
        weight = _robust_weights(length, float(np.median(length)))
    part = (corners.rows * 12).astype(np.int64)
    bands = [np.median(rest[part == number], 0) for number in range(12) if (part == number).sum() > 4]
    return motion[:2], float(np.sqrt(np.mean(np.square(bands)))) if bands else 0.0
