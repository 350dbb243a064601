"""Start frequencies from the data: a gain-aware least-squares periodogram."""

import torch
from torch import Tensor

from rsvib_torch.detection.tones import Measurements, tone_response

__all__ = ["strongest_frequency"]

_OVERSAMPLING = 8  # grid points per 1 / duration
_CHUNK = 2**22  # complex values at a time


def frequency_grid(measurements: Measurements, sample_interval: float) -> Tensor:
    """Frequencies (F,) from half a period in the record up to the Nyquist limit of the samples."""
    duration = float(measurements.duration.amax()) + sample_interval
    step = 1.0 / (_OVERSAMPLING * duration)
    highest = 0.5 / sample_interval
    count = max(1, int(highest / step) - _OVERSAMPLING // 2 + 1)
    grid = torch.arange(count, dtype=torch.float64, device=measurements.starts.device) + _OVERSAMPLING // 2
    return grid * step


def strongest_frequency(measurements: Measurements, sample_interval: float) -> Tensor:
    """Frequency whose tone, with a uniform motion, explains most of the offsets.

    For every frequency of a grid a tone is fitted with all that lies between it and an offset (gain, exposure, band
    average, coupling). A weak prior on its amplitude keeps blind frequencies, where a huge tone would leave a small
    offset, from explaining noise.

    Args:
        measurements: The offsets that the tones found so far leave, and their weights.
        sample_interval: Seconds between neighbouring rows or bands.

    Returns:
        (B, 2) Hz.
    """
    grid = frequency_grid(measurements, sample_interval)
    weights = measurements.weights
    batch, count, _ = weights.shape
    interval = (measurements.later_starts - measurements.starts)[..., None].expand(-1, -1, 2)
    explained = []
    for chunk in grid.split(max(1, _CHUNK // (batch * count * 2))):
        response, _ = tone_response(measurements, chunk.expand(batch, 2, -1))
        design = torch.stack([response.real, -response.imag, interval[..., None].expand(response.shape)], dim=-1)
        weighted = design * weights[..., None, None]
        matrix = torch.einsum("bmafi,bmafj->bafij", weighted, design)
        right = torch.einsum("bmafi,bma->bafi", weighted, measurements.offsets)
        # prior: an offset gain of 0.1 counts as half blind
        prior = 1e-2 * weights.sum(1)[..., None]
        lift = torch.stack([prior, prior, 1e-12 * matrix[..., 2, 2].amax(-1, keepdim=True)], dim=-1)
        matrix = matrix + torch.diag_embed(lift.expand(right.shape) + 1e-300)
        explained.append((right * torch.linalg.solve(matrix, right[..., None])[..., 0]).sum(-1))
    return grid[torch.cat(explained, dim=-1).argmax(-1)]
