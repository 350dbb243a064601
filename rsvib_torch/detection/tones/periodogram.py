"""Start frequencies from the data: a gain-aware least-squares periodogram, and the choice among its peaks."""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import MIN_GAIN, ToneFit, fit_roughly, residual_of, tone_response
from rsvib_torch.execution.parallel import runs
from rsvib_torch.numerics.interpolation import fourier_sums
from rsvib_torch.numerics.tables import Array, quantile, split_axis, take_stacks, without_nan

_OVERSAMPLING = 8  # grid points per 1 / duration: a peak between two of them keeps 98 % of its height
_MAX_POWERS = 2**18  # frequencies, times weightings and stacks, at a time; each takes about 1.3 kB
_TINY = 1e-300  # keeps equations solvable where nothing was measured


# --- Periodogram ---


def _power(measurements: Measurements, grid: tuple[float, int, int], weights: Array) -> Array:
    """Decrease (B, S, A, F) of the weighted sum of squares by a tone of each frequency and a uniform image motion.

    A weak prior on the amplitude suppresses blind frequencies, where a huge tone would fit noise. The grid is that of
    ``fourier_sums``; ``weights`` (B, S, N, A) are several weightings of the displacements.

    All sums over waves ``E = exp(2 pi i f t)`` are transforms. With ``A = sum_g E_g`` over the n frames that contain a
    row, the squares of the cosine and of the sine relative to their means over these frames are ``(R + Re Q) / 2`` and
    ``(R - Re Q) / 2``, and their product is ``Im Q / 2``, with ``Q = sum_g E_g^2 - A^2 / n`` and ``R = n - |A|^2 / n``.
    """
    # 1. Weights of rows and frames, and the normal equations of the image motion.
    visible, time = measurements.visible, measurements.middles[..., 0, 0]
    row_weights = weights.swapaxes(2, 3)  # (B, S, A, N)
    frame_weights = row_weights[..., None] * visible[:, None, None]  # (B, S, A, N, G)
    drift = measurements.drifts[:, None, None, :, :, 0, 0]
    values = np.moveaxis(measurements.displacements, -1, 1)[:, None]  # (B, 1, A, N, G)
    weighted_drift = frame_weights * drift
    drift_drift, drift_value = ((weighted_drift * factor).sum((-2, -1))[..., None] for factor in (drift, values))
    drift_drift = drift_drift * (1 + 1e-12) + _TINY
    total = (row_weights * measurements.num_differences[:, None, None]).sum(-1)[..., None]
    prior = 0.5 * MIN_GAIN**2 * total + _TINY

    # 2. Q and R from transforms of the pairs of frames, each pair once, with the attenuation by the exposure.
    step, first_step, count = grid
    frequencies = step * np.arange(first_step, first_step + count)
    attenuation = np.sinc(frequencies * measurements.smearing_times[:, 0]).prod(0)  # (A, F)
    earlier, later = np.triu_indices(time.shape[2])
    share = visible[..., earlier] * visible[..., later] / np.maximum(visible.sum(2, keepdims=True), 1.0)
    square_weights = np.where(earlier == later, visible[..., earlier] - share, -2 * share)
    square_weights = row_weights[..., None] * square_weights[:, None, None]
    Q = fourier_sums(time[..., earlier] + time[..., later], square_weights, grid)
    different = earlier != later
    pair_weights = row_weights[..., None] * (2 * share[..., different])[:, None, None]
    R = total - fourier_sums(time[..., later[different]] - time[..., earlier[different]], pair_weights, grid).real
    Q, R = Q * np.square(attenuation), R * np.square(attenuation)

    # 3. Products of the waves with the image motion and with the displacements.
    products = fourier_sums(time, np.stack([weighted_drift, frame_weights * values], 1), grid) * attenuation
    with_drift, with_values = np.moveaxis(products, 1, 0)

    return explained_power(Q, R + 2 * prior, with_values, with_drift, drift_value, drift_drift)


def explained_power(
    Q: Array, R: Array, with_values: Array, with_drift: Array, drift_value: Array, drift_drift: Array
) -> Array:
    """Decrease of the weighted sum of squares by a wave and an image motion.

    ``Q`` and ``R`` are weighted sums of the square of the complex wave and of its squared modulus. The others are sums
    of products: of the wave ``with_values`` and ``with_drift`` (the drift by a unit image motion), of drift and values,
    and of the drift with itself.
    """
    # Normal equations of cosine and sine after elimination of the image motion, and the decrease by their solution.
    cosine = 0.5 * (R + Q.real) - np.square(with_drift.real) / drift_drift
    sine = 0.5 * (R - Q.real) - np.square(with_drift.imag) / drift_drift
    cross = 0.5 * Q.imag - with_drift.real * with_drift.imag / drift_drift
    target = with_values - with_drift * (drift_value / drift_drift)
    decrease = sine * np.square(target.real) - 2 * cross * target.real * target.imag + cosine * np.square(target.imag)
    determinant = np.maximum(cosine * sine - np.square(cross), _TINY)
    return decrease / determinant + np.square(drift_value) / drift_drift


