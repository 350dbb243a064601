"""Short filters along an axis, as products with small matrices: faster than convolutions, and as exact anywhere."""

import torch
from torch import Tensor

from rsvib_torch.pieces import runs

__all__ = ["correlated", "toeplitz"]

_BLOCK, _LARGE_BLOCK = {"cpu": 64}, 256  # samples that one small dense matrix filters


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
    block = min(_BLOCK.get(samples.device.type, _LARGE_BLOCK), length)
    matrix = toeplitz(kernels, block, step)  # (Q, block, m)
    last = dim in (-1, samples.ndim - 1)
    moved = samples if last else samples.movedim(dim, -2)
    found = []
    for part in runs(length, block):
        count = part.stop - part.start
        own = matrix[:, :count, : (count - 1) * step + taps].flatten(0, 1)
        near = slice(part.start * step, (part.stop - 1) * step + taps)
        values = moved[..., near] @ own.T if last else own @ moved[..., near, :]
        found.append(values.unflatten(-1 if last else -2, (number, count)))
    if last:
        return torch.cat(found, -1).movedim(-2, 0)
    return torch.cat(found, -2).movedim(-3, 0).movedim(-2, dim + 1 if dim >= 0 else dim)
