"""Noise level and scene prior estimated from the frames themselves."""

import math

import torch
from torch import Tensor

__all__ = ["estimate_noise", "gradient_energy"]

_BLOCK = 16
_QUANTILE = 0.15


def estimate_noise(frames: Tensor) -> Tensor:
    """Standard deviation of white noise in each image.

    The outer product of two fourth differences leaves the corner of the spectrum, where optics pass least; of its
    energy in blocks of 16 x 16 px only the quietest part is taken, where there is no texture.

    Args:
        frames: (..., H, W).

    Returns:
        Standard deviation, shape (...).

    Example:
        >>> noise = torch.randn(200, 300, generator=torch.Generator().manual_seed(0))
        >>> round(estimate_noise(0.1 * noise).item(), 2)
        0.1
    """
    detail = frames
    for axis in (-2, -1):
        for _ in range(min(4, frames.shape[axis] - 1)):
            detail = detail.diff(dim=axis)
    energy_of_mask = math.prod(math.comb(2 * (n := min(4, size - 1)), n) for size in frames.shape[-2:])
    detail = detail.square() / energy_of_mask
    block = min(_BLOCK, detail.shape[-2], detail.shape[-1])
    height, width = (size // block * block for size in detail.shape[-2:])
    blocks = detail[..., :height, :width].unflatten(-1, (-1, block)).unflatten(-3, (-1, block)).mean((-3, -1))
    energy = blocks.flatten(-2)
    # means of pure noise scatter (6.9: neighbouring responses of the mask are correlated), so that their low
    # quantile lies below the true mean
    spread = 1.0364 * (2.0 * 6.9 / block**2) ** 0.5
    quiet = energy.to(torch.float32).quantile(_QUANTILE, dim=-1).to(energy.dtype)
    deviation: Tensor = (quiet / (1.0 - min(spread, 0.5))).sqrt()
    return deviation


def gradient_energy(frames: Tensor) -> Tensor:
    """Mean square difference of neighbouring pixels, per axis and image, shape (...).

    Args:
        frames: (..., H, W).
    """
    across = (frames[..., 1:, :] - frames[..., :-1, :]).square().mean((-2, -1))
    along = (frames[..., 1:] - frames[..., :-1]).square().mean((-2, -1))
    return 0.5 * (across + along)
