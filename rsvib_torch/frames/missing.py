"""Pixels that were not measured: what to put in their place until something better is known."""

import torch
from torch import Tensor

__all__ = ["fill_roughly"]


def fill_roughly(frames: Tensor, ignore: Tensor) -> Tensor:
    """Put local means where pixels (..., H, W) are to be ignored.

    Example:
        >>> frames = torch.tensor([[[1.0, 2.0, 3.0]]])
        >>> fill_roughly(frames, torch.tensor([[[False, True, False]]])).tolist()
        [[[1.0, 2.0, 3.0]]]
    """
    images, holes = frames.flatten(0, -3)[:, None], ignore.flatten(0, -3)[:, None]
    known = (~holes).to(frames.dtype)
    images = torch.where(holes, torch.zeros_like(images), images)
    filled = images
    for size in (3, 9, 33, 129, 513, 2 * max(frames.shape[-2:]) + 1):
        weight = _box(known, size)
        mean = _box(images, size) / weight.clamp(min=1e-9)
        filled = torch.where(holes & (weight > 0.5), mean, filled)
        holes = holes & (weight <= 0.5)
        if not bool(holes.any()):
            break
    rough: Tensor = filled[:, 0].unflatten(0, frames.shape[:-2])
    return rough


def _box(images: Tensor, size: int) -> Tensor:
    """Sums over squares of ``size`` px, clipped at the edges."""
    half = size // 2
    for dim in (-2, -1):
        total = torch.nn.functional.pad(images.cumsum(dim), (1, 0) if dim == -1 else (0, 0, 1, 0))
        length = images.shape[dim]
        index = torch.arange(length, device=images.device)
        images = total.index_select(dim, (index + half + 1).clamp(max=length)) - total.index_select(
            dim, (index - half).clamp(min=0)
        )
    return images
