"""The door to the core: any scan axis and readout direction become rows on axis -2, first row read first.

Behind this door all code sees one orientation only. Frames are transposed and flipped, and displacements change
with them: a transpose swaps x and y, a flip along the rows turns the sign of y.
"""

import math

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_number
from rsvib_torch.frames.arrays import ArrayLike, as_tensor
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration

__all__ = [
    "as_float_frames",
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


def as_float_frames(
    frames: ArrayLike,
    full_scale: float | None = None,
    *,
    minimum_frames: int = 1,
    nan_is_missing: bool = False,
    name: str = "frames",
) -> Tensor:
    """Check a stack of frames and turn integers into floats where full scale is 1.

    Floats keep their values and dtype. 8-bit integers have full scale 255; other integers do not say theirs (a
    16-bit file may hold 12-bit counts), so it has to be stated.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W); a NumPy array is accepted.
        full_scale: Count that means 1.0, for integer frames.
        minimum_frames: How many frames the stack must have.
        nan_is_missing: NaN marks a pixel that was not measured and is let through; infinity never is.
        name: What the frames are called in messages.

    Returns:
        Floating-point tensor of the same shape.

    Raises:
        TypeError: If the frames are not a tensor or array of numbers.
        ValueError: If the shape is not that of a stack, there are too few frames, a pixel is NaN or infinite, or
            integer frames come without a known full scale.

    Example:
        >>> as_float_frames(torch.full((2, 4, 4), 255, dtype=torch.uint8)).max().item()
        1.0
    """
    frames = as_tensor(name, frames)
    if frames.ndim not in (3, 4, 5):
        raise ValueError(
            f"{name} must have shape (T, H, W), (T, C, H, W) or (B, T, C, H, W), got {tuple(frames.shape)}"
        )
    count = frames.shape[time_axis(frames)]
    if count < minimum_frames:
        raise ValueError(f"at least {minimum_frames} frames are needed, got {count}")
    if min(frames.shape) == 0:
        raise ValueError(f"{name} must not be empty, got shape {tuple(frames.shape)}")
    if frames.dtype.is_complex or frames.dtype == torch.bool:
        raise TypeError(f"{name} must be real numbers, got {frames.dtype}")
    if frames.dtype.is_floating_point:
        if not bool(torch.isfinite(torch.stack(frames.aminmax())).all()):  # one pass: NaN and infinity come through
            wrong = torch.isinf(frames) if nan_is_missing else ~torch.isfinite(frames)
            if not bool(wrong.any()):
                return frames
            bad = wrong.nonzero()[0].tolist()
            raise ValueError(f"{name} must be finite, but pixel {tuple(bad)} is {frames[tuple(bad)].item()}")
        return frames
    if full_scale is None:
        if frames.dtype != torch.uint8:
            raise ValueError(
                f"{frames.dtype} {name} do not say their full scale; state full_scale, e.g. 4095 for 12-bit counts"
            )
        full_scale = 255.0
    return frames.to(torch.float32) / check_number("full_scale", full_scale, above=0.0)


def time_axis(frames: Tensor) -> int:
    """Index of the time axis of a stack: 0, or 1 where a batch leads."""
    return 1 if frames.ndim == 5 else 0
