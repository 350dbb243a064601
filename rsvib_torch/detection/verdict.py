"""Whether a detected vibration can be trusted, and why not."""

import torch
from torch import Tensor

from rsvib_torch.detection.result import VibrationStd
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration

__all__ = ["judge"]

_LEAST_GAIN = 0.1  # |gain| below this multiplies noise more than tenfold
_LEAST_SIGNIFICANCE = 4.0  # amplitude over its standard deviation
_LEAST_GOOD = 0.5  # of the bands
_LARGEST_MISFIT = 0.3  # mean absolute residual over mean absolute offset about its mean
_SMALLEST_MISFIT = 0.05  # px, residuals below this are never held against a fit
_ROW_MOTION = 0.1  # px within a row time, condition (24)


def judge(
    vibration: Vibration,
    std: VibrationStd,
    *,
    offsets: Tensor,
    fitted: Tensor,
    intervals: Tensor,
    duration: float,
    timing: SensorTiming,
) -> tuple[Tensor, tuple[tuple[str, ...], tuple[str, ...]]]:
    """Verdict on one vibration (not a batch).

    Args:
        vibration: What was found.
        std: Its standard deviations.
        offsets: (M, 2) px measured offsets, NaN where unknown.
        fitted: (M, 2) px, what the result predicts.
        intervals: Distinct times between the frames compared, s.
        duration: Length of the record in seconds.
        timing: The sensor.

    Returns:
        (2,) bool and the reasons against each axis.
    """
    reasons: tuple[list[str], list[str]] = ([], [])
    good = torch.isfinite(offsets).all(-1)
    share = float(good.double().mean())
    within_row = vibration.displacement_within_row_time(timing.row_time).tolist()
    gain = torch.stack([vibration.gain(float(t)).abs() for t in intervals]).amax(0)
    for axis, found in enumerate(reasons):
        amplitude = vibration.amplitude[axis]
        if share < _LEAST_GOOD:
            found.append(f"too few good bands: {share:.0%} of {len(good)}")
        if not bool((amplitude > 0).any()):
            found.append("no significant tone")
        for k in range(len(amplitude)):
            size, hertz = float(amplitude[k]), float(vibration.frequency[axis, k])
            if size == 0:
                continue
            name = f"tone of {hertz:.4g} Hz"
            if size < _LEAST_SIGNIFICANCE * float(std.amplitude[axis, k]):
                found.append(f"{name} not significant: amplitude {size:.3g} +- {float(std.amplitude[axis, k]):.2g} px")
            if float(gain[axis, k]) < _LEAST_GAIN:
                found.append(f"{name} nearly blind: gain {float(gain[axis, k]):.3f} (every frame is displaced alike)")
            if hertz * duration < 1.0:
                found.append(f"{name} has a period longer than the record of {1e3 * duration:.3g} ms")
            if hertz * timing.exposure_time > 1.0:
                found.append(f"{name} is above 1/T_e = {1 / timing.exposure_time:.4g} Hz: the exposure averages it out")
        if bool(good.any()):
            values, model = offsets[good, axis], fitted[good, axis]
            misfit = float((values - model).abs().mean())
            swing = float((values - values.mean()).abs().mean())
            if misfit > max(_SMALLEST_MISFIT, _LARGEST_MISFIT * swing):
                found.append(f"fit does not explain the curve: residual {misfit:.3g} px of {swing:.3g} px")
        if within_row[axis] > _ROW_MOTION:
            found.append(f"moves {within_row[axis]:.2g} px within a row time, condition (24) allows {_ROW_MOTION} px")
    reliable = torch.tensor([not found for found in reasons], device=vibration.device)
    return reliable, (tuple(reasons[0]), tuple(reasons[1]))
