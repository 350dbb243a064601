"""Pixels that were not measured: which they are, and a first guess of what they would have shown."""

import torch
from torch import Tensor

__all__ = ["fill_roughly", "measured_values"]


def measured_values(along: Tensor, hidden: Tensor | None, shape: torch.Size, width: int) -> Tensor | None:
    """Which values (M, C, R, L) of the frames, moved ``along`` px to the restored one, count; None for all."""
    if hidden is None and not bool(along.any()):
        return None
    columns = torch.arange(shape[-1], device=along.device)
    scene = columns - along[:, None]
    seen = (columns < width) & (scene >= 0) & (scene < width)
    valid = seen[:, None, None].expand(shape).clone()
    if hidden is not None:
        valid[..., :width] &= ~hidden
    return valid


def fill_roughly(frames: Tensor, ignore: Tensor) -> Tensor:
    """Put local means where pixels (..., H, W) are to be ignored."""
    images, holes = frames.flatten(0, -3)[:, None], ignore.flatten(0, -3)[:, None]
    known = (~holes).to(frames.dtype)
    images = images * known
    filled = torch.where(known.sum((-2, -1), keepdim=True) > 0, images, torch.zeros_like(images))
    for size in (3, 9, 33, 129, 513, 2 * max(frames.shape[-2:]) + 1):
        weight = _box(known, size)
        mean = _box(images, size) / weight.clamp(min=1e-9)
        filled = torch.where(holes & (weight > 0), mean, filled)
        holes = holes & (weight <= 0)
        if not bool(holes.any()):
            break
    rough: Tensor = filled[:, 0].unflatten(0, frames.shape[:-2])
    return rough


def _box(images: Tensor, size: int) -> Tensor:
    half = size // 2
    for dim in (-2, -1):
        total = torch.nn.functional.pad(images.cumsum(dim), (1, 0) if dim == -1 else (0, 0, 1, 0))
        length = images.shape[dim]
        index = torch.arange(length, device=images.device)
        images = total.index_select(dim, (index + half + 1).clamp(max=length)) - total.index_select(
            dim, (index - half).clamp(min=0)
        )
    return images
