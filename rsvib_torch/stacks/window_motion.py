"""The motion of the frames of one window: tones, or a motion of any shape if the vibration changes.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.detection import MotionDetection, detect_motion, detect_vibration
from rsvib_torch.detection.shapes.free import vibration_in_place_of
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import VibrationStd
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason

# Least number of knots of a motion in the rows of a frame. With 8, half of the axes of small frames (192 rows, one to
# six periods in a frame) were refused, which are reliable with 16 and 24.
_KNOTS = 16
_LEAST_FRAMES = 4  # fewer do not determine what a motion of any shape has in common in all frames
# Reasons against an axis whose tones may change within the record
_CHANGES = {"displacement_ambiguous", "rows_unexplained", "neighbours_unexplained"}


@dataclass(frozen=True, eq=False)
class WindowMotion:
    """How the frames of a window move."""

    motion: DetectedVibration | MotionDetection | FreeMotion  # what ``restore_trusted`` undoes
    tones: DetectedVibration | None  # the vibration, or tones in its place; None of a recorded motion

    @property
    def free(self) -> FreeMotion | None:
        """The motion of a vibration that changes; axes that are not reliable rest. None: ``tones`` are the motion."""
        if isinstance(self.motion, MotionDetection):
            return reliable_motion(self.motion)[0]
        return self.motion if self.tones is not None and isinstance(self.motion, FreeMotion) else None


def measured_motion(frames: Tensor, timing: SensorTiming, options: Mapping[str, Any]) -> WindowMotion:
    """The vibration in frames (full scale 1); ``options`` are those of ``detect_vibration``.

    Without options, a motion of any shape is measured if the tones may change, and taken if more axes are reliable.
    """
    detected = detect_vibration(frames, timing, **options)
    if options or not may_change(detected, len(frames)):
        return WindowMotion(detected, detected)
    rows = frames.shape[int(timing.scan_axis)]
    with suppress(ValueError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]
        found = detect_motion(frames, timing, knot_rows=min(24, max(4, rows // _KNOTS)))
        if found.reliable.sum() > detected.reliable.sum():
            return WindowMotion(found, _tones_of_detected(found, detected))
    return WindowMotion(detected, detected)


def known_motion(
    given: DetectedVibration | FreeMotion, frames: Tensor, timing: SensorTiming, *, is_recorded: bool
) -> WindowMotion:
    """A motion that is given for the frames of a window: recorded, or measured in an earlier run."""
    if isinstance(given, DetectedVibration):
        return WindowMotion(given, given)
    if is_recorded:
        return WindowMotion(given, None)
    starts, rows = timing.frame_starts(len(frames)), frames.shape[int(timing.scan_axis)]
    last = float(starts[-1]) + (rows - 1) * timing.row_time + timing.exposure_time
    unknown = torch.full((given.num_axes,), math.inf, dtype=torch.float64, device=given.coefficients.device)
    return WindowMotion(given, _tones_in_place_of(given, float(starts[0]), last, unknown, float(starts.diff().mean())))


def may_change(detection: DetectedVibration, num_frames: int) -> bool:
    """Whether tones that change within the frames may be why an axis of a steady vibration is not reliable.

    They are not if the frames agree with another timing: a motion of any shape explains them with a wrong one as well.
    """
    codes = {one.code for of_axis in detection.findings for one in of_axis}
    is_other_timing = any(code.startswith("other_") for code in codes)
    return num_frames >= _LEAST_FRAMES and not is_other_timing and not _CHANGES.isdisjoint(codes)


def reliable_motion(found: MotionDetection) -> tuple[FreeMotion, tuple[Reason, ...]]:
    """A motion of any shape without the axes that are not reliable, and a reason for each of these."""
    motion, factor = found.motion, found.reliable.to(found.motion.coefficients)
    kept = FreeMotion(
        motion.coefficients * factor[:, None], motion.start, motion.spacing, motion.tones.scaled(factor), motion.camera
    )
    refused = [
        Reason("axis_not_reliable", name, details={"action": "restored", "why": "; ".join(reasons)})
        for name, reasons in zip(AXIS_NAMES, found.reasons, strict=False)
        if reasons
    ]
    return kept, tuple(refused)


def _tones_of_detected(found: MotionDetection, refused: DetectedVibration) -> DetectedVibration:
    """Tones in place of a detected motion, with the reasons against those that were refused as assumptions.

    A wrong timing and lost frames have the same reasons as a vibration that changes.
    """
    against = zip(AXIS_NAMES, refused.findings, strict=False)
    assumed = tuple(
        f"the vibration changes; tones along {name} are refused: {one}" for name, of in against for one in of
    )
    first, last = float(found.times.min()), float(found.times.max())
    std, interval = found.std.square().mean((0, 1)).sqrt(), float(found.times[:, 0].diff().mean())
    tones = _tones_in_place_of(found.motion, first, last, std, interval)
    return replace(
        tones, residual=found.unexplained, reliable=found.reliable, findings=found.findings, assumptions=assumed
    )


def _tones_in_place_of(
    motion: FreeMotion, first: float, last: float, displacement: Tensor, interval: float
) -> DetectedVibration:
    """A tone for each axis of a motion of any shape, to draw it and list it beside the tones of other windows.

    The standard deviation of the frequency is half of the resolution of the record, which is that from ``first`` to
    ``last`` (s) with frames every ``interval``; ``displacement`` (A,) is the standard deviation of the motion.
    """
    vibration = vibration_in_place_of(motion, first, last)
    amplitude, frequency = vibration.amplitude, vibration.frequency
    unknown = torch.full_like(amplitude, math.inf)
    by_frequency = torch.full_like(amplitude, 0.5 / (last - first))
    std = VibrationStd(
        amplitude=math.sqrt(2) * displacement[:, None],
        frequency=by_frequency,
        phase=unknown,
        period=by_frequency / frequency.square().clamp(min=1e-300),
        image_motion=math.sqrt(12) * displacement / (last - first),
        image_acceleration=unknown[:, 0],
        displacement=displacement,
    )
    moves = motion.moving_axes()
    none, findings = torch.zeros_like(displacement), tuple(() for _ in moves)
    return DetectedVibration(vibration, std, vibration.gain(interval), none, moves, findings, assumptions=())
