"""Start frequencies from the data: a gain-aware least-squares periodogram."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones import drift_response, tone_response

__all__ = ["BLIND", "MAJORITY", "strongest_frequencies"]

_OVERSAMPLING = 8  # grid points per 1 / duration
_FEW_ROWS = 128  # measurements that are reweighted
BLIND = 0.1  # gain from displacement to offset that counts as half blind
MAJORITY = 0.65  # of the measurements: outliers may be all others
_APART = 4  # grid points: peaks nearer than half of 1 / duration are one
_FLOOR = 0.05  # of the mean residual: below it, sizes count as equal
_CHUNK = 2**22  # complex values at a time
_MOST_VALUES = 2**25  # responses worth computing: longer records are searched in segments
_FUNDAMENTAL = 0.95  # of the best score: of bases with the same harmonics in reach, the highest is the simplest


def frequency_grid(duration: float, sample_interval: float, device: torch.device) -> Tensor:
    """Frequencies (F,) from half a period in the record up to the Nyquist limit of the samples."""
    step = 1.0 / (_OVERSAMPLING * (duration + sample_interval))
    highest = 0.5 / sample_interval
    count = max(1, int(highest / step) - _OVERSAMPLING // 2 + 1)
    return (torch.arange(count, dtype=torch.float64, device=device) + _OVERSAMPLING // 2) * step


def explained(measurements: Measurements, frequencies: Tensor, absolute_steps: int = 0) -> Tensor:
    """How much (B, 2, F) a tone of each frequency (B, 2, F) explains, with a uniform motion beside it.

    The weighted square that least squares explain; or, after reweighting towards least absolute residuals, by how much
    the residual of the majority falls: a stretch of outliers cannot hide a tone from it. A weak prior on its amplitude
    keeps blind frequencies, where a huge tone would leave a small offset, from explaining noise.
    """
    weights = measurements.weights
    drift = drift_response(measurements, 1)
    spare = (weights * measurements.differences[..., None])[..., None]
    values = measurements.displacements[..., None]
    scores = []
    for chunk in frequencies.split(max(1, _CHUNK // (2 * measurements.moments.numel())), dim=-1):
        response = tone_response(measurements, chunk)
        factor = torch.ones_like(weights[..., None])  # (B, N, 2, 1 or F)
        for _ in range(absolute_steps + 1):
            solution, square = _tone_and_drift(response, drift, values, weights[..., None] * factor, spare * factor)
            if absolute_steps == 0:
                scores.append(square)
                break
            a, b, v = (part[:, None, None] for part in solution)
            residual = values - (a * response.real - b * response.imag + v * drift[..., None])
            size = (residual.square().sum(2) * weights[..., None]).sqrt()
            factor = 1 / torch.maximum(size, _FLOOR * size.mean(1, keepdim=True) + 1e-12)
        else:
            before = (values.square().sum(2) * weights[..., None]).sqrt().expand_as(size)
            place = max(1, round(MAJORITY * size.shape[1]))
            scores.append(before.kthvalue(place, dim=1).values - size.kthvalue(place, dim=1).values)
    return torch.cat(scores, dim=-1)


def _tone_and_drift(
    response: Tensor, drift: Tensor, values: Tensor, weights: Tensor, spare: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Weighted fit of ``Re (a + i b) response + v drift`` for every frequency.

    Args:
        response: (B, N, G, 2, F) complex.
        drift: (B, N, G, 1).
        values: (B, N, G, 2, 1).
        weights: (B, N, 2, 1 or F).
        spare: The same times the number of differences.

    Returns:
        a, b and v, (B, 2, F) each, and the weighted square explained (B, 2, F).
    """

    def total(product: Tensor) -> Tensor:
        return (product.sum(2) * weights).sum(1)

    size, square = total(response.abs().square()), total(response.square())
    with_drift, with_values = total(response * drift[..., None]), total(response * values)
    drifts, both = total(drift.square()[..., None]), total(drift[..., None] * values)
    prior = 0.5 * BLIND**2 * spare.sum(1)
    rows = (
        (0.5 * (size + square.real) + prior, -0.5 * square.imag, with_drift.real),
        (-0.5 * square.imag, 0.5 * (size - square.real) + prior, -with_drift.imag),
        (with_drift.real, -with_drift.imag, drifts.expand_as(size) * (1 + 1e-12)),
    )
    matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    matrix = matrix + 1e-300 * torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    right = torch.stack([with_values.real, -with_values.imag, both.expand_as(size)], dim=-1)
    solution = torch.linalg.solve(matrix, right[..., None])[..., 0]
    a, b, v = solution.unbind(-1)
    return (a, b, v), (right * solution).sum(-1)


