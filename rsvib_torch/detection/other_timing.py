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
# of the square of the residual with the stated timing: 41 correct alternatives reached 0.1 or less after the first
# level. Of 17 wrong ones between 0.2 and 0.5, detection agreed with none
_SMALLER = 0.2
_ITERATIONS = 5  # of fits; most factors are wrong, and their fits converge slowly
_MINIMA, _EQUAL = 4, 4.0  # minima that are refined, and their squared residual over the least to count as equal


def period_factor(
    measurements: Measurements, timing: RowTiming, num_frames: int, block_rows: int
) -> tuple[float, Tensor] | None:
    """Factor of the frame start times with which one tone along each axis explains the measurements best.

    A row ``i`` of frame ``p`` starts its exposure at ``s_p + i row_time``. With the factor c, it is ``c s_p``: the
    rows of a frame and the phase from frame to frame must agree with the same frequency, which determines c. Reversed
    readout is c = -1, because a vibration in reversed time is a vibration.

    Args:
        measurements: Displacements of one stack (B = 1) of at least three frames, in row order.
        timing: The sensor.
        num_frames: Frames of the stack.
        block_rows: Rows of a measurement, which limit the frequency of the tones.

    Returns:
        c, 0.8 to 1.5, or -1, and the frequencies (1, 2, 1) in Hz of the tones; None if none explains the displacements
        clearly better than 1.
    """
    starts = timing.frame_starts(num_frames, measurements.exposure_starts.device)
    interval = max(block_rows * timing.row_time, 0.5 * timing.exposure_time)

    def fits(factors: Tensor, rows: int, frequencies: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Square of the residual of one tone along each axis and its frequency, for each factor."""
        every = max(1, measurements.exposure_starts.shape[1] // rows)
        trial = measurements.mapped(lambda values: values[:, ::every]).repeated(len(factors))
        frame = torch.searchsorted(starts, trial.exposure_starts.contiguous(), right=True).clamp(min=1) - 1
        moved = (factors[:, None, None] - 1.0) * (starts - starts[0])[frame]
        trial = replace(trial, exposure_starts=trial.exposure_starts + moved)
        if frequencies is None:
            fit = find_tones(trial, interval, 1, stretches=False, iterations=_ITERATIONS)
        else:
            active = torch.ones_like(frequencies, dtype=torch.bool)
            fit, _ = robust_fit(trial, frequencies, active, MotionModel(), iterations=_ITERATIONS)
        return typical_size(trial, fit), fit.frequencies

    ends = starts.new_tensor([1.0, -1.0])
    coarse = torch.arange(_SHORTEST, _LONGEST, _STEP, dtype=starts.dtype, device=starts.device)
    sizes, frequencies = fits(torch.cat([ends, coarse]), _ROWS[0])
    (stated, reverse), reversed_tones, sizes, frequencies = sizes[:2], frequencies[1:2], sizes[2:], frequencies[2:]
    if bool(reverse < torch.minimum(sizes.min(), _SMALLER * stated)):
        return -1.0, reversed_tones
    # a tone has the same phase after 1 / f more, so that several frame periods may agree: the next to 1 is probable
    inner = (sizes[1:-1] < sizes[:-2]) & (sizes[1:-1] < sizes[2:])
    minima = (inner.nonzero()[:, 0] + 1).tolist()
    minima = sorted(minima, key=sizes.tolist().__getitem__)[:_MINIMA]
    if not minima:
        return None
    factors, frequencies, step = coarse[minima], frequencies[minima], _STEP
    for _ in range(_LEVELS):
        around = step * torch.linspace(-1.0, 1.0, _POINTS, dtype=starts.dtype, device=starts.device)
        near = factors[:, None] + around
        sizes, found = fits(near.flatten(), _ROWS[1], frequencies.repeat_interleave(_POINTS, 0))
        least, best = sizes.unflatten(0, near.shape).min(1)
        factors = near.gather(1, best[:, None])[:, 0]
        frequencies = found.unflatten(0, near.shape)[torch.arange(len(best), device=best.device), best]
        step /= 4.0
        if bool((least >= _SMALLER * stated).all()):
            return None
    distance = torch.where(least <= _EQUAL * least.min(), (factors - 1.0).abs(), torch.inf)
    chosen = int(distance.argmin())
    if bool(least[chosen] >= _SMALLER * stated):
        return None
    return float(factors[chosen]), frequencies[chosen : chosen + 1]
