"""Row order: any scan axis and readout direction become rows on axis -2 with the row read first at index 0.

A transpose swaps the x and y components of displacements; a flip along the rows changes the sign of y. Both change the
sign of roll.
"""

import torch
from torch import Tensor

from rsvib_torch.motion.timing import SensorTiming

__all__ = ["frames_from_row_order", "frames_to_row_order", "offsets_from_row_order"]


def frames_to_row_order(frames: Tensor, timing: SensorTiming) -> Tensor:
    """Turn frames (..., H, W) so that rows lie on axis -2 and row 0 is read first."""
    frames = frames.transpose(-2, -1) if timing.scan_axis == -1 else frames
    return frames.flip(-2) if timing.readout_direction == "reverse" else frames


def frames_from_row_order(frames: Tensor, timing: SensorTiming) -> Tensor:
    """Inverse of ``frames_to_row_order``."""
    frames = frames.flip(-2) if timing.readout_direction == "reverse" else frames
    return frames.transpose(-2, -1) if timing.scan_axis == -1 else frames


def offsets_from_row_order(offsets: Tensor, timing: SensorTiming) -> Tensor:
    """Turn displacements or offsets (..., A) in row order back to image axes (x, y) and, if A > 2, roll and zoom."""
    transposed, reverse = timing.scan_axis == -1, timing.readout_direction == "reverse"
    signs = [1.0, -1.0 if reverse else 1.0, -1.0 if transposed != reverse else 1.0, 1.0][: offsets.shape[-1]]
    if min(signs) < 0:
        offsets = offsets * torch.tensor(signs, dtype=offsets.dtype, device=offsets.device)
    return offsets[..., [1, 0, 2, 3][: offsets.shape[-1]]] if transposed else offsets
