"""Where in a frame a scene row is found: the coupling of the scan with motion along it."""

import torch
from torch import Tensor

from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration

__all__ = ["rows_showing"]


def rows_showing(
    scene_rows: Tensor, frame_start: Tensor, timing: SensorTiming, vibration: Vibration, iterations: int = 8
) -> Tensor:
    """Frame rows r(s) that show scene rows s: the fixed point of ``r = s + Y(t(r))``.

    Row r is exposed from ``frame_start + r T_row`` on, and Y is the mean displacement over that exposure (Eq. 2).
    The iteration converges as fast as ``|dY/dt| T_row`` is small (0.02 for 5 px at 30 Hz).

    Args:
        scene_rows: Scene rows s, float64, shape S (batch dimensions of the vibration lead).
        frame_start: Exposure start of the frame's first row in seconds, broadcastable to S.
        timing: The sensor.
        vibration: The motion, in row order.
        iterations: Fixed-point steps.

    Returns:
        Frame rows, float64, broadcast shape of S and ``frame_start``.
    """
    scene_rows = scene_rows.to(torch.float64)
    rows = scene_rows + torch.zeros_like(frame_start)
    for _ in range(iterations):
        starts = frame_start + rows * timing.row_time
        rows = scene_rows + vibration.mean_displacement(starts, timing.exposure_time)[..., 1]
    return rows
