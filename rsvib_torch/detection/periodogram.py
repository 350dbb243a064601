"""Start frequencies from the data: a gain-aware least-squares periodogram."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones import drift_response, tone_response

__all__ = ["strongest_frequency"]

_OVERSAMPLING = 8  # grid points per 1 / duration
_CHUNK = 2**22  # complex values at a time
_MOST_VALUES = 2**25  # responses worth computing: longer records are searched in segments
_FUNDAMENTAL = 0.95  # of the best score: of bases with the same harmonics in reach, the highest is the simplest


def frequency_grid(duration: float, sample_interval: float, device: torch.device) -> Tensor:
    """Frequencies (F,) from half a period in the record up to the Nyquist limit of the samples."""
    step = 1.0 / (_OVERSAMPLING * (duration + sample_interval))
    highest = 0.5 / sample_interval
    count = max(1, int(highest / step) - _OVERSAMPLING // 2 + 1)
    return (torch.arange(count, dtype=torch.float64, device=device) + _OVERSAMPLING // 2) * step


def explained_square(measurements: Measurements, frequencies: Tensor) -> Tensor:
    """Weighted square (B, 2, F) that a tone of each frequency (B, 2, F) explains, with a uniform motion beside it.

    A weak prior on its amplitude keeps blind frequencies, where a huge tone would leave a small offset, from
    explaining noise.
    """
    weights = measurements.weights
    drift = drift_response(measurements, 1)
    # prior: an offset gain of 0.1 counts as half blind
    prior = 0.5e-2 * (weights * measurements.differences[..., None]).sum(1)[..., None]
    explained = []
    for chunk in frequencies.split(max(1, _CHUNK // (2 * measurements.moments.numel())), dim=-1):
        response, _ = tone_response(measurements, chunk)
        design = torch.stack([response.real, -response.imag, drift[..., None].expand(response.shape)], dim=-1)
        weighted = design * weights[:, :, None, :, None, None]
        matrix = torch.einsum("bngafi,bngafj->bafij", weighted, design)
        right = torch.einsum("bngafi,bnga->bafi", weighted, measurements.displacements)
        lift = torch.stack([prior, prior, 1e-12 * matrix[..., 2, 2].amax(-1, keepdim=True)], dim=-1)
        matrix = matrix + torch.diag_embed(lift.expand(right.shape) + 1e-300)
        explained.append((right * torch.linalg.solve(matrix, right[..., None])[..., 0]).sum(-1))
    return torch.cat(explained, dim=-1)


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


def strongest_frequency(measurements: Measurements, sample_interval: float, harmonics: int = 1) -> Tensor:
    """Frequency whose tone, with a uniform motion, explains most of the displacements.

    For every frequency of a grid a tone is fitted with all that lies between it and an offset (gain, exposure, band
    average, coupling). Long records are searched in segments first, which need a coarse grid only, and the best
    frequency is sharpened while segments are joined: the cost grows with the length of the record, not its square.

    Args:
        measurements: The displacements that the tones found so far leave, and their weights.
        sample_interval: Seconds between neighbouring rows or bands.
        harmonics: Multiples of the frequency that count with it.

    Returns:
        (B, 2) Hz.
    """
    batch, rows, _ = measurements.moments.shape
    device = measurements.moments.device

    def score(count: int, frequencies: Tensor) -> Tensor:
        parts = _segments(measurements, count)
        each = explained_square(parts, frequencies.repeat_interleave(count, dim=0))
        total: Tensor = each.unflatten(0, (batch, count)).sum(1)
        return total

    whole = frequency_grid(float(measurements.duration.amax()), sample_interval, device)
    pieces = len(whole) * 2 * measurements.moments.numel() / _MOST_VALUES
    count = 1 << max(0, int(pieces - 1).bit_length())
    count = max(1, min(count, rows // 64))
    longest = float(_segments(measurements, count).duration.amax())
    grid = frequency_grid(longest, sample_interval, device).expand(batch, 2, -1)
    total = score(count, grid)
    if harmonics > 1:
        place = torch.arange(grid.shape[-1], device=device) + _OVERSAMPLING // 2
        family = total.clone()
        for harmonic in range(2, harmonics + 1):
            index = harmonic * place - _OVERSAMPLING // 2
            inside = index < grid.shape[-1]
            family[..., inside] += total[..., index[inside]]
        near = family >= _FUNDAMENTAL * family.amax(-1, keepdim=True)
        peak = family == torch.nn.functional.max_pool1d(family, 2 * _OVERSAMPLING + 1, 1, _OVERSAMPLING)
        total = torch.where(near & peak, grid, -1.0)
    best = grid.gather(-1, total.argmax(-1, keepdim=True))
    while count > 1:
        reach, count = 0.75 / longest, count // 2
        longest = float(_segments(measurements, count).duration.amax())
        steps = int(reach * longest * _OVERSAMPLING) + 1
        around = torch.arange(-steps, steps + 1, dtype=torch.float64, device=device) / (_OVERSAMPLING * longest)
        near_by = (best + around).clamp(min=0.0)
        best = near_by.gather(-1, score(count, near_by).argmax(-1, keepdim=True))
    return best[..., 0]
