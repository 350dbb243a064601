"""Restoration of the frames of one window, with a check of each frame and a verdict; also frame by frame (follow)."""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.checks.values import MAX_NUMBER
from rsvib_torch.frames.grey import constant_frame
from rsvib_torch.frames.pixels import detailed_columns
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.imaging.sensor_model import sharpened
from rsvib_torch.io.full_scale import beyond_full_scale
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.options import RestorationOptions
from rsvib_torch.restoration import RestorationVerdict, TooLittleInCommonError
from rsvib_torch.restoration.restore import check_optics, restore_prepared, unchanged_frames
from rsvib_torch.restoration.verdict.judge import judge_prepared
from rsvib_torch.restoration.verdict.trust import vibration_to_undo
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason
from rsvib_torch.stacks.windows import Window
from rsvib_torch.tracking import TrackedFrame, VibrationTracker

_JUDGED_COLUMNS = 320  # with the most detail; the verdict itself takes 160 of them


@dataclass(frozen=True, eq=False)
class RestoredFrames:
    """Result of ``restore_trusted``.

    Attributes:
        frames: Frames to write: restored, or as taken.
        restored: Whether they are restored.
        left_alone: A reason for each axis that was not restored.
        verdict: Whether restoration helps; None if frames could not be compared.
        moves: Whether there was a vibration to remove.
        axes: Number of components of the motion: 2, 3 with roll, 4 with roll and zoom.
    """

    frames: Tensor
    restored: bool
    left_alone: tuple[Reason, ...]
    verdict: RestorationVerdict | None
    moves: bool
    axes: int = 2

    def restored_axes(self) -> list[str]:
        """Names of the axes that were restored."""
        unchanged = {reason.axis for reason in self.left_alone}
        return [name for name in AXIS_NAMES[: self.axes] if self.restored and name not in unchanged]


def restore_trusted(
    frames: Tensor,
    timing: SensorTiming,
    motion: Motion | DetectedVibration,
    options: Mapping[str, Any],
    *,
    force: bool = False,
    first_frames: int | None = None,
    most_pairs: int | None = None,
) -> RestoredFrames:
    """Restore frames with a motion, or the reliable part of a detection, and judge whether that helps.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) whose full scale is 1; raw frames with option ``mosaic``.
        timing: The sensor.
        motion: The motion in image axes, or a detection in these frames.
        options: Options of ``restore``.
        force: Whether to return restored frames even if they are judged worse than the raw ones.
        first_frames: Number of frames to restore; None for all.
        most_pairs: Maximum number of pairs of frames to compare; None for all.

    Returns:
        Restored frames; the frames as taken if nothing moves, or if restoration makes them worse.
    """
    rows = frames.shape[-1 if timing.scan_axis == -1 else -2]
    vibration, left_alone = vibration_to_undo(motion, timing, len(frames), rows)
    frames = frames if first_frames is None else frames[:first_frames]
    chosen = RestorationOptions(**options)
    joint, scale, optics = chosen.joint, chosen.scale, check_optics(chosen.optics)
    prepared = prepare_frames(frames, timing, saturation=chosen.saturation, mosaic=chosen.mosaic)
    if not bool(vibration.moving_axes().any()):
        return RestoredFrames(unchanged_frames(prepared, joint, scale), False, left_alone, None, False)
    restored = restore_prepared(prepared, vibration, chosen)
    verdict = None
    with suppress(TooLittleInCommonError):
        if len(frames) > 1:
            verdict = judge_prepared(prepared, restored, vibration, joint=joint, most_pairs=most_pairs)
    keep = verdict is None or verdict.overall != "worse" or force
    if keep and optics is not None:
        restored = sharpened(restored, optics, scale)
    result = prepared.from_row_order(restored) if keep else unchanged_frames(prepared, joint, scale)
    return RestoredFrames(result, keep, left_alone, verdict, True, vibration.num_axes)


def pair_verdict(
    frames: Tensor, timing: SensorTiming, motion: Vibration, interval: float, options: RestorationOptions
) -> RestorationVerdict | None:
    """Whether restoration helps, from two neighbouring frames of a motion that is followed; None if unknown.

    The time origin of the motion is the middle of the first frame, and the other one starts an ``interval`` in s later.
    """
    if timing.scan_axis == -2:
        frames = frames[..., detailed_columns(frames, _JUDGED_COLUMNS)]
    if not bool((motion.amplitude > 0).any()):
        return None
    start = -0.5 * ((frames.shape[-1 if timing.scan_axis == -1 else -2] - 1) * timing.row_time + timing.exposure_time)
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


