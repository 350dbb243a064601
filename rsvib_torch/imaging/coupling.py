"""Where in a frame a scene row is found: the coupling of the scan with motion along it."""

import torch
from torch import Tensor

from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming

__all__ = ["rows_showing"]

_STEPS, _FEW = 8, 3  # of Newton's method, and those that are mostly enough, the last one with the slope before it
_TINY = 1e-9  # px: a step as small as that leaves next to nothing


def rows_showing(scene_rows: Tensor, frame_start: Tensor, timing: RowTiming, vibration: Motion) -> Tensor:
    """Frame rows r(s) that show scene rows s: the solution of ``r = s + Y(t(r))``.

    Row r is exposed from ``frame_start + r T_row`` on, and Y is the mean displacement over that exposure (Eq. 2).
    Newton's method; ``|dY/dt| T_row`` is 0.02 for 5 px at 30 Hz, and must stay below 1: content that runs along with
    the scan as fast as the rows is never passed.

    Args:
        scene_rows: Scene rows s, float64, shape S (batch dimensions of the vibration lead).
        frame_start: Exposure start of the frame's first row in seconds, broadcastable to S.
        timing: The sensor, in row order.
        vibration: The motion, in row order.

    Returns:
        Frame rows, float64, broadcast shape of S and ``frame_start``.
    """
    scene_rows = scene_rows.to(torch.float64)
    rows = scene_rows + torch.zeros_like(frame_start)
    for taken in range(1, _STEPS + 1):
        starts = frame_start + rows * timing.row_time
        miss = scene_rows + vibration.mean_displacement(starts, timing.exposure_time)[..., 1] - rows
        if taken != _FEW:  # Newton's step: an image motion of half a frame moves 0.5 px a row time
            slope = vibration.velocity(starts + 0.5 * timing.exposure_time)[..., 1].detach() * timing.row_time
        step = miss / (1.0 - slope).clamp(min=0.1)
        rows = rows + step
        if taken == _FEW and bool((step.abs() < _TINY).all()):
            break
    return rows