def strongest_frequencies(measurements: Measurements, sample_interval: float, count: int, weights: Array) -> Array:
    """Frequencies (B, S, 2, count) in Hz of the highest peaks of the periodogram of residuals, highest first.

    Measurements are ``sample_interval`` seconds apart; the search is made with each of S ``weights`` (B, S, N, 2).
    """
    # multiples of a step, from half a period up to the Nyquist limit of the samples
    step, window = 1.0 / (_OVERSAMPLING * (float(measurements.duration.max()) + sample_interval)), _OVERSAMPLING // 2
    grid = step, window, max(1, int(0.5 / sample_interval / step) - window + 1)
    stacks, weightings = weights.shape[:2]
    at_once, count = max(1, _MAX_POWERS // grid[2]), min(count, grid[2])
    places = np.empty((stacks, weightings, weights.shape[-1], count), np.int64)
    for batch in runs(stacks, max(1, at_once // weightings)):
        batch_measurements = take_stacks([measurements], np.arange(stacks)[batch])
        for weighting in runs(weightings, at_once):
            total = _power(batch_measurements, grid, weights[batch, weighting])
            # a peak is the maximum within half of 1 / duration on either side
            peak = total >= ndimage.maximum_filter1d(total, 2 * window + 1, mode="nearest")
            places[batch, weighting] = np.where(peak, -total, 1.0).argsort(-1, stable=True)[..., :count]
    return grid[0] * (places + grid[1])


# --- Choice among the peaks ---


def visibility(measurements: Measurements, frequencies: Array) -> Array:
    """(B, 2) from 0 at blind frequencies (B, 2) of the record to 1 where the gain is large.

    0 as well near multiples of 1 / T_e, where less than a tenth of the amplitude remains after the exposure: the
    residuals of long exposures, whose blur differs between frames, would be fitted by huge tones there.
    """
    response = tone_response(measurements, frequencies[..., None])[..., 0]
    gain = 4 * np.square(np.abs(response)).mean((1, 2))
    resolved = np.abs(np.sinc(frequencies * measurements.exposure_time)) > 0.1
    return gain / (gain + MIN_GAIN**2) * resolved


def without_stretches(measurements: Measurements) -> Array:
    """(8, N) bool, rows to use: all, then all but one of seven overlapping stretches of 35 %, for outliers of 24 %."""
    rows = measurements.exposure_starts.shape[1]
    place = (np.arange(rows) + 0.5) / rows
    start = np.linspace(0, 0.65, 7)[:, None]
    used = (place < start) | (place > start + 0.35)
    return np.concatenate([np.ones_like(used[:1]), used])


def best_candidate(
    measurements: Measurements,
    weighed: Measurements,
    before: ToneFit,
    residual: Array,
    active: Array,
    sample_interval: float,
    *,
    leave_out: bool,
) -> tuple[ToneFit, Array]:
    """The further tone of each axis that fits the majority of the rows best, as a rough fit and its residual.

    The peaks of the periodogram of the ``residual`` (B, N, G, 2) px of the fit ``before`` are fitted roughly, each with
    the tones of that fit. ``weighed`` are the measurements with its weights, ``active`` (B, 2, K) its tones and the
    further one. With ``leave_out``, fits without a stretch of the record, which may be covered by clouds or objects
    that move by themselves, are tried as well.
    """
    # 1. The parts of the record that are searched: all rows, and the rows without a stretch.
    parts, weights, peaks = measurements, weighed.weights[:, None], 4  # outliers may raise a wrong peak
    if leave_out:
        used = without_stretches(measurements)
        parts = measurements.repeated(len(used)).scaled(np.tile(used, (len(weights), 1))[..., None].astype(np.float64))
        weights, peaks = np.concatenate([weights, used[1:, :, None] * measurements.weights[:, None]], 1), 2
    # 2. The highest peaks of each part, for the two axes, each fitted roughly with the tones of the earlier fit.
    unexplained = replace(measurements, displacements=residual)
    peaks_of_parts = strongest_frequencies(unexplained, sample_interval, peaks, weights)  # (B, S, 2, C)
    further = peaks_of_parts.swapaxes(2, 3).reshape(-1, peaks_of_parts.shape[2], 1)  # (B S C, 2, 1)
    count = len(further) // len(peaks_of_parts)
    earlier = np.repeat(before.frequencies[..., : active.shape[-1] - 1], count, 0)
    rough, residuals = fit_roughly(
        parts.thinned().repeated(peaks_of_parts.shape[-1]),
        np.concatenate([earlier, further], -1),
        np.repeat(active, count, 0),
        before.drift_order,
    )
    # 3. For each axis the fit with the smallest residual of the best 65 % of the rows: the others may be outliers. A
    # nearly blind tone counts less.
    several = measurements.thinned().repeated(count)
    size = split_axis(without_nan(quantile(several.sizes(residuals), 0.65, 1), 0.0), 0, -1, count)
    visible = split_axis(visibility(several, rough.frequencies[..., -1]), 0, -1, count)
    best = ((size.max(1, keepdims=True) - size) * visible).argmax(1)  # (B, 2)

    def chosen(values: Array, axis: int) -> Array:
        candidates = np.moveaxis(split_axis(values, 0, -1, count), axis + 1, 2)  # (B, C, 2, ...)
        place = best.reshape(-1, 1, best.shape[-1], *(1,) * (candidates.ndim - 3))
        return np.moveaxis(np.take_along_axis(candidates, place, 1)[:, 0], 1, axis)

    best_tones = {name: chosen(getattr(rough, name), 1) for name in ("coefficients", "frequencies", "drift")}
    fit = ToneFit(**best_tones, active=active, covariance=rough.covariance[:0], centre=rough.centre[::count])
    residual = residual_of(measurements, fit)
    # 4. Without a stretch: steps towards the least absolute residuals of all rows.
    for _ in range(3 if leave_out else 0):
        fit, residual = fit_roughly(measurements.for_least_absolute(residual), fit, active)
    return fit, residual
