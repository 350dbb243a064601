"""Start frequencies from the data: a gain-aware least-squares periodogram, and the choice among its peaks."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.core.fourier import fast_length
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import MIN_GAIN, ToneFit, fit_roughly, tone_response

__all__ = ["best_candidate", "strongest_frequencies", "visibility"]

_OVERSAMPLING = 8  # grid points per 1 / duration: a peak between two of them keeps 98 % of its height
_CHUNK = 2**21  # values at a time
_TINY = 1e-300  # keeps equations solvable where nothing was measured


# --- Periodogram ---


def _grid(duration: float, sample_interval: float) -> tuple[float, int, int]:
    """Step in Hz, first and number of the multiples of it from half a period up to the Nyquist limit of the samples."""
    step = 1.0 / (_OVERSAMPLING * (duration + sample_interval))
    first = _OVERSAMPLING // 2
    return step, first, max(1, int(0.5 / sample_interval / step) - first + 1)


def _power(measurements: Measurements, grid: tuple[float, int, int], weights: Tensor) -> Tensor:
    """Decrease of the weighted sum of squares by a tone of each frequency and a uniform image motion.

    A weak prior on the amplitude suppresses blind frequencies, where a huge tone would fit noise.

    All sums over waves ``E = exp(2 pi i f t)`` are transforms. With ``A = sum_g E_g`` over the n frames that contain a
    row, the squares of the cosine and of the sine relative to their means over these frames are
    ``(R + Re Q) / 2`` and ``(R - Re Q) / 2``, and their product is ``Im Q / 2``, with ``Q = sum_g E_g^2 - A^2 / n`` and
    ``R = n - |A|^2 / n``.

    Args:
        measurements: The displacements.
        grid: Frequencies, from ``_grid``.
        weights: (B, S, N, A), several weightings of the displacements.

    Returns:
        Weighted squares (B, S, A, F).
    """
    # 1. Weights of rows and frames, and the normal equations of the image motion.
    seen, time = measurements.visible, measurements.middles[..., 0, 0]
    of_rows = weights.transpose(2, 3)  # (B, S, A, N)
    frame_weights = of_rows[..., None] * seen[:, None, None]  # (B, S, A, N, G)
    drift = measurements.drifts[:, None, None, ..., 0]
    values = measurements.displacements.movedim(-1, 1)[:, None]  # (B, 1, A, N, G)
    of_drift = frame_weights * drift
    drift_drift, drift_value = ((of_drift * factor).sum((-2, -1))[..., None] for factor in (drift, values))
    drift_drift = drift_drift * (1 + 1e-12) + _TINY
    most = (of_rows * measurements.num_differences[:, None, None]).sum(-1)[..., None]
    prior = 0.5 * MIN_GAIN**2 * most + _TINY

    # 2. Q and R from transforms of the pairs of frames, each pair once, with the attenuation by the exposure.
    step, first, count = grid
    frequencies = step * torch.arange(first, first + count, dtype=torch.float64, device=time.device)
    attenuation = torch.sinc(frequencies * measurements.smearing_times[:, 0]).prod(0)  # (A, F)
    earlier, later = torch.triu_indices(*[time.shape[2]] * 2, device=time.device)
    share = seen[..., earlier] * seen[..., later] / seen.sum(2, keepdim=True).clamp(min=1.0)
    of_squares = torch.where(earlier == later, seen[..., earlier] - share, -2 * share)
    Q = _transform(time[..., earlier] + time[..., later], of_rows[..., None] * of_squares[:, None, None], grid)
    apart = earlier != later
    of_moduli = of_rows[..., None] * (2 * share[..., apart])[:, None, None]
    R = most - _transform(time[..., later[apart]] - time[..., earlier[apart]], of_moduli, grid).real
    Q, R = Q * attenuation.square(), R * attenuation.square()

    # 3. Products of the waves with the image motion and with the displacements.
    products = _transform(time, torch.stack([of_drift, frame_weights * values], 1), grid) * attenuation
    with_drift, with_values = products.unbind(1)

    # 4. Normal equations of cosine and sine after elimination of the image motion, and the decrease by their solution.
    cosine = 0.5 * (R + Q.real) + prior - with_drift.real.square() / drift_drift
    sine = 0.5 * (R - Q.real) + prior - with_drift.imag.square() / drift_drift
    cross = 0.5 * Q.imag - with_drift.real * with_drift.imag / drift_drift
    right = with_values - with_drift * (drift_value / drift_drift)
    decrease = sine * right.real.square() - 2 * cross * right.real * right.imag + cosine * right.imag.square()
    determinant = (cosine * sine - cross.square()).clamp(min=_TINY)
    return decrease / determinant + drift_value.square() / drift_drift


def _transform(times: Tensor, values: Tensor, grid: tuple[float, int, int]) -> Tensor:
    """Sums of ``values exp(2 pi i f t)`` over unequal times for equally spaced frequencies.

    The values are spread over a grid of times with a Kaiser-Bessel kernel, transformed, and divided by the transform of
    the kernel (Fessler and Sutton, IEEE Trans. Signal Process. 51, 560, 2003), to 1e-7 of the sum of their moduli.

    Args:
        times: (B, N, G) s.
        values: (B, ..., N, G) real.
        grid: Frequencies, from ``_grid``.

    Returns:
        (B, ..., F) complex.
    """
    width, shape = 8, 18.6  # grid points; of the kernel, for twice as many grid points as necessary
    step, first, count = grid
    length = 4 * fast_length(first + count)
    places, flat = times.flatten(1) * (step * length), values.flatten(-2).flatten(1, -2)  # (B, M), (B, C, M)
    taps = torch.arange(width, device=times.device) - (width // 2 - 1)
    total = flat.new_zeros(*flat.shape[:2], length)
    for part in runs(places.shape[1], max(1, _CHUNK // (width * flat.shape[0] * flat.shape[1]))):
        cell = places[:, part].floor()
        distance = (places[:, part] - cell)[..., None] - taps
        kernel = torch.special.i0(shape * (1 - (2 / width * distance).square()).clamp(min=0.0).sqrt())
        index = (cell.to(torch.int64)[..., None] + taps).remainder(length).flatten(1)
        spread = (flat[..., part, None] * kernel[:, None]).flatten(2)
        total.scatter_add_(2, index[:, None].expand_as(spread), spread)
    transformed = torch.fft.rfft(total)[..., first : first + count].conj()
    angle = math.pi * width / length * torch.arange(first, first + count, dtype=torch.float64, device=times.device)
    root = (shape**2 - angle.square()).sqrt()
    result: Tensor = (transformed * (root / (width * root.sinh()))).unflatten(1, values.shape[1:-2])
    return result


def strongest_frequencies(
    measurements: Measurements, sample_interval: float, harmonics: int, count: int, weights: Tensor
) -> Tensor:
    """Frequencies of the highest peaks of the periodogram.

    Args:
        measurements: Residual displacements of the tones found so far.
        sample_interval: Seconds between neighbouring rows or bands.
        harmonics: Multiples of the frequency that are added up.
        count: Number of peaks.
        weights: (B, S, N, 2), weightings to search with.

    Returns:
        (B, S, 2, count) Hz, the highest peak first.
    """
    grid = _grid(float(measurements.duration.amax()), sample_interval)
    total = _of_families(_power(measurements, grid, weights), grid[1], harmonics)
    # a peak is the maximum within half of 1 / duration on either side
    window = _OVERSAMPLING // 2
    peak = total >= torch.nn.functional.max_pool1d(total.flatten(0, 1), 2 * window + 1, 1, window).view(total.shape)
    places = torch.where(peak, total, -1.0).topk(min(count, total.shape[-1]), dim=-1).indices
    return grid[0] * (places + grid[1]).double()


def _of_families(total: Tensor, first: int, harmonics: int) -> Tensor:
    """Power (..., F) of multiples of a frequency, from the ``first`` on, with that of the multiples of each.

    Half the fundamental explains as much by its even multiples: of nearly equal powers, the highest frequency wins.
    """
    if harmonics == 1:
        return total
    place = torch.arange(total.shape[-1], device=total.device) + first
    family = total.clone()
    for harmonic in range(2, harmonics + 1):
        index = harmonic * place - first
        inside = index < total.shape[-1]
        family[..., inside] += total[..., index[inside]]
    nearly_best = family >= 0.95 * family.amax(-1, keepdim=True)
    return family * torch.where(nearly_best, 1 + place / place[-1], 1.0)


# --- Choice among the peaks ---


def visibility(measurements: Measurements, frequencies: Tensor) -> Tensor:
    """(B, 2) from 0 at blind frequencies (B, 2, H) of the record to 1 where the gain is large.

    0 as well near multiples of 1 / T_e, where less than a tenth of the amplitude remains after the exposure: the
    residuals of long exposures, whose blur differs between frames, would be fitted by huge tones there.
    """
    response = tone_response(measurements, frequencies)
    gain = 4 * response.abs().square().mean((1, 2)).amax(-1)
    resolved = torch.sinc(frequencies * measurements.exposure_time).abs().amax(-1) > 0.1
    return gain / (gain + MIN_GAIN**2) * resolved


def without_stretches(measurements: Measurements) -> Tensor:
    """(8, N) bool, rows to use: all, then all but one of seven stretches of 35 % that overlap by about two thirds.

    A stretch of outliers of up to 24 % of the rows lies within one of them.
    """
    rows = measurements.exposure_starts.shape[1]
    place = (torch.arange(rows, dtype=torch.float64, device=measurements.exposure_starts.device) + 0.5) / rows
    first = torch.linspace(0, 0.65, 7, dtype=torch.float64, device=place.device)[:, None]
    kept = (place < first) | (place > first + 0.35)
    return torch.cat([torch.ones_like(kept[:1]), kept])


def best_candidate(
    measurements: Measurements,
    weighed: Measurements,
    before: ToneFit,
    residual: Tensor,
    active: Tensor,
    sample_interval: float,
    *,
    leave_out: bool,
) -> tuple[ToneFit, Tensor]:
    """The further tone of each axis that fits the majority of the rows best.

    The peaks of the periodogram of the residual are fitted roughly, each with the tones of an earlier fit.

    Args:
        measurements: The displacements of B stacks.
        weighed: The same with the weights of the earlier fit.
        before: The earlier fit.
        residual: (B, N, G, 2) px, its residual.
        active: (B, 2, K) bool, its tones and the further one (or family).
        sample_interval: Seconds between neighbouring rows or bands.
        leave_out: Also try fits without a stretch of the record. Clouds and objects that move by themselves cover
            stretches of rows: without them, the other rows agree.

    Returns:
        A rough fit, and its residual (B, N, G, 2).
    """
    # 1. The parts of the record that are searched: all rows, and the rows without a stretch.
    model, harmonics = before.model, before.model.harmonics
    parts, weights, peaks = measurements, weighed.weights[:, None], 4  # outliers may raise a wrong peak
    if leave_out:
        kept = without_stretches(measurements)
        parts = measurements.repeated(len(kept)).only(kept.repeat(len(measurements.exposure_starts), 1))
        weights, peaks = torch.cat([weights, kept[1:, :, None] * measurements.weights[:, None]], 1), 2
    # 2. The highest peaks of each part, for the two axes, each fitted roughly with the tones of the earlier fit.
    unexplained = replace(measurements, displacements=residual)
    peaks_of_parts = strongest_frequencies(unexplained, sample_interval, harmonics, peaks, weights)  # (B, S, 2, C)
    multiples = torch.arange(1, harmonics + 1, dtype=torch.float64, device=peaks_of_parts.device)
    further = (peaks_of_parts.flatten(0, 1)[..., None] * multiples).transpose(1, 2).flatten(0, 1)  # (B S C, 2, H)
    count = len(further) // len(peaks_of_parts)
    earlier = before.frequencies[..., : active.shape[-1] - harmonics].repeat_interleave(count, 0)
    rough, residuals = fit_roughly(
        parts.repeated(peaks_of_parts.shape[-1]),
        torch.cat([earlier, further], -1),
        active.repeat_interleave(count, 0),
        model,
        iterations=5,
    )
    # 3. For each axis the fit that explains most, of which 65 % of the rows count: outliers may be all others. A tone
    # that is nearly blind counts less.
    several = measurements.repeated(count)
    size = several.sizes(residuals).nanquantile(0.65, dim=1).nan_to_num(0.0).unflatten(0, (-1, count))
    visible = visibility(several, rough.frequencies[..., -harmonics:]).unflatten(0, (-1, count))
    best = ((size.amax(1, keepdim=True) - size) * visible).argmax(1)  # (B, 2)

    def chosen(values: Tensor, axis: int) -> Tensor:
        tried = values.unflatten(0, (-1, count)).movedim(axis + 1, 2)  # (B, C, 2, ...)
        place = best.reshape(-1, 1, best.shape[-1], *(1,) * (tried.ndim - 3)).expand(-1, 1, -1, *tried.shape[3:])
        picked: Tensor = tried.gather(1, place)[:, 0].movedim(1, axis)
        return picked

    coefficients, frequencies, drift = (
        chosen(values, 1) for values in (rough.coefficients, rough.frequencies, rough.drift)
    )
    fit, residual = (
        ToneFit(coefficients, frequencies, active, drift, rough.covariance[:0], before.centre, model),
        chosen(residuals, 3),
    )
    # 4. Without a stretch: steps towards the least absolute residuals of all rows.
    for _ in range(3 if leave_out else 0):
        fit, residual = fit_roughly(measurements.for_least_absolute(residual), fit, active, model)
    return fit, residual
