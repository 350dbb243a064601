"""Start frequencies from the data: a gain-aware least-squares periodogram, and the choice among its peaks."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import MIN_GAIN, ToneFit, drift_response, fit_roughly, tone_response

__all__ = ["best_candidate", "strongest_frequencies", "visibility"]

_OVERSAMPLING = 8  # grid points per 1 / duration: a peak between two of them keeps 98 % of its height
_CHUNK = {"cpu": 2**17}  # complex values at a time, to stay in the cache
_LARGE_CHUNK = 2**24  # on other devices
_TINY = 1e-300  # keeps equations solvable where nothing was measured


# --- Periodogram ---


def frequency_grid(duration: float, sample_interval: float, device: torch.device) -> Tensor:
    """Frequencies (F,) from half a period in the record up to the Nyquist limit of the samples."""
    step = 1.0 / (_OVERSAMPLING * (duration + sample_interval))
    highest = 0.5 / sample_interval
    count = max(1, int(highest / step) - _OVERSAMPLING // 2 + 1)
    return (torch.arange(count, dtype=torch.float64, device=device) + _OVERSAMPLING // 2) * step


def power(measurements: Measurements, frequencies: Tensor, weights: Tensor) -> Tensor:
    """Decrease of the weighted sum of squares by a tone of each frequency and a uniform image motion.

    A weak prior on the amplitude suppresses blind frequencies, where a huge tone would fit noise.

    Args:
        measurements: The displacements.
        frequencies: (B, 2, F) Hz, or (B, 1, F) for both axes.
        weights: (B, S, N, 2), several weightings of the displacements.

    Returns:
        Weighted squares (B, S, 2, F).
    """
    count = measurements.displacements.shape[-1]
    together = [slice(0, count)] if frequencies.shape[1] == 1 else [slice(axis, axis + 1) for axis in range(count)]
    parts = (_power(measurements, frequencies[:, axes.start], weights, axes) for axes in together)
    return torch.cat(list(parts), dim=2)


def _power(measurements: Measurements, frequencies: Tensor, weights: Tensor, axes: slice) -> Tensor:
    """``power`` of some axes (B, S, A, F) at the same frequencies (B, F)."""
    seen, group = measurements.visible[..., None], measurements.exposure_starts.shape[2]
    of_rows = weights[..., axes].transpose(2, 3)  # (B, S, A, N)
    each = of_rows.repeat_interleave(group, dim=-1)  # (B, S, A, N G)
    of_frames = (each * measurements.visible.flatten(1)[:, None, None]).flatten(1, 2)
    of_means = (of_rows / measurements.visible.sum(2).clamp(min=1.0)[:, None, None]).flatten(1, 2)
    drift = drift_response(measurements, 1)[..., 0].flatten(1)[:, None, None]  # (B, 1, 1, N G)
    values = measurements.displacements[..., axes].flatten(1, 2).transpose(1, 2)[:, None]  # (B, 1, A, N G)
    drift_drift, drift_value = ((each * drift * other).sum(-1)[..., None] for other in (drift, values))
    drift_drift = drift_drift * (1 + 1e-12) + _TINY
    prior = 0.5 * MIN_GAIN**2 * (of_rows * measurements.num_differences[:, None, None]).sum(-1)[..., None] + _TINY
    linear = torch.stack([each * drift, each * values], dim=-2).flatten(1, 3)  # (B, 2 S A, N G)
    shape = each.shape[1:3]
    smearing = measurements.smearing_times[:, None, :, axes]  # (2, 1, 1, A, 1)

    def sums(of: Tensor, by: Tensor) -> Tensor:
        """Weighted sums (B, S, A, ..., F) of values (B, n, F)."""
        total: Tensor = (by @ of).unflatten(1, (*shape, -1))
        return total

    powers = []
    most = _CHUNK.get(frequencies.device.type, _LARGE_CHUNK)
    for chunk in frequencies.split(max(1, most // measurements.exposure_starts.numel()), dim=-1):
        angle = 2 * math.pi * chunk[:, None, None] * measurements.middles[..., 0]
        waves = (angle.cos(), angle.sin())
        means = [(seen * wave).sum(2) for wave in waves]  # (B, N, F)
        attenuation = torch.sinc(chunk[:, None, None] * smearing).prod(0)  # (B, 1, A, F)
        (drift_1, right_1), (drift_2, right_2) = (
            (sums(wave.flatten(1, 2), linear) * attenuation[..., None, :]).unbind(-2) for wave in waves
        )
        # squares and product of both waves, less their means over the frames that contain a row
        first, second, cross = (
            (sums((waves[i] * waves[j]).flatten(1, 2), of_frames) - sums(means[i] * means[j], of_means))[..., 0, :]
            * attenuation.square()
            for i, j in ((0, 0), (1, 1), (0, 1))
        )
        # normal equations of cosine and sine after elimination of the drift
        first, second = (
            whole + prior - part.square() / drift_drift for whole, part in ((first, drift_1), (second, drift_2))
        )
        cross = cross - drift_1 * drift_2 / drift_drift
        right_1, right_2 = (
            right - part * (drift_value / drift_drift) for right, part in ((right_1, drift_1), (right_2, drift_2))
        )
        decrease = second * right_1.square() - 2 * cross * right_1 * right_2 + first * right_2.square()
        determinant = (first * second - cross.square()).clamp(min=_TINY)
        powers.append(decrease / determinant + drift_value.square() / drift_drift)
    return torch.cat(powers, dim=-1)


def strongest_frequencies(
    measurements: Measurements, sample_interval: float, harmonics: int, count: int, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Frequencies of the highest peaks of the periodogram.

    Long records are searched in segments first, on a coarse grid; the frequency is refined while segments are joined.
    The cost then grows with the length of the record instead of its square.

    Args:
        measurements: Residual displacements of the tones found so far.
        sample_interval: Seconds between neighbouring rows or bands.
        harmonics: Multiples of the frequency that are added up.
        count: Number of peaks.
        weights: (B, S, N, 2), weightings to search with.

    Returns:
        (B, S, 2, count) Hz, the highest peak first, and its height (B, S, 2). The height of a record that was searched
        in segments is an upper bound, as each segment has an amplitude of its own.
    """
    batch, rows, _ = measurements.exposure_starts.shape
    device = measurements.exposure_starts.device

    def score(of: Measurements, by: Tensor, segments: int, frequencies: Tensor) -> Tensor:
        parts = of.in_segments(segments)
        own = by[:, :, : rows // segments * segments].unflatten(2, (segments, -1)).transpose(1, 2).flatten(0, 1)
        each = power(parts, frequencies.repeat_interleave(segments, dim=0), own)
        total: Tensor = each.unflatten(0, (-1, segments)).sum(1)
        return total

    whole = frequency_grid(float(measurements.duration.amax()), sample_interval, device)
    # at most 2^25 complex values, about a second on one core, and at least 64 rows a segment
    pieces = len(whole) * 2 * measurements.exposure_starts.numel() / 2**25
    segments = 1 << max(0, int(pieces - 1).bit_length())
    segments = max(1, min(segments, rows // 64))
    longest = float(measurements.in_segments(segments).duration.amax())
    axes = measurements.displacements.shape[-1]
    grid = frequency_grid(longest, sample_interval, device).expand(batch, axes, -1)
    total = _of_families(score(measurements, weights, segments, grid[:, :1]), grid[:, None], harmonics).flatten(0, 1)
    # a peak is the maximum within half of 1 / duration on either side
    window = _OVERSAMPLING // 2
    peak = total >= torch.nn.functional.max_pool1d(total, 2 * window + 1, 1, window)
    heights, places = torch.where(peak, total, -1.0).topk(min(count, total.shape[-1]), dim=-1)
    best = grid.repeat_interleave(weights.shape[1], 0).gather(-1, places)  # (B S, 2, count)
    if segments > 1:  # from here on each weighting has frequencies of its own
        several, by = measurements.repeated(weights.shape[1]), weights.flatten(0, 1)[:, None]
    while segments > 1:
        reach, segments = 0.75 / longest, segments // 2
        longest = float(measurements.in_segments(segments).duration.amax())
        steps = int(reach * longest * _OVERSAMPLING) + 1
        around = torch.arange(-steps, steps + 1, dtype=torch.float64, device=device) / (_OVERSAMPLING * longest)
        tried = (best[..., None] + around).clamp(min=0.0)
        scores = score(several, by, segments, tried.flatten(-2))[:, 0].unflatten(-1, tried.shape[-2:])
        best = tried.gather(-1, scores.argmax(-1, keepdim=True))[..., 0]
    return best.unflatten(0, (batch, -1)), heights[..., 0].unflatten(0, (batch, -1))


def _of_families(total: Tensor, grid: Tensor, harmonics: int) -> Tensor:
    """Power of each frequency with that of its multiples.

    Half the fundamental explains as much by its even multiples: of nearly equal powers, the highest frequency wins.
    """
    if harmonics == 1:
        return total
    step = (grid[..., -1:] - grid[..., :1]).amax() / max(1, grid.shape[-1] - 1)
    first = round(float(grid.amin() / step)) if grid.shape[-1] > 1 else 1
    place = torch.arange(grid.shape[-1], device=grid.device) + first
    family = total.clone()
    for harmonic in range(2, harmonics + 1):
        index = harmonic * place - first
        inside = index < grid.shape[-1]
        family[..., inside] += total[..., index[inside]]
    nearly_best = family >= 0.95 * family.amax(-1, keepdim=True)
    return family * torch.where(nearly_best, 1 + grid / grid.amax(), 1.0)


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
    model, harmonics = before.model, before.model.harmonics
    parts, weights, peaks = measurements, weighed.weights[:, None], 4  # outliers may raise a wrong peak
    if leave_out:
        kept = without_stretches(measurements)
        parts = measurements.repeated(len(kept)).only(kept.repeat(len(measurements.exposure_starts), 1))
        weights, peaks = torch.cat([weights, kept[1:, :, None] * measurements.weights[:, None]], 1), 2
    unexplained = replace(measurements, displacements=residual)
    found, _ = strongest_frequencies(unexplained, sample_interval, harmonics, peaks, weights)  # (B, S, 2, C)
    multiples = torch.arange(1, harmonics + 1, dtype=torch.float64, device=found.device)
    further = (found.flatten(0, 1)[..., None] * multiples).transpose(1, 2).flatten(0, 1)  # (B S C, 2, H)
    count = len(further) // len(found)
    earlier = before.frequencies[..., : active.shape[-1] - harmonics].repeat_interleave(count, 0)
    tried = torch.cat([earlier, further], -1)
    each_active = active.repeat_interleave(count, 0)
    rough, residuals = fit_roughly(parts.repeated(found.shape[-1]), tried, each_active, model, iterations=3)
    several = measurements.repeated(count)
    # 65 % of the rows count: outliers may be all others
    size = several.sizes(residuals).nanquantile(0.65, dim=1).nan_to_num(0.0).unflatten(0, (-1, count))
    visible = visibility(several, rough.frequencies[..., -harmonics:]).unflatten(0, (-1, count))
    best = ((size.amax(1, keepdim=True) - size) * visible).argmax(1)  # (B, 2)

    def chosen(values: Tensor, axis: int) -> Tensor:
        each = values.unflatten(0, (-1, count)).movedim(axis + 1, 2)  # (B, C, 2, ...)
        place = best.reshape(-1, 1, best.shape[-1], *(1,) * (each.ndim - 3)).expand(-1, 1, -1, *each.shape[3:])
        picked: Tensor = each.gather(1, place)[:, 0].movedim(1, axis)
        return picked

    of_best = (chosen(values, 1) for values in (rough.coefficients, rough.frequencies, rough.drift))
    coefficients, frequencies, drift = of_best
    fit, residual = ToneFit(coefficients, frequencies, active, drift, rough.covariance[:0], before.centre, model), chosen(residuals, 3)
    for _ in range(3 if leave_out else 0):  # towards the least absolute residuals
        fit, residual = fit_roughly(measurements.for_least_absolute(residual), fit, active, model)
    return fit, residual
