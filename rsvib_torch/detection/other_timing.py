"""Another frame period or readout direction with which the measured displacements agree, unlike the stated one.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import MotionModel
from rsvib_torch.detection.tones.selection import find_tones, robust_fit, typical_size
from rsvib_torch.motion.timing import RowTiming

__all__ = ["period_factor"]

_ROWS = (32, 128)  # measured rows that are used in the search and its refinement; more rows take longer only
_SHORTEST, _LONGEST, _STEP = 0.8, 1.5, 0.02  # frame periods that are tried, over the stated one
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
    starts = timing.frame_starts(num_frames, measurements.exposure_starts.device)
    interval = max(2.0 * timing.row_time, 0.5 * timing.exposure_time)

    def fits(factors: Tensor, rows: int, frequencies: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Square of the residual of one tone along each axis and its frequency, for each factor."""
        every = max(1, measurements.exposure_starts.shape[1] // rows)
        trial = measurements.mapped(lambda values: values[:, ::every]).repeated(len(factors))
        frame = torch.searchsorted(starts, trial.exposure_starts.contiguous(), right=True).clamp(min=1) - 1
        moved = (factors[:, None, None] - 1.0) * (starts - starts[0])[frame]
        trial = replace(trial, exposure_starts=trial.exposure_starts + moved)
        if frequencies is None:
            fit = find_tones(trial, interval, 1)
        else:
            frequencies = frequencies.expand(len(factors), -1, -1)
            fit, _ = robust_fit(trial, frequencies, torch.ones_like(frequencies, dtype=torch.bool), MotionModel())
        return typical_size(trial, fit), fit.frequencies

    ends = starts.new_tensor([1.0, -1.0])
    coarse = torch.arange(_SHORTEST, _LONGEST, _STEP, dtype=starts.dtype, device=starts.device)
    factors = torch.cat([ends, coarse])
    sizes, frequencies = fits(factors, _ROWS[0])
    stated, best = sizes[0], int(sizes.argmin())
    factor, least, step = factors[best], sizes[best], _STEP
    if factor > 0:
        for _ in range(_LEVELS):
            near = factor + step * torch.linspace(-1.0, 1.0, _POINTS, dtype=starts.dtype, device=starts.device)
            sizes, frequencies = fits(near, _ROWS[1], frequencies[best])
            best = int(sizes.argmin())
            factor, least, step = near[best], sizes[best], step / 4.0
    return float(factor) if bool(least < _SMALLER * stated) else None
