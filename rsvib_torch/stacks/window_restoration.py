"""Restoration of the frames of one window, with a check of each frame and a verdict on the result."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.arrays import Channels, channel_axis
from rsvib_torch.core.checks import MAX_NUMBER
from rsvib_torch.core.presentation import AXIS_NAMES
from rsvib_torch.core.reason import Reason
from rsvib_torch.detection import detect_vibration
from rsvib_torch.frames.grey import constant_frame
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.imaging.sensor_model import sharpened
from rsvib_torch.io.full_scale import (
    beyond_full_scale,
    check_dtype,
    counts_to_frames,
    frames_to_counts,
    known_full_scale,
)
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import RestorationOptions
from rsvib_torch.restoration import RestorationVerdict, TooLittleInCommonError
from rsvib_torch.restoration.restore import check_optics, restore_prepared, unchanged_frames
from rsvib_torch.restoration.verdict.judge import judge_prepared
from rsvib_torch.restoration.verdict.trust import vibration_to_undo


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


@checks_arguments
def restore_block(
    frames: NDArray[Any],
    timing: SensorTiming,
    *,
    detection: Mapping[str, Any] | None = None,
    restoration: Mapping[str, Any] | None = None,
    full_scale: float | None = None,
    channels: Channels = None,
    force: bool = False,
    device: str = "cpu",
) -> NDArray[Any]:
    """Detect the vibration in a block of frames and restore them; the result has the shape and data type of the block.

    For ``dask.array.map_overlap`` with an overlap of one frame, and similar tools. The time origin is the first frame
    of the block. A block in which the detection fails is returned unchanged.

    Args:
        frames: (T, H, W) or (T, C, H, W), as stored.
        timing: The sensor; frames must be evenly spaced, because the position of the block in the stack is unknown.
        detection: Options of ``detect_vibration``.
        restoration: Options of ``restore``, for frames whose full scale is 1; not ``joint=True``.
        full_scale: Count that corresponds to 1.0; 255 for ``uint8`` if not given, required for other integers.
        channels: ``"last"`` for frames (T, H, W, C), as in ``detect_vibration``.
        force: Whether to return restored frames even if they are judged worse than the raw ones.
        device: Device for the computation.

    Returns:
        Restored frames.

    Raises:
        ValueError: If the timing has frame start times, ``joint=True``, the full scale is unknown, or the frames appear
            to have their channels last.

    Example:
        >>> restored = array.map_overlap(  # doctest: +SKIP
        ...     rsv.restore_block, depth={0: 1}, boundary="none", dtype=array.dtype, meta=array._meta,
        ...     timing=timing, full_scale=4095,
        ... )
    """
    if timing.frame_start_times is not None:
        raise ValueError(
            "timing must not have frame_start_times: the position of a block in the stack is unknown; use process_stack"
        )
    options = dict(restoration or {})
    if options.get("joint", False) is True:
        raise ValueError("joint=True makes one image of a block; restore_block keeps its shape")
    for name in ("scale", "mosaic"):
        if options.get(name) not in (None, 1):
            raise ValueError(f"{name}={options[name]!r} changes the size of the frames; restore_block keeps it")
    check_dtype(frames.dtype)
    scale = known_full_scale(frames.dtype, full_scale)
    axis = channel_axis("frames", frames.shape, channels)
    stored = np.moveaxis(frames.astype(frames.dtype.newbyteorder("="), copy=False), axis, -3)
    if len(stored) < 2 or any(frame_fault(frame, index, scale) for index, frame in enumerate(stored)):
        return frames.copy()
    floats = counts_to_frames(stored, scale, "frames").to(device)
    try:
        detected = detect_vibration(floats, timing, **(detection or {}))
        restored = restore_trusted(floats, timing, detected, options, force=force, most_pairs=2)
    except (ValueError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]
        return frames.copy()
    if not restored.restored:
        return frames.copy()
    return np.moveaxis(frames_to_counts(restored.frames, np.dtype(frames.dtype), scale), -3, axis)
