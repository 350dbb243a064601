"""The door to the core: any scan axis and readout direction become rows on axis -2, first row read first.

Behind this door all code sees one orientation only. Frames are transposed and flipped, and displacements change
with them: a transpose swaps x and y, a flip along the rows turns the sign of y.
"""

import math

import torch
from torch import Tensor

from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration

__all__ = [
    "frames_from_row_order",
    "frames_to_row_order",
    "offsets_from_row_order",
    "vibration_from_row_order",
    "vibration_to_row_order",
]


def frames_to_row_order(frames: Tensor, timing: SensorTiming) -> Tensor:
    """Turn frames (..., H, W) so that rows lie on axis -2 and row 0 is read first."""
    frames = frames.transpose(-2, -1) if timing.scan_axis == -1 else frames
    return frames.flip(-2) if timing.readout_direction == "reverse" else frames


def frames_from_row_order(frames: Tensor, timing: SensorTiming) -> Tensor:
    """Undo ``frames_to_row_order``."""
    frames = frames.flip(-2) if timing.readout_direction == "reverse" else frames
    return frames.transpose(-2, -1) if timing.scan_axis == -1 else frames


def _mirror_rows(vibration: Vibration, timing: SensorTiming) -> Vibration:
    """The vibration seen in frames flipped along the rows (its own inverse)."""
    if timing.readout_direction == "forward":
        return vibration
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64, device=vibration.device)
    turn = torch.tensor([[0.0], [math.pi]], dtype=torch.float64, device=vibration.device)
    phase = torch.where(
        turn > 0, torch.remainder(vibration.phase + turn + math.pi, 2 * math.pi) - math.pi, vibration.phase
    )
    motion, acceleration = vibration.image_motion * sign, vibration.image_acceleration * sign
    tones = Vibration(vibration.amplitude, vibration.frequency, phase, motion, acceleration)
    return vibration.with_tones(tones, (1.0, -1.0)) if isinstance(vibration, FreeMotion) else tones


def _swap_axes(vibration: Vibration, timing: SensorTiming) -> Vibration:
    """The vibration seen in transposed frames (its own inverse)."""
    if timing.scan_axis == -2:
        return vibration
    tones = Vibration(
        vibration.amplitude.flip(-2),
        vibration.frequency.flip(-2),
        vibration.phase.flip(-2),
        vibration.image_motion.flip(-1),
        vibration.image_acceleration.flip(-1),
    )
    return vibration.with_tones(tones, swap=True) if isinstance(vibration, FreeMotion) else tones


def vibration_to_row_order(vibration: Vibration, timing: SensorTiming) -> Vibration:
    """The vibration, given in image axes, as seen in frames turned by ``frames_to_row_order``."""
    return _mirror_rows(_swap_axes(vibration, timing), timing)


def vibration_from_row_order(vibration: Vibration, timing: SensorTiming) -> Vibration:
    """Undo ``vibration_to_row_order``."""
    return _swap_axes(_mirror_rows(vibration, timing), timing)


def offsets_from_row_order(offsets: Tensor, timing: SensorTiming) -> Tensor:
    """Turn displacements or offsets (..., 2) measured in row order back to image axes (x, y)."""
    if timing.readout_direction == "reverse":
        offsets = offsets * torch.tensor([1.0, -1.0], dtype=offsets.dtype, device=offsets.device)
    return offsets.flip(-1) if timing.scan_axis == -1 else offsets
