"""Restoration of the frames of one window, with a check of each frame and a verdict; also frame by frame (follow)."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.values import MAX_NUMBER, beyond_full_scale
from rsvib_torch.frames.grey import constant_frame
from rsvib_torch.frames.pixels import detailed_parts
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.imaging.sensor_model import sharpened
from rsvib_torch.motion.detected_vibration import DetectedVibration, FollowedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import RestorationOptions
from rsvib_torch.restoration import RestorationVerdict, TooLittleInCommonError
from rsvib_torch.restoration.frame_motion import vibration_to_undo
from rsvib_torch.restoration.judge import judge_prepared
from rsvib_torch.restoration.restore import (
    check_optics,
    restore_each,
    restore_prepared,
    unchanged_frames,
    warn_of_mosaic,
)
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason

_JUDGED_COLUMNS = 320  # with the most detail; the verdict itself takes 160 of them


@dataclass(frozen=True, eq=False)
class RestoredFrames:
    """Result of ``restore_trusted``."""

    frames: Tensor  # to write: restored, or as taken
    restored: bool  # whether they are restored
    left_alone: tuple[Reason, ...]  # a reason for each axis that was not restored
    verdict: RestorationVerdict | None  # whether restoration helps; None if frames could not be compared
    moves: bool  # whether there was a vibration to remove
    axes: int = 2  # number of components of the motion: 2, 3 with roll, 4 with roll and zoom
    as_taken: tuple[int, ...] = ()  # numbers of frames that were not restored, of frames that have a motion each

    def restored_axes(self) -> list[str]:
        """Names of the axes that were restored."""
        unchanged = {reason.axis for reason in self.left_alone}
        return [name for name in AXIS_NAMES[: self.axes] if self.restored and name not in unchanged]


def restore_trusted(
    frames: Tensor,
    timing: SensorTiming,
    motion: Motion | DetectedVibration,
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
    vibration, left_alone = vibration_to_undo(motion, timing, len(frames), frames.shape[int(timing.scan_axis)])
    frames = frames if first_frames is None else frames[:first_frames]
    joint, scale, optics = options.joint, options.scale, check_optics(options.optics)
    prepared = prepare_frames(frames, timing, saturation=options.saturation, mosaic=options.mosaic)
    if not bool(vibration.moving_axes().any()):
        return RestoredFrames(unchanged_frames(prepared, joint, scale), False, left_alone, None, False)
    warn_of_mosaic(prepared)
    restored = restore_prepared(prepared, vibration, options)
    verdict = None
    with suppress(TooLittleInCommonError):
        if len(frames) > 1:
            verdict = judge_prepared(prepared, restored, vibration, joint=joint, most_pairs=most_pairs)
    keep = verdict is None or verdict.overall != "worse" or force
    if keep:
        restored = sharpened(restored, optics, scale)
    result = prepared.from_row_order(restored) if keep else unchanged_frames(prepared, joint, scale)
    return RestoredFrames(result, keep, left_alone, verdict, True, vibration.num_axes)


def pair_verdict(
    frames: Tensor, timing: SensorTiming, motion: Vibration, interval: float, options: RestorationOptions
) -> RestorationVerdict | None:
    """Whether restoration helps, from two neighbouring frames of a motion that is followed; None if unknown.

    The time origin of the motion is the middle of the first frame, and the other one starts an ``interval`` in s later.
    """
    if timing.scan_axis == -2 and motion.num_axes == 2:
        frames = frames[..., detailed_parts(frames[None, None], _JUDGED_COLUMNS)[0]]
    if not bool((motion.amplitude > 0).any()):
        return None
    start = -timing.time_to_middle(frames.shape[int(timing.scan_axis)])
    prepared = prepare_frames(frames, replace(timing, frame_start_times=(start, start + interval)), channels="first")
    with suppress(TooLittleInCommonError), torch.no_grad():
        return judge_prepared(prepared, restore_prepared(prepared, motion, options), motion, most_pairs=1)
    return None


def without_data(frames: Tensor, taken: Tensor) -> Tensor:
    """Restored frames with NaN at the pixels without data of the frames as taken; of one image, without data in all."""
    points = frames.shape[-1] // taken.shape[-1]
    missing = torch.isnan(taken).repeat_interleave(points, -2).repeat_interleave(points, -1)
    if frames.ndim > missing.ndim:  # colours of a mosaic
        missing = missing.unsqueeze(-3)
    return frames.masked_fill(missing if len(frames) == len(taken) else missing.all(0), torch.nan)


def frame_fault(frame: Array | str, index: int, full_scale: float | None, nodata: float | None) -> str | None:
    """Why a frame as stored, or the error of reading it, cannot be used; None if it can be."""
    if isinstance(frame, str):
        return frame
    is_float = frame.dtype.kind == "f"
    valued = frame if nodata is None else frame[frame != frame.dtype.type(nodata)]
    valid = (valued.size - (int(np.isnan(valued).sum()) if is_float else 0)) / frame.size
    if valid < 0.1:
        return f"frame {index} has only {valid:.1%} of pixels that count"
    if is_float and len(infinite := np.argwhere(np.isinf(frame))):
        place = tuple(int(i) for i in infinite[0])
        return f"frames must be finite, but pixel {(index, *place)} is {float(frame[place])}"
    low, high = float(np.nanmin(valued)), float(np.nanmax(valued))
    if not is_float and full_scale is not None and high > full_scale:
        return f"{beyond_full_scale(round(high), full_scale)} (frame {index})"
    largest = max(abs(high), abs(low))
    if largest > MAX_NUMBER:
        return f"frame {index} reaches {largest:.3g}, at most {MAX_NUMBER:g} is possible"
    rounding = 1e-7  # of float32, relative
    return constant_frame(index) if high - low <= rounding * largest else None


# Frames before and after a window. Frequencies that differ by a multiple of the frame rate are distinguished by the
# whole record: of tones that decay with 1.2 s at 10 to 22 frames per second, 32 frames left no wrong one.
MARGIN = 12
_LEAST_FRAMES = 4  # that two trackers run through
# Reasons against an axis whose tones may change within the record
_CHANGES = {"displacement_ambiguous", "rows_unexplained", "neighbours_unexplained"}


def may_change(detection: DetectedVibration, num_frames: int) -> bool:
    """Whether tones that change within the frames may be why an axis of a steady vibration is not reliable."""
    return num_frames >= _LEAST_FRAMES and any(
        not _CHANGES.isdisjoint(one.code for one in of_axis) for of_axis in detection.findings
    )


def restore_followed(
    frames: Tensor,
    timing: SensorTiming,
    followed: FollowedVibration,
    options: RestorationOptions,
    *,
    force: bool = False,
) -> RestoredFrames:
    """``restore_trusted`` of frames that each have their own vibration."""
    prepared = prepare_frames(frames, timing, saturation=options.saturation)
    restored, undone, left_alone = restore_each(prepared, followed, options)
    moving = undone.moving_axes().any(-1).tolist()
    # Two neighbouring frames near the middle are judged.
    verdict, starts = None, timing.frame_starts(len(moving)).tolist()
    pairs = [index for index in range(len(moving) - 1) if moving[index] and moving[index + 1]]
    if pairs:
        first = min(pairs, key=lambda index: abs(2 * index + 2 - len(moving)))
        interval = starts[first + 1] - starts[first]
        verdict = pair_verdict(frames[first : first + 2], timing, undone[first], interval, options)
    keep = any(moving) and (verdict is None or verdict.overall != "worse" or force)
    result = prepared.from_row_order(restored) if keep else frames
    unchanged = tuple(index for index, moves in enumerate(moving) if not (moves and keep))
    return RestoredFrames(result, keep, left_alone, verdict, any(moving), as_taken=unchanged)