def _segments(measurements: Measurements, count: int) -> Measurements:
    """The record cut into ``count`` pieces of equal length, as a batch (B count, N / count, ...)."""
    rows = measurements.moments.shape[1] // count * count

    def cut(values: Tensor) -> Tensor:
        pieces: Tensor = values[:, :rows].unflatten(1, (count, -1)).flatten(0, 1)
        return pieces

    return replace(
        measurements,
        moments=cut(measurements.moments),
        displacements=cut(measurements.displacements),
        seen=cut(measurements.seen),
        information=cut(measurements.information),
    )


def strongest_frequencies(
    measurements: Measurements,
    sample_interval: float,
    harmonics: int = 1,
    count: int = 1,
    absolute_steps: int = 0,
) -> Tensor:
    """Frequencies whose tone, with a uniform motion, explains most of the displacements: the highest peaks.

    For every frequency of a grid a tone is fitted with all that lies between it and an offset (gain, exposure, band
    average, coupling). Long records are searched in segments first, which need a coarse grid only, and the best
    frequency is sharpened while segments are joined: the cost grows with the length of the record, not its square.

    Args:
        measurements: The displacements that the tones found so far leave, and their weights.
        sample_interval: Seconds between neighbouring rows or bands.
        harmonics: Multiples of the frequency that count with it.
        count: How many peaks.
        absolute_steps: Rounds of reweighting towards least absolute residuals.

    Returns:
        (B, 2, count) Hz, the highest peak first.
    """
    batch, rows, _ = measurements.moments.shape
    device = measurements.moments.device

    def score(segments: int, frequencies: Tensor) -> Tensor:
        parts = _segments(measurements, segments)
        each = explained(parts, frequencies.repeat_interleave(segments, dim=0), absolute_steps)
        total: Tensor = each.unflatten(0, (batch, segments)).sum(1)
        return total

    whole = frequency_grid(float(measurements.duration.amax()), sample_interval, device)
    pieces = len(whole) * 2 * measurements.moments.numel() / _MOST_VALUES
    segments = 1 << max(0, int(pieces - 1).bit_length())
    segments = max(1, min(segments, rows // 64))
    if absolute_steps > 0:
        segments = max(segments, rows // _FEW_ROWS)
    longest = float(_segments(measurements, segments).duration.amax())
    grid = frequency_grid(longest, sample_interval, device).expand(batch, 2, -1)
    if absolute_steps > 0:
        # outliers are told in the first segment already, and reweighting the others would take long
        first = _segments(measurements, segments)[::segments]
        grid = grid[..., ::2]
        total = explained(first, grid, absolute_steps)
    else:
        total = score(segments, grid)
    total = _of_families(total, grid, harmonics)
    peak = total >= torch.nn.functional.max_pool1d(total, 2 * _APART + 1, 1, _APART)
    places = torch.where(peak, total, -1.0).topk(min(count, total.shape[-1]), dim=-1).indices
    best = grid.gather(-1, places)
    while segments > 1:
        reach, segments = 0.75 / longest, segments // 2
        longest = float(_segments(measurements, segments).duration.amax())
        steps = int(reach * longest * _OVERSAMPLING) + 1
        around = torch.arange(-steps, steps + 1, dtype=torch.float64, device=device) / (_OVERSAMPLING * longest)
        near_by = (best[..., None] + around).clamp(min=0.0)
        scores = score(segments, near_by.flatten(-2)).unflatten(-1, near_by.shape[-2:])
        best = near_by.gather(-1, scores.argmax(-1, keepdim=True))[..., 0]
    return best


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
