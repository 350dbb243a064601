"""Whether a detected vibration can be trusted, and why not."""

import math

import torch
from torch import Tensor

from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.tones.fit import MIN_GAIN, offset_gain
from rsvib_torch.detection.tones.selection import MIN_OFFSET, MIN_SIGNIFICANCE
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd

__all__ = ["judge"]

_LARGEST_UNCERTAINTY = 0.1  # of a frequency
_LEAST_GOOD = 0.5  # of the bands
_MAJORITY = 0.75  # of the bands: things that move by themselves may cover the others
_LARGEST_MISFIT = 0.3  # mean absolute residual over mean absolute offset about its mean
_SMALLEST_MISFIT = 0.05  # px, residuals below this are never held against a fit
_SMALLEST_OTHER = 0.03  # px, other motion below this is never held against a fit
_LARGEST_OTHER = 0.05  # of the rms offset that the tones make
_ROW_MOTION = 0.1  # px within a row time, condition (24)


def judge(
    vibration: Vibration,
    std: VibrationStd,
    *,
    offsets: Tensor,
    fitted: Tensor,
    shown: Tensor,
    intervals: Tensor,
    duration: float,
    timing: SensorTiming,
    other_motion: OtherMotion | None = None,
) -> tuple[Tensor, tuple[tuple[str, ...], tuple[str, ...]]]:
    """Verdict on one vibration (not a batch).

    Args:
        vibration: What was found.
        std: Its standard deviations.
        offsets: (M, 2) px measured offsets, NaN where unknown.
        fitted: (M, 2) px, what the result predicts.
        shown: (M,) bool, bands that both frames show.
        intervals: Times between the frames compared, s.
        duration: Length of the record in seconds.
        timing: The sensor.
        other_motion: What the rows tell that the vibration does not explain, where they were asked.

    Returns:
        (2,) bool and the reasons against each axis.
    """
    reasons: tuple[list[str], list[str]] = ([], [])
    good = torch.isfinite(offsets).all(-1) & shown
    share = float(good.double().sum() / shown.double().sum().clamp(min=1))
    # a uniform motion is smeared exactly at any speed: condition (24) is for what changes within a row time
    of_tones = Vibration(vibration.amplitude, vibration.frequency, vibration.phase)
    within_row = of_tones.displacement_within(timing.row_time).tolist()
    gain = offset_gain(vibration.frequency, intervals)
    for axis, found in enumerate(reasons):
        amplitude = vibration.amplitude[axis]
        if share < _LEAST_GOOD:
            found.append(
                f"too few good bands: {share:.0%} of {int(shown.sum())}; the motion is beyond the search range, or the "
                "frames show no detail or different scenes"
            )
        if not bool((amplitude > 0).any()):
            found.append("no significant tone")
        for k in amplitude.nonzero()[:, 0].tolist():
            found.extend(_against_tone(vibration, std, axis, k, float(gain[axis, k]), duration, timing))
        if bool(good.any()):
            values, model = offsets[good, axis], fitted[good, axis]
            misfits = (values - model).abs().sort().values
            misfit = float(misfits[: math.ceil(_MAJORITY * len(misfits))].mean())
            swing = float((values - values.mean()).abs().mean())
            if misfit > max(_SMALLEST_MISFIT, _LARGEST_MISFIT * swing):
                found.append(f"fit does not explain the curve: residual {misfit:.3g} px of {swing:.3g} px")
        if other_motion is not None:
            found.extend(_held_against(other_motion, axis, vibration.amplitude[axis] * gain[axis]))
        if within_row[axis] > _ROW_MOTION:
            found.append(f"moves {within_row[axis]:.2g} px within a row time, condition (24) allows {_ROW_MOTION} px")
    reliable = torch.tensor([not found for found in reasons], device=vibration.device)
    return reliable, (tuple(reasons[0]), tuple(reasons[1]))


def _against_tone(
    vibration: Vibration,
    std: VibrationStd,
    axis: int,
    tone: int,
    gain: float,
    duration: float,
    timing: SensorTiming,
) -> list[str]:
    """Reasons against one tone."""
    size, hertz = float(vibration.amplitude[axis, tone]), float(vibration.frequency[axis, tone])
    size_std, hertz_std = float(std.amplitude[axis, tone]), float(std.frequency[axis, tone])
    name = f"tone of {hertz:.4g} Hz"
    found = []
    if size < MIN_SIGNIFICANCE * size_std:
        found.append(f"{name} not significant: amplitude {size:.3g} +- {size_std:.2g} px")
    elif size * gain < MIN_OFFSET:
        found.append(f"{name} too small: offsets of {size * gain:.2g} px, below {MIN_OFFSET} px")
    elif hertz_std > _LARGEST_UNCERTAINTY * hertz:
        found.append(f"{name} not known well enough: frequency {hertz:.4g} +- {hertz_std:.2g} Hz")
    if gain < MIN_GAIN:
        found.append(f"{name} nearly blind: gain {gain:.3f} (every frame is displaced alike)")
    if hertz * duration < 1.0:
        found.append(f"{name} has a period longer than the record of {1e3 * duration:.3g} ms")
    if hertz * timing.exposure_time > 1.0:
        found.append(f"{name} is above 1/T_e = {1 / timing.exposure_time:.4g} Hz: the exposure averages it out")
    return found


def _held_against(other: OtherMotion, axis: int, swing: Tensor) -> list[str]:
    """Reasons from motion that no vibration explains, given the offset amplitudes (K,) of the tones."""
    allowed = max(_SMALLEST_OTHER, _LARGEST_OTHER * float(swing.square().sum().sqrt()) / 2**0.5)
    found = []
    if float(other.unexplained[axis]) > allowed:
        found.append(f"rows move by {float(other.unexplained[axis]):.3g} px that no tone explains")
    if float(other.slant[axis]) > allowed:
        found.append(
            f"left and right halves of the rows move apart by {float(other.slant[axis]):.3g} px: rotation or parallax"
        )
    return found
