"""Restoration of the frames of one window, with a check of each frame and a verdict.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.values import MAX_NUMBER, beyond_full_scale
from rsvib_torch.detection import MotionDetection
from rsvib_torch.frames.prepare import constant_frame, prepare_frames
from rsvib_torch.imaging.sensor_model import sharpened
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import RestorationOptions
from rsvib_torch.restoration import RestorationVerdict, TooLittleInCommonError
from rsvib_torch.restoration.frame_motion import vibration_to_undo
from rsvib_torch.restoration.judge import judge_prepared
from rsvib_torch.restoration.restore import check_optics, restore_prepared, unchanged_frames, warn_of_mosaic
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason
from rsvib_torch.stacks.window_motion import reliable_motion


@dataclass(frozen=True, eq=False)
class RestoredFrames:
    """Result of ``restore_trusted``."""

    frames: Tensor  # to write: restored, or as taken
    restored: bool  # whether they are restored
    left_alone: tuple[Reason, ...]  # a reason for each axis that was not restored
    verdict: RestorationVerdict | None  # whether restoration helps; None if frames could not be compared
    moves: bool  # whether there was a vibration to remove
    axes: int = 2  # number of components of the motion: 2, 3 with roll, 4 with roll and zoom

    def restored_axes(self) -> list[str]:
        """Names of the axes that were restored."""
        unchanged = {reason.axis for reason in self.left_alone}
        return [name for name in AXIS_NAMES[: self.axes] if self.restored and name not in unchanged]


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
