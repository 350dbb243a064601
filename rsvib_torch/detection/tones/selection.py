"""Number of tones: added one by one, strongest first, while they are significant, with weights against outliers."""

from dataclasses import dataclass, replace

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import (
    LARGEST,
    MIN_GAIN,
    ToneFit,
    amplitude_std,
    fit_roughly,
    fit_tones,
    offset_gain,
    residual_of,
)
from rsvib_torch.detection.tones.periodogram import best_candidate, visibility
from rsvib_torch.numerics.tables import Array, median, quantile, select_stacks, take_stacks, without_nan
from rsvib_torch.options import MAX_TONES

MIN_SIGNIFICANCE = 4.0  # amplitude over its standard deviation
MIN_OFFSET = 0.01  # px, amplitude of the offsets of a tone; interpolation and unequal blur leave up to this
F_THRESHOLD = 14.0  # decrease of chi-square per parameter: the maximum of noise over a grid of starts stays below


def robust_fit(
    measurements: Measurements,
    frequencies: Array,
    active: Array,
    drift_order: int = 1,
    residual: Array | None = None,
    *,
    steps: int = 2,
    iterations: int = 30,
) -> tuple[ToneFit, Measurements]:
    """Fit with the weights of outliers reduced in two steps (Tukey's biweight), and measurements with these weights.

    It starts from ``frequencies`` (B, 2, K) in Hz, of which some are ``active``; starts with the amplitudes of an
    earlier fit take more steps along the valleys of slow tones. With the ``residual`` (B, N, G, 2) px of an earlier fit
    there is no fit of equal weights first, and with that of a fit with reduced weights one of the ``steps`` suffices.
    """
    if residual is None:
        rough, residual = fit_roughly(measurements, frequencies, active, drift_order)
        frequencies = rough.frequencies
    for _ in range(steps - 1):
        rough, residual = fit_roughly(measurements.reweighted(residual), frequencies, active, drift_order)
        frequencies = rough.frequencies
    weighted = measurements.reweighted(residual)
    return fit_tones(weighted, frequencies, active, drift_order, iterations), weighted


_ALIASES, _WRONG_SIZE = 2, 3.0  # frequencies on either side; standard deviations of a typical row


