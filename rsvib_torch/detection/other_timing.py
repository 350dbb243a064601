"""Another frame period or readout direction with which the measured displacements agree, unlike the stated one.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.selection import find_tones, typical_size
from rsvib_torch.motion.timing import RowTiming

__all__ = ["period_factor"]

_ROWS = 64  # measured rows that are used; all rows of 8 frames take four times as long and give the same minimum
_SHORTEST, _LONGEST, _STEP = 0.8, 1.5, 0.0125  # frame periods that are tried, over the stated one
_LEVELS, _POINTS = 4, 9  # refinement of the best one, each level in steps four times smaller
_SMALLER = 0.5  # of the square of the residual with the stated timing; correct alternatives reach 0.3 or less


def period_factor(measurements: Measurements, timing: RowTiming, num_frames: int) -> float | None:
    """Factor of the frame start times with which one tone along each axis explains the measurements best.

    A row ``i`` of frame ``p`` starts its exposure at ``s_p + i row_time``. With the factor c, it is ``c s_p``: the
    rows of a frame and the phase from frame to frame must agree with the same frequency, which determines c. Reversed
    readout is c = -1, because a vibration in reversed time is a vibration.

    Args:
        measurements: Displacements of one stack (B = 1) of at least three frames, in row order.
        timing: The sensor.
        num_frames: Frames of the stack.

    Returns:
        c, 0.8 to 1.5, or -1; None if none explains the displacements clearly better than 1.
    """
    every = max(1, measurements.exposure_starts.shape[1] // _ROWS)
    few = measurements._mapped(lambda values: values[:, ::every])
    starts = timing.frame_starts(num_frames, few.exposure_starts.device)
    frame = torch.searchsorted(starts, few.exposure_starts.contiguous(), right=True).clamp(min=1) - 1
    interval = max(2.0 * timing.row_time, 0.5 * timing.exposure_time)

    def size(factors: Tensor) -> Tensor:
        """Square of the residual of one tone along each axis, for each factor."""
        moved = (factors[:, None, None] - 1.0) * (starts - starts[0])[frame]
        trial = few.repeated(len(factors))
        trial = replace(trial, exposure_starts=trial.exposure_starts + moved)
        return typical_size(trial, find_tones(trial, interval, 1))

    ends = starts.new_tensor([1.0, -1.0])
    coarse = torch.arange(_SHORTEST, _LONGEST, _STEP, dtype=starts.dtype, device=starts.device)
    factors = torch.cat([ends, coarse])
    sizes = size(factors)
    stated, best = sizes[0], int(sizes.argmin())
    factor, least = factors[best], sizes[best]
    if factor > 0:
        step = _STEP
        for _ in range(_LEVELS):
            near = factor + step * torch.linspace(-1.0, 1.0, _POINTS, dtype=starts.dtype, device=starts.device)
            sizes = size(near)
            factor, least = near[sizes.argmin()], sizes.min()
            step /= 4.0
    return float(factor) if bool(least < _SMALLER * stated) else None
