"""The verdict on a detected vibration: for each axis whether it is reliable, and the reasons if it is not."""

import math

import torch
from torch import Tensor

from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.tones.fit import MIN_GAIN, offset_gain
from rsvib_torch.detection.tones.selection import MIN_OFFSET, MIN_SIGNIFICANCE
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd

__all__ = ["judge"]


def judge(
    vibration: Vibration,
    std: VibrationStd,
    *,
    offsets: Tensor,
    fitted: Tensor,
    visible: Tensor,
    intervals: Tensor,
    duration: float,
    timing: RowTiming,
    other_motion: OtherMotion | None = None,
    min_bands: float = 0.5,
) -> tuple[Tensor, tuple[tuple[str, ...], tuple[str, ...]]]:
    """Verdict on one vibration (not a batch).

    Args:
        vibration: The detected vibration.
        std: Its standard deviations.
        offsets: (M, 2) px, measured offsets of row bands, NaN where a band could not be registered.
        fitted: (M, 2) px, offsets predicted by the vibration.
        visible: (M,) bool, bands that both frames contain.
        intervals: Times between the frames that were compared, s.
        duration: Length of the record in seconds.
        timing: The sensor, in row order.
        other_motion: Motion that the vibration does not explain; None if it was not measured.
        min_bands: Fraction of the visible bands that must be registered.

    Returns:
        (2,) bool and the reasons against each axis.
    """
    reasons: tuple[list[str], list[str]] = ([], [])
    good = torch.isfinite(offsets).all(-1) & visible
    share = float(good.double().sum() / visible.double().sum().clamp(min=1))
    # condition (24) concerns the tones only: the blur by a uniform motion is exact at any speed
    tones = Vibration(vibration.amplitude, vibration.frequency, vibration.phase)
    within_row, max_within_row = tones.displacement_within(timing.row_time).tolist(), 0.1  # px
    gain = offset_gain(vibration.frequency, intervals)
    for axis, against in enumerate(reasons):
        amplitude = vibration.amplitude[axis]
        if share < min_bands:
            against.append(
                f"only {share:.0%} of {int(visible.sum())} row bands can be registered, {min_bands:.0%} are needed: "
                "the motion is beyond the search range (increase search), or the frames lack detail or show different "
                "scenes"
            )
        if not bool((amplitude > 0).any()):
            against.append("no significant tone: the offsets are those of a uniform motion, or below their noise")
        for tone in amplitude.nonzero()[:, 0].tolist():
            against.extend(_against_tone(vibration, std, axis, tone, float(gain[axis, tone]), duration, timing))
        if bool(good.any()):
            against.extend(_against_fit(offsets[good, axis], fitted[good, axis]))
        if other_motion is not None:
            against.extend(_against_other_motion(other_motion, axis, amplitude * gain[axis]))
        if within_row[axis] > max_within_row:
            against.append(
                f"the image moves {within_row[axis]:.2g} px within a row time, condition (24) allows "
                f"{max_within_row} px: this is no vibration of the whole camera, or row_time is wrong"
            )
    reliable = torch.tensor([not against for against in reasons], device=vibration.device)
    return reliable, (tuple(reasons[0]), tuple(reasons[1]))


def _against_tone(
    vibration: Vibration,
    std: VibrationStd,
    axis: int,
    tone: int,
    gain: float,
    duration: float,
    timing: RowTiming,
    *,
    max_frequency_std: float = 0.1,
) -> list[str]:
    """Reasons against one tone; ``max_frequency_std`` is a fraction of its frequency."""
    size, hertz = float(vibration.amplitude[axis, tone]), float(vibration.frequency[axis, tone])
    size_std, hertz_std = float(std.amplitude[axis, tone]), float(std.frequency[axis, tone])
    name = f"tone of {hertz:.4g} Hz"
    against = []
    if size < MIN_SIGNIFICANCE * size_std:
        against.append(
            f"{name} is not significant: its amplitude is {size:.3g} ± {size_std:.2g} px, and {MIN_SIGNIFICANCE:g} "
            "standard deviations are needed; use more frames"
        )
    elif size * gain < MIN_OFFSET:
        against.append(
            f"{name} is too small: its offsets of {size * gain:.2g} px are below {MIN_OFFSET} px, where errors of "
            "interpolation may cause them"
        )
    elif hertz_std > max_frequency_std * hertz:
        against.append(
            f"{name} is uncertain: its frequency is {hertz:.4g} ± {hertz_std:.2g} Hz, {max_frequency_std:.0%} are "
            "allowed; use more frames"
        )
    if gain < MIN_GAIN:
        against.append(
            f"{name} is nearly blind: its gain is {gain:.3f}, {MIN_GAIN} is needed, because every frame is displaced "
            "alike; use frames at other or unequal intervals"
        )
    if hertz * duration < 1.0:
        against.append(
            f"{name} has a period of {1e3 / hertz:.3g} ms, longer than the record of {1e3 * duration:.3g} ms; use more "
            "frames"
        )
    if hertz * timing.exposure_time > 1.0:
        against.append(
            f"{name} is above 1/T_e = {1 / timing.exposure_time:.4g} Hz, where the exposure averages it out; use a "
            "shorter exposure"
        )
    return against


def _against_fit(offsets: Tensor, fitted: Tensor, *, counted: float = 0.75) -> list[str]:
    """Reasons from the residual of the best ``counted`` of the bands: clouds may cover the others."""
    residuals = (offsets - fitted).abs().sort().values
    residual = float(residuals[: math.ceil(counted * len(residuals))].mean())
    size = float((offsets - offsets.mean()).abs().mean())
    allowed = max(0.05, 0.3 * size)  # px; smaller residuals are errors of registration
    if residual <= allowed:
        return []
    return [
        f"the fit does not explain the offset curve: mean residual {residual:.3g} px, {allowed:.3g} px are allowed for "
        f"offsets of {size:.3g} px; try more tones or model='free'"
    ]


def _against_other_motion(other: OtherMotion, axis: int, offset_amplitudes: Tensor) -> list[str]:
    """Reasons from motion that no vibration explains, given the offset amplitudes (K,) of the tones in px."""
    rms_offset = float(offset_amplitudes.square().sum().sqrt()) / 2**0.5
    allowed = max(0.03, 0.05 * rms_offset)  # px; smaller values are errors of interpolation
    unexplained, differential = float(other.unexplained[axis]), float(other.differential[axis])
    against = []
    if unexplained > allowed:
        against.append(
            f"rows move by {unexplained:.3g} px that no tone explains, {allowed:.2g} px are allowed; try more tones or "
            "model='free'"
        )
    if differential > allowed:
        against.append(
            f"left and right halves of the rows move apart by {differential:.3g} px, {allowed:.2g} px are allowed: the "
            "camera rotates, or the scene has parallax"
        )
    return against
