"""A window of a stack whose vibration changes, frame by frame: a tracker begins some frames before the window."""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.core.presentation import AXIS_NAMES
from rsvib_torch.core.reason import Reason
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import RestorationOptions
from rsvib_torch.stacks.window_restoration import RestoredFrames, pair_verdict
from rsvib_torch.stacks.windows import Window
from rsvib_torch.tracking import TrackedFrame, VibrationTracker

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

    Args:
        frames: The usable frames, (T, H, W) or (T, C, H, W), full scale 1.
        indices: Their indices in the stack.
        times: Their exposure starts in s from the start of the window.
        window: The window.
        timing: The sensor.
        restoration: Options of ``restore``; None for detection only.
        force: Whether to return restored frames even if they are judged worse than the raw ones.

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
