"""Start frequencies from the data: a gain-aware least-squares periodogram."""

import math

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.inversion import BLIND
from rsvib_torch.detection.tones.tone_model import drift_response

__all__ = ["MAJORITY", "strongest_frequencies"]

_OVERSAMPLING = 8  # grid points per 1 / duration
MAJORITY = 0.65  # of the measurements: outliers may be all others
_APART = 4  # grid points: peaks nearer than half of 1 / duration are one
_NOTHING = 1e-300  # keeps equations solvable where nothing is known
_CHUNK = {"cpu": 2**17}  # complex values at a time: they stay in the cache
_LARGE_CHUNK = 2**24  # elsewhere
_MOST_VALUES = 2**25  # responses worth computing: longer records are searched in segments
_FUNDAMENTAL = 0.95  # of the best score: of bases with the same harmonics in reach, the highest is the simplest


def frequency_grid(duration: float, sample_interval: float, device: torch.device) -> Tensor:
    """Frequencies (F,) from half a period in the record up to the Nyquist limit of the samples."""
    step = 1.0 / (_OVERSAMPLING * (duration + sample_interval))
    highest = 0.5 / sample_interval
    count = max(1, int(highest / step) - _OVERSAMPLING // 2 + 1)
    return (torch.arange(count, dtype=torch.float64, device=device) + _OVERSAMPLING // 2) * step


def explained(measurements: Measurements, frequencies: Tensor, weights: Tensor) -> Tensor:
    """How much a tone of each frequency explains, with a uniform motion beside it.

    A weak prior on its amplitude keeps blind frequencies, where a huge tone would leave a small offset, from
    explaining noise.

    Args:
        measurements: The displacements.
        frequencies: (B, 2, F) Hz, or (B, 1, F) for both axes.
        weights: (B, S, N, 2), several weights of the displacements at a time.

    Returns:
        Weighted squares (B, S, 2, F).
    """
    together = [slice(0, 2)] if frequencies.shape[1] == 1 else [slice(0, 1), slice(1, 2)]
    parts = (_explained(measurements, frequencies[:, axes.start], weights, axes) for axes in together)
    return torch.cat(list(parts), dim=2)


def _explained(measurements: Measurements, frequencies: Tensor, weights: Tensor, axes: slice) -> Tensor:
    """``explained`` of some axes (B, S, A, F), all at the same frequencies (B, F)."""
    seen, group = measurements.seen[..., None], measurements.moments.shape[2]
    of_rows = weights[..., axes].transpose(2, 3)  # (B, S, A, N)
    each = of_rows.repeat_interleave(group, dim=-1)  # (B, S, A, N G)
    singly = (each * measurements.seen.flatten(1)[:, None, None]).flatten(1, 2)
    in_common = (of_rows / measurements.seen.sum(2).clamp(min=1.0)[:, None, None]).flatten(1, 2)
    drift = drift_response(measurements, 1)[..., 0].flatten(1)[:, None, None]  # (B, 1, 1, N G)
    values = measurements.displacements[..., axes].flatten(1, 2).transpose(1, 2)[:, None]  # (B, 1, A, N G)
    drifts, both = ((each * drift * other).sum(-1)[..., None] for other in (drift, values))
    drifts = drifts * (1 + 1e-12) + _NOTHING
    prior = 0.5 * BLIND**2 * (of_rows * measurements.differences[:, None, None]).sum(-1)[..., None] + _NOTHING
    linear = torch.stack([each * drift, each * values], dim=-2).flatten(1, 3)  # (B, 2 S A, N G)
    shape = each.shape[1:3]
    smearing = measurements.smearing_times[:, None, :, axes]  # (2, 1, 1, A, 1)

    def sums(of: Tensor, by: Tensor) -> Tensor:
        """Weighted sums (B, S, A, ..., F) of values (B, n, F)."""
        total: Tensor = (by @ of).unflatten(1, (*shape, -1))
        return total

    scores = []
    most = _CHUNK.get(frequencies.device.type, _LARGE_CHUNK)
    for chunk in frequencies.split(max(1, most // measurements.moments.numel()), dim=-1):
        angle = 2 * math.pi * chunk[:, None, None] * measurements.middles[..., 0]
        waves = (angle.cos(), angle.sin())
        commons = [(seen * wave).sum(2) for wave in waves]  # (B, N, F)
        fading = torch.sinc(chunk[:, None, None] * smearing).prod(0)  # (B, 1, A, F)
        (drift_1, right_1), (drift_2, right_2) = (
            (sums(wave.flatten(1, 2), linear) * fading[..., None, :]).unbind(-2) for wave in waves
        )
        # of waves less their mean over the frames that see a row, as which displacements and drifts come
        first, second, cross = (
            (sums((waves[i] * waves[j]).flatten(1, 2), singly) - sums(commons[i] * commons[j], in_common))[..., 0, :]
            * fading.square()
            for i, j in ((0, 0), (1, 1), (0, 1))
        )
        # normal equations of both parts of the tone, the motion's eliminated
        first, second = (
            whole + prior - part.square() / drifts for whole, part in ((first, drift_1), (second, drift_2))
        )
        cross = cross - drift_1 * drift_2 / drifts
        right_1, right_2 = (right - part * (both / drifts) for right, part in ((right_1, drift_1), (right_2, drift_2)))
        gained = second * right_1.square() - 2 * cross * right_1 * right_2 + first * right_2.square()
        scores.append(gained / (first * second - cross.square()).clamp(min=_NOTHING) + both.square() / drifts)
    return torch.cat(scores, dim=-1)


def strongest_frequencies(
    measurements: Measurements,
    sample_interval: float,
    harmonics: int = 1,
    count: int = 1,
    weights: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Frequencies whose tone, with a uniform motion, explains most of the displacements: the highest peaks.

    For every frequency of a grid a tone is fitted with all that lies between it and an offset (gain, exposure, band
    average, coupling). Long records are searched in segments first, which need a coarse grid only, and the best
    frequency is sharpened while segments are joined: the cost grows with the length of the record, not its square.

    Args:
        measurements: The displacements that the tones found so far leave.
        sample_interval: Seconds between neighbouring rows or bands.
        harmonics: Multiples of the frequency that count with it.
        count: How many peaks.
        weights: (B, S, N, 2) to search with, one after the other; None for those of the measurements.

    Returns:
        (B, S, 2, count) Hz, the highest peak first, and the weighted squares (B, S, 2) that it explains: of a record
        that was searched in segments more than that, as each of them has an amplitude of its own.
    """
    batch, rows, _ = measurements.moments.shape
    device = measurements.moments.device
    weights = measurements.weights[:, None] if weights is None else weights

    def score(of: Measurements, by: Tensor, segments: int, frequencies: Tensor) -> Tensor:
        parts = of.in_segments(segments)
        own = by[:, :, : rows // segments * segments].unflatten(2, (segments, -1)).transpose(1, 2).flatten(0, 1)
        each = explained(parts, frequencies.repeat_interleave(segments, dim=0), own)
        total: Tensor = each.unflatten(0, (-1, segments)).sum(1)
        return total

    whole = frequency_grid(float(measurements.duration.amax()), sample_interval, device)
    pieces = len(whole) * 2 * measurements.moments.numel() / _MOST_VALUES
    segments = 1 << max(0, int(pieces - 1).bit_length())
    segments = max(1, min(segments, rows // 64))
    longest = float(measurements.in_segments(segments).duration.amax())
    grid = frequency_grid(longest, sample_interval, device).expand(batch, 2, -1)
    total = _of_families(score(measurements, weights, segments, grid[:, :1]), grid[:, None], harmonics).flatten(0, 1)
    peak = total >= torch.nn.functional.max_pool1d(total, 2 * _APART + 1, 1, _APART)
    heights, places = torch.where(peak, total, -1.0).topk(min(count, total.shape[-1]), dim=-1)
    best = grid.repeat_interleave(weights.shape[1], 0).gather(-1, places)  # (B S, 2, count)
    if segments > 1:  # from here on each has frequencies of its own
        several, by = measurements.repeated(weights.shape[1]), weights.flatten(0, 1)[:, None]
    while segments > 1:
        reach, segments = 0.75 / longest, segments // 2
        longest = float(measurements.in_segments(segments).duration.amax())
        steps = int(reach * longest * _OVERSAMPLING) + 1
        around = torch.arange(-steps, steps + 1, dtype=torch.float64, device=device) / (_OVERSAMPLING * longest)
        near_by = (best[..., None] + around).clamp(min=0.0)
        scores = score(several, by, segments, near_by.flatten(-2))[:, 0].unflatten(-1, near_by.shape[-2:])
        best = near_by.gather(-1, scores.argmax(-1, keepdim=True))[..., 0]
    return best.unflatten(0, (batch, -1)), heights[..., 0].unflatten(0, (batch, -1))


def _of_families(total: Tensor, grid: Tensor, harmonics: int) -> Tensor:
    """What a frequency explains together with its multiples.

    A base of half the frequency explains as much by its even multiples: of such the highest is taken.
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
    near = family >= _FUNDAMENTAL * family.amax(-1, keepdim=True)
    lift = torch.where(near, 1 + grid / grid.amax(), 1.0)  # among the best, the higher frequency first
    return family * lift