def with_best_aliases(
    measurements: Measurements, fit: ToneFit, large_size: float = _WRONG_SIZE, max_share: float = 0.5
) -> ToneFit:
    """One tone of each axis, at the frequency ``|k / T + f|`` with the smallest residual; without covariance.

    Tones that are a multiple of 1 / T apart, T the interval of the frames, or on both sides of one, differ within a
    frame only. Bands may confuse them: in 7 of 72 stacks of 6 to 8 frames, a tone of 90.5 Hz was taken for one of 30.2
    Hz, and further tones explained the difference, so that the axis was reliable and wrong. The measurements are of
    rows, the fit has one tone of each axis. Other frequencies are tried on axes whose typical residual exceeds
    ``large_size`` standard deviations, and accepted where less than the fraction ``max_share`` of the residual remains.
    """
    size = without_nan(median(measurements.sizes(residual_of(measurements, fit)), 1), 0.0)  # (B, A)
    is_large = (size > large_size) & fit.active[..., 0]
    if not bool(is_large.any()):
        return fit
    parameters = fit.parameters[0].size
    fit = replace(fit, covariance=np.zeros((len(size), parameters, parameters)))
    thinned = measurements.thinned()
    steps = np.repeat(np.arange(-_ALIASES, _ALIASES + 1), 2)
    signs = np.tile([1.0, -1.0], len(steps) // 2)
    for axis in np.flatnonzero(is_large.any(0)):
        # 1. The aliases of the tone of this axis, each fitted roughly.
        (index,) = is_large[:, axis].nonzero()
        stacks = np.repeat(index, len(steps))
        trial, frequencies = take_stacks([thinned], stacks), fit.frequencies[stacks]
        frequencies[:, axis, 0] = np.abs(
            (signs * fit.frequencies[index, axis] + steps / measurements.interval[index, None]).ravel()
        )
        aliases, residual = fit_roughly(trial, frequencies, fit.active[stacks], fit.drift_order)
        # 2. The best alias is accepted where its residual is small enough.
        sizes = without_nan(median(trial.sizes(residual), 1), np.inf)[:, axis].reshape(len(index), -1)
        place, better = np.arange(len(size)), sizes.min(1) < max_share * size[index, axis]
        best = len(size) + np.arange(len(index)) * len(steps) + sizes.argmin(1)
        place[index[better]] = best[better]
        fit = take_stacks([fit, aliases], place)
    return fit


# Cycles within a gap that are tried on either side of a tone. The next best number leaves 3 to 130 times what the right
# one leaves; where it left less than 1.8 times as much, 5 of 6 axes that bands called reliable were wrong. Of 37 axes
# that were reliable by rows, with a gap of 5 to 150 frame periods, 4 were wrong by one cycle without this
_CYCLES, _DISTINCT = np.array([-3, -2, -1, 1, 2, 3]), 2.0
LONG_GAP = 4.0  # shortest intervals of frames


def with_best_cycles(measurements: Measurements, fit: ToneFit, gap: float) -> ToneFit:
    """The fit with the number of cycles of every tone within a gap in s between frames that leaves the least.

    Tones that differ by a cycle within the gap differ little in the frames before and behind it. The variance of the
    frequency contains a cycle where another number leaves less than twice as much.
    """
    count, axes = fit.frequencies.shape[:2]
    stacks, of_axis = np.repeat(np.arange(count), len(_CYCLES)), fit.covariance.shape[-1] // axes
    trial, doubts = take_stacks([measurements], stacks), np.zeros((count, axes, of_axis))
    for axis, tone in np.argwhere(fit.active.any(0)):
        # 1. What other numbers of cycles leave, unless their fits end at the frequency of this one.
        size = median(measurements.sizes(residual_of(measurements, fit)), 1)[:, axis]
        frequencies = fit.frequencies[stacks]
        before = frequencies[:, axis, tone].copy()
        frequencies[:, axis, tone] = np.abs(before + np.tile(_CYCLES / gap, count))
        others, residual = fit_roughly(trial, frequencies, fit.active[stacks], fit.drift_order)
        sizes = without_nan(median(trial.sizes(residual), 1), np.inf)[:, axis]
        sizes = np.where(np.abs(others.frequencies[:, axis, tone] - before) * gap < 0.5, np.inf, sizes)
        sizes = np.concatenate([size[:, None], sizes.reshape(count, -1)], 1)
        # 2. The best number, and whether another one is as good.
        best, ordered = sizes.argmin(1), np.sort(sizes, 1)
        doubts[:, axis, 3 * tone + 2] = (ordered[:, 1] < _DISTINCT * ordered[:, 0]) & fit.active[:, axis, tone]
        better = (best > 0) & fit.active[:, axis, tone]
        if better.any():
            frequencies = fit.frequencies.copy()
            frequencies[better] = others.frequencies[(np.arange(count) * len(_CYCLES) + best - 1)[better]]
            fit = fit_tones(measurements, frequencies, fit.active, fit.drift_order)
    variance = (doubts / gap**2).reshape(count, -1)
    return replace(fit, covariance=fit.covariance + variance[..., None] * np.eye(variance.shape[-1]))


def typical_size(measurements: Measurements, fit: ToneFit) -> Array:
    """(B,) median square of the normalised residual of both axes, which stretches of outliers hardly raise."""
    return np.square(median(measurements.sizes(residual_of(measurements, fit)), 1)).sum(-1)


def find_tones(
    measurements: Measurements,
    sample_interval: float,
    tones: int | None = None,
    drift_order: int = 1,
    least_gain: float = 0.2,
    start: ToneFit | None = None,
    blind: Array | None = None,
    accuracy: float = 0.0,
    *,
    stretches: bool = True,
    iterations: int = 30,
) -> ToneFit:
    """Find and fit the tones of both axes; K is the largest number of any axis, at least 1.

    The strongest tone of the gain-aware periodogram is added and all parameters are fitted again, until ``tones`` are
    found, or until the next one is not significant: it must pass an F-test and explain ``least_gain`` of the residual.
    Rows or bands are ``sample_interval`` seconds apart. ``tones`` are those of each axis, None to choose their number
    from the data; those of the fit ``start`` are accepted. ``blind`` (F,) in Hz are the blind frequencies of the
    frames, to recognise side tones. A fit is good enough once nearly all residuals of an axis are below the
    ``accuracy`` in px. ``stretches``: whether the search allows for stretches of outliers, if there is no start;
    ``drift_order`` and ``iterations`` as in ``fit_tones``.
    """
    stretches = stretches and start is None
    search = _Search(
        measurements, sample_interval, tones, drift_order, least_gain, start, accuracy, stretches, iterations
    )
    while search.step():
        pass
    if blind is None or tones is not None:
        return search.fit
    return _with_blind_tones(measurements, search.weighted, search.fit, blind)


@dataclass(eq=False)
class _Search:
    """State of ``find_tones``; the fields are its arguments."""

    measurements: Measurements
    sample_interval: float
    tones: int | None
    drift_order: int
    least_gain: float
    start: ToneFit | None
    accuracy: float
    stretches: bool
    iterations: int

    def __post_init__(self) -> None:
        start = self.start
        stacks, axes = len(self.measurements.exposure_starts), self.measurements.displacements.shape[-1]
        # the tones that are accepted, the fit with them, and the measurements with its weights
        if start is None:
            none = np.zeros((stacks, axes, 1), dtype=bool)
            self.accepted = none[..., :0]
            self.fit, self.weighted = self.refitted(none.astype(np.float64), none)
        else:
            self.accepted = start.active
            residual = residual_of(self.measurements, start)
            self.fit, self.weighted = self.refitted(start.frequencies, start.active, residual)
        self.open_axes: Array = np.ones((stacks, axes), dtype=bool)  # axes that may need a further tone
        if start is not None and self.accuracy:  # a tone of roll in bands of strips is found as one of x or y otherwise
            self.open_axes = ~np.any(start.active, -1)
        self.remaining = MAX_TONES - (0 if self.tones is not None else self.accepted.shape[-1])

    def step(self) -> bool:
        """Add a tone to the axes that need it; False if no axis does, or none is significant."""
        self.remaining -= 1
        if self.remaining < 0:
            return False
        # 1. The axes that need a further tone: those with fewer tones than requested, or with a large residual.
        first = self.accepted.shape[-1] == 0
        if self.tones is not None:  # roll and zoom may have fewer tones than x and y to start with
            self.open_axes = self.accepted.sum(-1) < self.tones
        residual = residual_of(self.measurements, self.fit)
        if not first:
            self.open_axes = self.open_axes & self.is_inexact(residual)
        if not bool(self.open_axes.any()):
            return False
        # 2. The best candidate, fitted roughly. Most further tones fail the F-test by far, and are not fitted exactly:
        # with exact fits of them, a tone of 25 px in a street was 47 px and reliable. Offsets of bands need exact fits.
        rough = self.candidate(residual, self.with_one_more())
        if self.tones is None and self.start is not None and not first:
            self.open_axes = self.open_axes & self.decreases(self.weighted, residual, rough[1], share=0.25)
            if not bool(self.open_axes.any()):
                return False
        # 3. The exact fit with it.
        fit, weighted = self.fitted(residual, rough)
        # 4. Accept it on the axes where it is significant, resolved and visible; the first one is kept even if it is
        # nearly blind, for the verdict. Both fits are compared with the weights of the richer one.
        if self.tones is None:
            passed = self.decreases(weighted, residual, residual_of(self.measurements, fit))
            passed = self.open_axes & passed & _resolved(self.measurements, fit) & (self.is_visible(fit) | first)
            while bool(passed.any()) and not bool((passed == self.open_axes).all()):
                self.open_axes = passed
                fit, weighted = self.refitted(fit.frequencies, self.with_one_more())
                passed = passed & (self.is_visible(fit) | first)
            if not bool(passed.any()):
                return False
        self.fit, self.weighted, self.accepted = fit, weighted, fit.active
        return True

    def with_one_more(self) -> Array:
        """(B, 2, K) bool, the accepted tones and a further one of the axes that need it."""
        return np.concatenate([self.accepted, self.open_axes[..., None]], -1)

    def refitted(
        self, frequencies: Array, active: Array, residual: Array | None = None
    ) -> tuple[ToneFit, Measurements]:
        """``robust_fit`` of all measurements."""
        order, iterations = self.drift_order, self.iterations
        return robust_fit(self.measurements, frequencies, active, order, residual, iterations=iterations)

    def candidate(self, residual: Array, active: Array, *, leave_out: bool = False) -> tuple[ToneFit, Array]:
        """``best_candidate``: a rough fit with a further tone, and its residual."""
        return best_candidate(
            self.measurements, self.weighted, self.fit, residual, active, self.sample_interval, leave_out=leave_out
        )

    def fitted(self, residual: Array, rough: tuple[ToneFit, Array]) -> tuple[ToneFit, Measurements]:
        """The fit with a further tone, of all rows or without a stretch, and the measurements with its weights."""
        active = self.with_one_more()
        fit, weighted = self.refitted(rough[0].frequencies, active, rough[1])
        if not self.stretches:
            return fit, weighted
        after, sizes = residual_of(self.measurements, fit), self.measurements.sizes
        # (B,) bool: a stretch of outliers may have biased a fit, which leaves more than 5 % of the motion of some rows
        is_explained = quantile(sizes(after), 0.9, 1) < 0.05 * median(sizes(self.measurements.displacements), 1)
        disturbed = ~is_explained.all(-1) & self.is_inexact(after).any(-1)
        if not bool(disturbed.any()):
            return fit, weighted
        rough = self.candidate(residual, active, leave_out=True)
        without_stretch, weighted_without = self.refitted(rough[0].frequencies, active, rough[1])
        better = disturbed & (typical_size(self.measurements, without_stretch) < typical_size(self.measurements, fit))
        return select_stacks(better, without_stretch, fit), select_stacks(better, weighted_without, weighted)

    def is_visible(self, fit: ToneFit) -> Array:
        """(B, 2) bool, whether the last tone of each axis is visible."""
        return visibility(self.measurements, fit.frequencies[..., -1]) > 0.5

    def is_inexact(self, residual: Array) -> Array:
        """(B, 2) bool, axes with residuals above the accuracy that is needed."""
        large_distance = without_nan(quantile(self.measurements.distances(residual), 0.9, 1), np.inf)
        return (large_distance > self.accuracy) | (self.accuracy == 0)

    def decreases(self, weighted: Measurements, before: Array, after: Array, *, share: float = 1.0) -> Array:
        """(B, 2) bool, whether the residual decreases by a share of the amount that a further tone needs."""
        square_before, square_after = weighted.square(before), weighted.square(after)
        spare = self.measurements.num_measurements - 3 * self.with_one_more().sum(-1) - 1
        needed = np.maximum(F_THRESHOLD * 3 * square_after / np.maximum(spare, 1.0), self.least_gain * square_before)
        return square_before - square_after > share * needed


# of 1 / duration. 80 recordings of two tones on each axis, 0.2 to 0.9 apart: 73 of 160 axes are reliable, the rms of z
# of their parameters is 0.96. With 0.7 20, with 0 93 axes, of which one is wrong by 1 %, 7 standard deviations
_RESOLUTION = 0.35


def _resolved(measurements: Measurements, fit: ToneFit) -> Array:
    """(B, 2) bool: the tones of an axis are further apart than the resolution; closer ones fit one tone and noise."""
    order = np.sort(np.where(fit.active, fit.frequencies, np.nan), -1)
    return ~((order[..., 1:] - order[..., :-1]) * measurements.span[:, None, None] < _RESOLUTION).any(-1)


def _with_blind_tones(measurements: Measurements, weighted: Measurements, fit: ToneFit, blind: Array) -> ToneFit:
    """The fit with a tone of a blind frequency in place of its side tones, where that explains as much.

    With motion of frequency f_m along the scan, rows are not exactly one frame apart when they are compared. A tone of
    a blind frequency f_b then appears as weak tones at f_b + f_m and |f_b - f_m|. The tone itself, which the verdict
    recognises as blind, is the simpler explanation.
    """
    if len(blind) == 0:
        return fit
    # 1. Weak tones near the side frequencies of a blind frequency and a large tone along the scan.
    size = fit.amplitude
    weak_limit = 0.2 * size[:, 1].max(-1, keepdims=True)  # px; side tones are weaker
    carrier = np.where(size[:, 1] > weak_limit, fit.frequencies[:, 1], np.nan)[:, None, None, None]  # (B,1,1,1,K)
    tone, middle = fit.frequencies[..., None, None], blind[:, None]
    sides = np.stack([middle + carrier, np.abs(middle - carrier)], -1)  # (B, 1, 1, F, K, 2)
    distance = np.abs(tone[..., None] - sides) * measurements.span.reshape(-1, 1, 1, 1, 1, 1)
    distance = without_nan(distance, np.inf).min((-2, -1))  # (B, 2, K, F) cycles in the record
    weak = fit.active & (size > 0) & (size < weak_limit[:, None])
    is_near = (distance < 1.0) & weak[..., None]
    # 2. For each axis the blind frequency with most side tones, then the nearest.
    best = (is_near.sum(2) + 0.5 / (1 + distance.min(2))).argmax(-1)  # (B, 2)
    side = np.take_along_axis(is_near, best[:, :, None, None], -1)[..., 0]  # (B, 2, K)
    suspected = np.any(side, -1)
    if not bool(suspected.any()):
        return fit
    place = side & (side.cumsum(-1) == 1)  # the blind tone takes the place of the first of them

    def replaced(axes: Array) -> tuple[Array, Array]:
        changed = axes[..., None]
        frequencies = np.where(place & changed, blind[best][..., None], fit.frequencies)
        return frequencies, fit.active & ~(side & ~place & changed)

    # 3. The tone of this frequency instead of its side tones, accepted where it explains as much per parameter.
    frequencies, active = replaced(suspected)
    blind_fit = fit_tones(weighted, frequencies, active, fit.drift_order)
    before = weighted.square(residual_of(measurements, fit))
    after = weighted.square(residual_of(measurements, blind_fit))
    spare = measurements.num_measurements - 3 * fit.active.sum(-1)
    fewer = 3 * (fit.active.sum(-1) - active.sum(-1))
    better = suspected & (after / np.maximum(spare + fewer, 1.0) <= before / np.maximum(spare, 1.0))
    # frames without motion along the scan contain nothing of a blind tone: its fitted amplitude was 3e16 px
    better = better & (blind_fit.amplitude < np.array(LARGEST)[: size.shape[1], None]).all(-1)
    if not bool(better.any()):
        return fit
    frequencies, active = replaced(better)
    return robust_fit(measurements, frequencies, active, fit.drift_order)[0]


def too_small(fit: ToneFit, intervals: Array, exposure_time: float) -> Array:
    """(B, A, K) bool, tones of large gain whose offsets are below ``MIN_OFFSET``."""
    gain = offset_gain(fit.frequencies, intervals)
    attenuation = np.abs(np.sinc(fit.frequencies * exposure_time))
    small: Array = (fit.amplitude * attenuation * gain < MIN_OFFSET) & (gain >= MIN_GAIN)
    return small & fit.active


def significant_only(measurements: Measurements, fit: ToneFit, intervals: Array) -> ToneFit:
    """The fit without the tones, other than the strongest of an axis, that are not significant or too small.

    A tone is significant if its amplitude is, or if the fit without it fails the F-test: the amplitudes of two tones
    that the record hardly resolves are uncertain, although both are needed. Tones of large gain whose offsets are below
    ``MIN_OFFSET`` may be residuals of interpolation and blur. Where the gain is small, small offsets do not mean a
    small amplitude, and the tone stays for the verdict.
    """
    needed = np.zeros_like(fit.active)
    while True:
        # 1. The weakest tone of each axis that is neither significant nor needed.
        size, std = fit.amplitude, amplitude_std(fit)
        small = too_small(fit, intervals, measurements.exposure_time)
        is_kept = ((size > MIN_SIGNIFICANCE * std) & ~small) | (size == size.max(-1, keepdims=True)) | needed
        weak = fit.active & ~is_kept
        ratio = np.where(weak, size / np.maximum(std, 1e-300), np.inf)
        dropped = (ratio == ratio.min(-1, keepdims=True)) & weak
        if not bool(dropped.any()):
            return fit
        # 2. The fit without it. It is needed if the residual then increases significantly.
        reduced = fit_tones(measurements, fit, fit.active & ~dropped)
        after = measurements.square(residual_of(measurements, fit))
        before = measurements.square(residual_of(measurements, reduced))
        spare = measurements.num_measurements - 3 * fit.active.sum(-1)
        worse = before - after > F_THRESHOLD * 3 * after / np.maximum(spare, 1.0)
        is_needed = dropped & worse[..., None] & ~small
        needed = needed | is_needed
        if bool(is_needed.any()):
            fit = fit_tones(measurements, fit.frequencies, fit.active & ~dropped | is_needed, fit.drift_order)
        else:
            fit = reduced
