"""Short filters along an axis, as products with small matrices: faster than convolutions, and as exact anywhere."""

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs

__all__ = ["correlated", "toeplitz"]

_BLOCK, _FEW_ROWS, _LARGE_BLOCK = {"cpu": 64}, {"cpu": 8}, 256  # samples that one small dense matrix filters


def toeplitz(kernels: Tensor, rows: int, step: int = 1) -> Tensor:
    """The matrix that correlates with kernels.

    Args:
        kernels: (..., N) taps.
        rows: How many values it makes.
        step: Samples from one value to the next.

    Returns:
        (..., rows, (rows - 1) step + N).

    Example:
        >>> toeplitz(torch.tensor([1.0, 2.0]), 2).tolist()
        [[1.0, 2.0, 0.0], [0.0, 1.0, 2.0]]
    """
    taps = kernels.shape[-1]
    matrix = kernels.new_zeros(*kernels.shape[:-1], rows, (rows - 1) * step + taps)
    row = torch.arange(rows, device=kernels.device)[:, None]
    matrix[..., row, step * row + torch.arange(taps, device=kernels.device)] = kernels[..., None, :]
    return matrix


def correlated(samples: Tensor, kernels: Tensor, dim: int, step: int = 1) -> Tensor:
    """Correlate along an axis with several kernels at once, where they fit in.

    Args:
        samples: Real or complex, at least as long as the kernels along ``dim``.
        kernels: (Q, N) taps, of the same dtype.
        dim: Axis to filter.
        step: Samples from one value to the next.

    Returns:
        Values like the samples, but ``(n - N) // step + 1`` of n along ``dim``; a leading dimension counts kernels.

    Example:
        >>> correlated(torch.arange(5.0), torch.tensor([[-1.0, 1.0], [0.5, 0.5]]), 0).tolist()
        [[1.0, 1.0, 1.0, 1.0], [0.5, 1.5, 2.5, 3.5]]
    """
    if samples.ndim == 1:
        return correlated(samples[None], kernels, 1, step)[:, 0]
    number, taps = kernels.shape
    length = (samples.shape[dim] - taps) // step + 1
    if dim not in (-1, samples.ndim - 1):
        found = _across(samples.movedim(dim, -2), kernels, step, length)
        return found.movedim(-2, dim + 1 if dim >= 0 else dim)
    block = min(_BLOCK.get(samples.device.type, _LARGE_BLOCK), length)
    matrix = toeplitz(kernels, block, step)  # (Q, block, m)
    parts = []
    for part in runs(length, block):
        count = part.stop - part.start
        own = matrix[:, :count, : (count - 1) * step + taps].flatten(0, 1)
        values = samples[..., part.start * step : (part.stop - 1) * step + taps] @ own.T
        parts.append(values.unflatten(-1, (number, count)))
    return torch.cat(parts, -1).movedim(-2, 0)


def _across(samples: Tensor, kernels: Tensor, step: int, length: int) -> Tensor:
    """``correlated`` across rows (..., n, W): (Q, ..., length, W). Small matrices, as a batch: few zeros in them."""
    number, taps = kernels.shape
    block = min(_FEW_ROWS.get(samples.device.type, _LARGE_BLOCK), length)
    span = (block - 1) * step + taps
    count = length // block
    own = toeplitz(kernels, block, step).flatten(0, 1)
    windows = samples.unfold(-2, span, block * step).mT  # (..., count, span, W)
    blocks: Tensor = (own @ windows).unflatten(-2, (number, block)).movedim(-3, 0).flatten(-3, -2)
    rest = length - count * block
    if not rest:
        return blocks
    return torch.cat([blocks, _across(samples[..., count * block * step :, :], kernels, step, rest)], -2)
