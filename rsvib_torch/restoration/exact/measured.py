"""Pixels that were not measured: which they are, and a first guess of what they would have shown."""

import torch
from torch import Tensor

__all__ = ["measured_values"]


def measured_values(
    along: Tensor, hidden: Tensor | None, shape: torch.Size, width: int, *, ends: bool = False
) -> Tensor | None:
    """Which values (M, C, R, L) of the frames, moved ``along`` px to the restored one, count; None for all.

    What rows are continued with beyond their ends counts as measured unless ``ends`` are to be filled as well.
    """
    moved = ends or bool(along.any())
    if hidden is None and not moved:
        return None
    columns = torch.arange(shape[-1], device=along.device)
    scene = columns - along[:, None]
    # what rows are continued with beyond their ends is right only for frames that show the same columns
    seen = (columns < width) & (scene >= 0) & (scene < width) | (not moved)
    valid = seen[:, None, None].expand(shape).clone()
    if hidden is not None:
        valid[..., :width] &= ~hidden
    return valid
