"""The door to restoration: orientation, batches and dtypes resolved once, then one of the methods."""

import inspect
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from rsvib_torch.checks import check_choice
from rsvib_torch.orientation import (
    as_float_frames,
    frames_from_row_order,
    frames_to_row_order,
    vibration_to_row_order,
)
from rsvib_torch.restoration.banded import restore_banded
from rsvib_torch.restoration.dewarp import restore_dewarp
from rsvib_torch.restoration.exact import restore_exact
from rsvib_torch.restoration.motion import as_batch, frame_motion
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration

__all__ = ["METHODS", "VibrationRestorer", "restore"]

METHODS: dict[str, Callable[..., Tensor]] = {"exact": restore_exact, "banded": restore_banded, "dewarp": restore_dewarp}


def _check_options(method: str, options: dict[str, Any]) -> None:
    known = [
        name
        for name, parameter in inspect.signature(METHODS[method]).parameters.items()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY
    ]
    for name in options:
        if name not in known:
            raise TypeError(f"method={method!r} has no option {name!r}; its options are {', '.join(known)}")


def _with_added_axes(frames: Tensor) -> Tensor:
    """A stack as (B, T, C, H, W)."""
    frames = frames[None] if frames.ndim < 5 else frames
    return frames[:, :, None] if frames.ndim < 5 else frames


def _without_ignored(
    frames: Tensor, ignore: Tensor, timing: SensorTiming, options: dict[str, Any]
) -> tuple[Tensor, dict[str, Any]]:
    """Blank the pixels to be ignored and hand their mask on, in row order."""
    frames = torch.as_tensor(frames)
    if not isinstance(ignore, Tensor) or ignore.dtype != torch.bool or ignore.shape != frames.shape:
        raise ValueError(f"ignore must be a boolean mask of shape {tuple(frames.shape)} like the frames")
    if bool(ignore.all()):
        raise ValueError("ignore leaves no pixel")
    mask = frames_to_row_order(_with_added_axes(ignore), timing)
    return frames.masked_fill(ignore, 0), {**options, "ignore": mask}


def _without_added_axes(restored: Tensor, ndim: int) -> Tensor:
    """Take the batch and channel axes away that a stack of ``ndim`` axes came without."""
    restored = restored if ndim == 5 else restored[0]
    return restored[:, 0] if ndim == 3 else restored


def restore(
    frames: Tensor,
    timing: SensorTiming,
    vibration: Vibration,
    *,
    method: str = "exact",
    full_scale: float | None = None,
    ignore: Tensor | None = None,
    **options: Any,
) -> Tensor:
    """Restore frames taken by a vibrating rolling-shutter camera: geometry and sharpness.

    A restored frame shows the scene at rest. With a uniform image motion it shows the scene moved by the whole pixels
    of that motion at the middle of the frame (``visible_pixels`` tells them); what a frame never exposed, a rim as
    wide as the displacement, is continued by mirroring (``visible_pixels`` tells which pixels those are).

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) in image orientation.
        timing: The sensor.
        vibration: The motion in image axes: one for all, or a batch (B,) for a batch of stacks.
        method: ``"exact"``: all rows coupled, several frames jointly on demand; ``"banded"``: row by row within
            slabs (Sec. 3.2 of Liu et al. 2023); ``"dewarp"``: geometry only, fastest.
        full_scale: Count that means 1.0, for integer frames other than uint8.
        ignore: Boolean mask shaped like the frames of pixels that do not count (no data, saturated); they may hold
            anything, NaN included, and are filled from the others. Method ``"exact"`` only.
        **options: Options of the method, see ``restore_exact``, ``restore_banded`` and ``restore_dewarp``.

    Returns:
        Restored frames of the same shape and floating dtype (float32 where integers went in, full scale 1); with
        ``joint=True`` the time axis has length 1.

    Raises:
        TypeError: If an argument has the wrong type or the method does not know an option.
        ValueError: If a value is out of range, or frames, timing and vibration do not fit together.

    Example:
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> round(restore(torch.full((2, 64, 48), 0.5), timing, Vibration(2.0, 50.0)).mean().item(), 5)
        0.5
    """
    check_choice("method", method, tuple(METHODS))
    if ignore is not None:
        frames, options = _without_ignored(frames, ignore, timing, options)
    _check_options(method, options)
    images = as_float_frames(frames, full_scale)
    dtype = images.dtype
    if dtype not in (torch.float32, torch.float64):
        images = images.to(torch.float32)
    images = _with_added_axes(images)
    images = frames_to_row_order(images, timing)
    B, T, _, H, _ = images.shape
    rowwise = timing.in_row_order()
    rowwise.check_rows(H)
    if vibration.batch_shape not in ((), (B,)) or (vibration.batch_shape and torch.as_tensor(frames).ndim < 5):
        raise ValueError(
            f"vibration of batch shape {tuple(vibration.batch_shape)} does not fit frames of shape "
            f"{tuple(torch.as_tensor(frames).shape)}; one vibration, or one per stack of a (B, T, C, H, W) batch"
        )
    motion = vibration_to_row_order(vibration, timing).to(images.device)
    motion = motion if motion.batch_shape else as_batch(motion, B)
    restored = METHODS[method](images, frame_motion(motion, rowwise, T, H), **options)
    restored = frames_from_row_order(restored, timing)
    return _without_added_axes(restored, torch.as_tensor(frames).ndim).to(dtype)


class VibrationRestorer(nn.Module):
    """``restore`` as a module.

    Args:
        timing: The sensor.
        method: As in ``restore``.
        full_scale: As in ``restore``.
        **options: As in ``restore``.
    """

    def __init__(
        self, timing: SensorTiming, *, method: str = "exact", full_scale: float | None = None, **options: Any
    ) -> None:
        super().__init__()
        check_choice("method", method, tuple(METHODS))
        _check_options(method, options)
        self.timing = timing
        self.method = method
        self.full_scale = full_scale
        self.options = options

    def forward(self, frames: Tensor, vibration: Vibration) -> Tensor:
        """Restore a stack of frames."""
        return restore(frames, self.timing, vibration, method=self.method, full_scale=self.full_scale, **self.options)
