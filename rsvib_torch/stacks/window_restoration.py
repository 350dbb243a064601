"""One window: which of its frames can be used, how they move, their restoration, and whether that helps.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import check_pixels
from rsvib_torch.detection import MotionDetection, detect_motion, detect_vibration
from rsvib_torch.detection.shapes.free import vibration_in_place_of
from rsvib_torch.frames.full_scale import counts_to_frames
from rsvib_torch.frames.prepare import constant_frame, is_constant, prepare_frames
from rsvib_torch.imaging.sensor_model import sharpened
from rsvib_torch.io.stack_reading import channels_of
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming, with_lost_frame
from rsvib_torch.motion.vibration import VibrationStd
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import RestorationOptions
from rsvib_torch.restoration import RestorationVerdict, TooLittleInCommonError
from rsvib_torch.restoration.frame_motion import vibration_to_undo
from rsvib_torch.restoration.judge import judge_prepared
from rsvib_torch.restoration.restore import as_taken, check_optics, restore_prepared, warn_of_mosaic
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason

# --- Frames ---


def usable_frame(stored: Array | str, index: int, full_scale: float | None, nodata: float | None) -> Tensor:
    """Pixels of a stored frame with full scale 1; the ``ValueError`` states why it cannot be used, or was not read."""
    if isinstance(stored, str):
        raise ValueError(stored)
    frame = counts_to_frames(stored, full_scale, f"frame {index}", nodata)
    missing = torch.isnan(frame)
    valid = 1.0 - float(missing.double().mean())
    if valid < 0.1:
        raise ValueError(f"frame {index} has only {valid:.1%} of pixels that count")
    check_pixels(f"pixels of frame {index}", frame.masked_fill(missing, 0.0))
    if is_constant(*frame[~missing].aminmax()):
        raise ValueError(constant_frame(index))
    return frame


# --- Motion ---

# Least number of knots of a motion in the rows of a frame. With 8, half of the axes of small frames (192 rows, one to
# six periods in a frame) were refused, which are reliable with 16 and 24.
_KNOTS = 16
_LEAST_FRAMES = 4  # fewer do not determine what a motion of any shape has in common in all frames
# Reasons against an axis whose tones may change within the record
_CHANGES = {"displacement_ambiguous", "rows_unexplained", "neighbours_unexplained"}


@dataclass(frozen=True, eq=False)
class WindowMotion:
    """How the frames of a window move, and when they were taken."""

    motion: DetectedVibration | MotionDetection | FreeMotion  # what ``restore_trusted`` undoes
    tones: DetectedVibration | None  # the vibration, or tones in its place; None of a motion that was given
    timing: SensorTiming  # of the frames
    free: FreeMotion | None = None  # that of a vibration that changes, whose axes rest that are not reliable
    lost_before: int | None = None  # the first frame of the window after a lost one; its later time is in ``timing``


def measured_motion(frames: Tensor, timing: SensorTiming, options: Mapping[str, Any]) -> WindowMotion:
    """The vibration in frames (full scale 1); ``options`` are those of ``detect_vibration``.

    If the frames agree with a lost one, its time is taken into account. Without options, a motion of any shape is
    measured if the tones may change, and taken if more axes are reliable.
    """
    channels = channels_of(frames)
    detected = detect_vibration(frames, timing, channels=channels, **options)
    lost = next((one.details["after"] for one in detected.findings[0] if one.code == "other_frame_times"), None)
    if isinstance(lost, int):
        timing = with_lost_frame(timing, len(frames), lost)
        detected = detect_vibration(frames, timing, channels=channels, **options)
        return WindowMotion(detected, detected, timing, lost_before=lost)
    if options or not may_change(detected, len(frames)):
        return WindowMotion(detected, detected, timing)
    rows = frames.shape[int(timing.scan_axis)]
    with suppress(ValueError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]
        knot_rows = min(24, max(4, rows // _KNOTS))
        free = detect_motion(frames, timing, channels=channels, knot_rows=knot_rows)
        if free.reliable.sum() > detected.reliable.sum():
            return WindowMotion(free, _tones_in_place_of(free, detected), timing, reliable_motion(free)[0])
    return WindowMotion(detected, detected, timing)


def may_change(detection: DetectedVibration, num_frames: int) -> bool:
    """Whether tones that change within the frames may be why an axis of a steady vibration is not reliable.

    They are not if the frames agree with another timing: a motion of any shape explains them with a wrong one as well.
    """
    codes = {one.code for of_axis in detection.findings for one in of_axis}
    is_other_timing = any(code.startswith("other_") for code in codes)
    return num_frames >= _LEAST_FRAMES and not is_other_timing and not _CHANGES.isdisjoint(codes)


def reliable_motion(detection: MotionDetection) -> tuple[FreeMotion, tuple[Reason, ...]]:
    """A motion of any shape without the axes that are not reliable, and a reason for each of these."""
    motion, factor = detection.motion, detection.reliable.to(detection.motion.coefficients)
    kept = FreeMotion(
        motion.coefficients * factor[:, None], motion.start, motion.spacing, motion.tones.scaled(factor), motion.camera
    )
    refused = [
        Reason("axis_not_reliable", name, details={"action": "restored", "why": "; ".join(reasons)})
        for name, reasons in zip(AXIS_NAMES, detection.reasons, strict=False)
        if reasons
    ]
    return kept, tuple(refused)


def _tones_in_place_of(free: MotionDetection, refused: DetectedVibration) -> DetectedVibration:
    """A tone for each axis of a detected motion, to draw it and list it beside the tones of other windows.

    The standard deviation of the frequency is half of the resolution of the record. The reasons against the ``refused``
    tones are assumptions, because a wrong timing and lost frames have the same reasons as a vibration that changes.
    """
    against = zip(AXIS_NAMES, refused.findings, strict=False)
    assumed = tuple(
        f"the vibration changes; tones along {name} are refused: {one}" for name, of in against for one in of
    )
    first, last = float(free.times.min()), float(free.times.max())
    displacement = free.std.square().mean((0, 1)).sqrt()
    vibration = vibration_in_place_of(free.motion, first, last)
    unknown = torch.full_like(vibration.amplitude, math.inf)
    by_frequency = torch.full_like(vibration.amplitude, 0.5 / (last - first))
    std = VibrationStd(
        amplitude=math.sqrt(2) * displacement[:, None],
        frequency=by_frequency,
        phase=unknown,
        period=by_frequency / vibration.frequency.square().clamp(min=1e-300),
        image_motion=math.sqrt(12) * displacement / (last - first),
        image_acceleration=unknown[:, 0],
        displacement=displacement,
    )
    gain = vibration.gain(float(free.times[:, 0].diff().mean()))
    return DetectedVibration(vibration, std, gain, free.unexplained, free.reliable, free.findings, assumed)


# --- Restoration and verdict ---


@dataclass(frozen=True, eq=False)
class RestoredFrames:
    """Result of ``restore_trusted``."""

    frames: Tensor  # to write: restored, or as taken
    restored: bool  # whether they are restored
    left_alone: tuple[Reason, ...]  # a reason for each axis that was not restored
    # whether restoration helps; None if nothing moves, or frames could not be compared, which are restored then
    verdict: RestorationVerdict | None
    lost_rows: Mapping[int, int]  # number for each of the frames that has some


def restore_trusted(
    frames: Tensor,
    timing: SensorTiming,
    motion: Motion | DetectedVibration | MotionDetection,
    options: RestorationOptions,
    *,
    force: bool = False,
    first_frames: int | None = None,
    most_pairs: int | None = None,
) -> RestoredFrames:
    """Restore frames with a motion, or the reliable part of a detection, and judge whether that helps.

    The full scale of the frames is 1; ``options`` are those of ``restore``. Only the ``first_frames`` are restored, and
    at most ``most_pairs`` are compared. They are returned as taken if nothing moves, or, without ``force``, if
    restoration makes them worse.
    """
    vibration: Motion
    if isinstance(motion, MotionDetection):
        vibration, left_alone = reliable_motion(motion)
    else:
        vibration, left_alone = vibration_to_undo(motion, timing)
    frames = frames if first_frames is None else frames[:first_frames]
    joint, scale, optics = options.joint, options.scale, check_optics(options.optics)
    channels = channels_of(frames)
    prepared = prepare_frames(frames, timing, channels=channels, saturation=options.saturation, mosaic=options.mosaic)
    lost = prepared.lost_rows()
    if not bool(vibration.moving_axes().any()):
        unchanged = prepared.from_row_order(as_taken(prepared, joint, scale))
        return RestoredFrames(unchanged, False, left_alone, None, lost)
    warn_of_mosaic(prepared)
    restored = restore_prepared(prepared, vibration, options)
    verdict = None
    with suppress(TooLittleInCommonError):
        if len(frames) > 1:
            verdict = judge_prepared(prepared, restored, vibration, joint=joint, most_pairs=most_pairs)
    keep = verdict is None or verdict.overall != "worse" or force
    if keep:
        restored = sharpened(restored, optics, scale)
    result = prepared.from_row_order(restored if keep else as_taken(prepared, joint, scale))
    return RestoredFrames(result, keep, left_alone, verdict, lost)


def without_data(frames: Tensor, taken: Tensor) -> Tensor:
    """Restored frames with NaN at the pixels without data of the frames as taken; of one image, without data in all."""
    points = frames.shape[-1] // taken.shape[-1]
    missing = torch.isnan(taken).repeat_interleave(points, -2).repeat_interleave(points, -1)
    if frames.ndim > missing.ndim:  # colours of a mosaic
        missing = missing.unsqueeze(-3)
    return frames.masked_fill(missing if len(frames) == len(taken) else missing.all(0), torch.nan)
