"""Start frequencies from the data: a gain-aware least-squares periodogram."""

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones import drift_response, tone_response

__all__ = ["BLIND", "MAJORITY", "strongest_frequencies"]

_OVERSAMPLING = 8  # grid points per 1 / duration
BLIND = 0.1  # gain from displacement to offset that counts as half blind
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
        frequencies: (B, 2, F) Hz.
        weights: (B, S, N, 2), several weights of the displacements at a time.

    Returns:
        Weighted squares (B, S, 2, F).
    """
    drift = drift_response(measurements, 1)
    values = measurements.displacements[..., None]
    flat = weights.transpose(2, 3)

    def total(products: Tensor) -> Tensor:
        """Weighted sums (B, S, 2, F) over the rows of products (B, N, G, 2, F)."""
        rows = products.sum(2).transpose(1, 2)  # (B, 2, N, F)
        sums: Tensor = (flat.transpose(1, 2) @ rows).transpose(1, 2)
        return sums

    drifts, both = total(drift.square()[..., None].expand_as(values)), total(drift[..., None] * values)
    prior = 0.5 * BLIND**2 * (weights * measurements.differences[:, None, :, None]).sum(2)[..., None] + _NOTHING
    scores = []
    most = _CHUNK.get(frequencies.device.type, _LARGE_CHUNK)
    for chunk in frequencies.split(max(1, most // (2 * measurements.moments.numel())), dim=-1):
        response = tone_response(measurements, chunk)
        cosine, sine = response.real, -response.imag
        squares = (total(cosine.square()) + prior, total(cosine * sine), total(sine.square()) + prior)
        with_drift = (total(cosine * drift[..., None]), total(sine * drift[..., None]))
        with_values = (total(cosine * values), total(sine * values))
        rows = (
            (squares[0], squares[1], with_drift[0]),
            (squares[1], squares[2], with_drift[1]),
            (*with_drift, (drifts * (1 + 1e-12) + _NOTHING).expand_as(squares[0])),
        )
        matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
        right = torch.stack([*with_values, both.expand_as(squares[0])], dim=-1)
        scores.append((right * torch.linalg.solve(matrix, right[..., None])[..., 0]).sum(-1))
    return torch.cat(scores, dim=-1)


def strongest_frequencies(
    measurements: Measurements,
    sample_interval: float,
    harmonics: int = 1,
    count: int = 1,
    weights: Tensor | None = None,
) -> Tensor:
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
        (B, S, 2, count) Hz, the highest peak first.
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
    total = _of_families(score(measurements, weights, segments, grid), grid[:, None], harmonics).flatten(0, 1)
    peak = total >= torch.nn.functional.max_pool1d(total, 2 * _APART + 1, 1, _APART)
    places = torch.where(peak, total, -1.0).topk(min(count, total.shape[-1]), dim=-1).indices
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
    peaks: Tensor = best.unflatten(0, (batch, -1))
    return peaks


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