def frame_fault(
    frame: NDArray[Any],
    index: int,
    full_scale: float | None,
    *,
    nodata: float | None = None,
    valid_fraction: float = 0.1,
) -> str | None:
    """Why a frame as stored cannot be used, or None; the fraction ``valid_fraction`` of its pixels must have data."""
    is_float = frame.dtype.kind == "f"
    valued = frame if nodata is None else frame[frame != frame.dtype.type(nodata)]
    valid = (valued.size - (int(np.isnan(valued).sum()) if is_float else 0)) / frame.size
    if valid < valid_fraction:
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


# Frames before a window. Of a tone that decays with 1.2 s at 10 frames per second, read in 13 % of the frame period, 8
# frames left 6 of 128 reliable axes with a wrong tone, 12 and 16 frames none.
WARM_UP = 12
# Frames of a detection. A tone that decays is detected with smaller errors in fewer frames: with 8 instead of 4, 5 of
# 112 axes were wrong and 19 not known (12 frames before the window).
_START = 4


def follow_window(
    frames: Tensor,
    indices: list[int],
    times: list[float],
    window: Window,
    timing: SensorTiming,
    restoration: Mapping[str, Any] | None,
    *,
    force: bool = False,
) -> tuple[DetectedVibration, int, RestoredFrames | None, tuple[int, ...]] | None:
    """Follow the vibration through a window and the frames before it, and restore the frames of the window.

    ``frames`` are the usable ones, (T, H, W) or (T, C, H, W), full scale 1, ``indices`` theirs in the stack, and
    ``times`` their exposure starts in s from the start of the window. Without options of ``restoration``, nothing is
    restored.

    Returns:
        Vibration of the frame nearest to the middle of the window of those whose motion is known, with the time origin
        at the start of the window; index of that frame; restored frames of the window; indices of those that are as
        taken. None if the motion is not known in any frame of the window.
    """
    options = RestorationOptions(**(restoration or {"method": "dewarp"}))
    given = {"method": options.method, **(restoration or {})}
    tracker = VibrationTracker(replace(timing, frame_start_times=None), window=_START, channels="first", **given)
    # 1. Follow. Only frames of the window are kept.
    tracked: dict[int, TrackedFrame] = {}
    for index, time, frame in zip(indices, times, frames, strict=True):
        one = tracker.update(frame, time)
        if index >= window.first:
            tracked[index] = one
    known = [index for index, one in tracked.items() if one.tones is not None]
    if not known:
        return None
    # 2. The vibration in the middle.
    middle = min(known, key=lambda index: abs(2 * index - window.first - window.last))
    detection = _timed_from_window(tracked[middle])
    if restoration is None:
        return detection, middle, None, ()
    # 3. Judge two neighbouring frames near the middle, and restore all.
    moving = [index for index in known if bool(tracked[index].motion.moving_axes().any())]
    left = tuple(
        Reason("axis_not_reliable", name, details={"action": "restored", "why": "; ".join(detection.reasons[axis])})
        for axis, name in enumerate(AXIS_NAMES[:2])
        if not any(bool(tracked[index].motion.moving_axes()[axis]) for index in moving)
    )
    verdict = None
    pairs = [(index, later) for index, later in pairwise(tracked) if index in moving]
    if pairs:
        first, later = min(pairs, key=lambda pair: abs(pair[0] - middle))
        both, interval = [indices.index(index) for index in (first, later)], tracked[later].time - tracked[first].time
        verdict = pair_verdict(frames[both], timing, tracked[first].motion, interval, options)
    written = [index for index in tracked if index in window.written]
    unchanged = tuple(index for index in written if index not in moving)
    keep = len(unchanged) < len(written) and (verdict is None or verdict.overall != "worse" or force)
    results = [
        tracked[index].restored if keep and index in moving else frames[indices.index(index)] for index in written
    ]
    stacked = torch.stack(results) if results else frames[:0]
    return detection, middle, RestoredFrames(stacked, keep, left, verdict, bool(moving)), unchanged


def _timed_from_window(tracked: TrackedFrame) -> DetectedVibration:
    """The vibration at a frame, whose time is that from the start of its window, with the time origin there."""
    found = tracked.detection
    assert found is not None
    vibration, std, elapsed = found.vibration, found.std, tracked.time
    turn = 2 * math.pi * elapsed
    moved = replace(
        vibration,
        phase=torch.remainder(vibration.phase - turn * vibration.frequency + math.pi, 2 * math.pi) - math.pi,
        image_motion=vibration.image_motion - elapsed * vibration.image_acceleration,
    )
    phase_std = torch.hypot(std.phase, turn * std.frequency)
    return replace(DetectedVibration.of(found), vibration=moved, std=replace(std, phase=phase_std))
