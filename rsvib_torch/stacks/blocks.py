"""Blocks of frames as NumPy arrays, for tools that cut arrays themselves."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rsvib_torch.detection import detect_vibration
from rsvib_torch.io.full_scale import check_dtype, counts_to_frames, frames_to_counts, known_full_scale
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks.frame_faults import frame_fault
from rsvib_torch.stacks.window_restoration import restore_trusted

__all__ = ["restore_block"]


def restore_block(
    frames: NDArray[Any],
    timing: SensorTiming,
    *,
    detection: Mapping[str, Any] | None = None,
    restoration: Mapping[str, Any] | None = None,
    full_scale: float | None = None,
    force: bool = False,
    device: str = "cpu",
) -> NDArray[Any]:
    """Detect the vibration in a block of frames and restore them: an array in, one of the same shape and type out.

    Made for ``dask.array.map_overlap`` with an overlap of one frame, and the like::

        restored = array.map_overlap(
            rsv.restore_block, depth={0: 1}, boundary="none", dtype=array.dtype, meta=array._meta,
            timing=timing, full_scale=4095,
        )

    Time begins with the first frame of the block. A block in which nothing can be detected is returned as it is.

    Args:
        frames: (T, H, W) or (T, C, H, W), as stored.
        timing: The sensor; frames must be evenly spaced, for a block does not know where it lies in the stack.
        detection: Options of ``detect_vibration``.
        restoration: Options of ``restore``, for frames whose full scale is 1; not ``joint=True``.
        full_scale: Count that means 1.0; 255 for ``uint8`` if not given, to be stated for other integers.
        force: Keep restored frames even where they are judged no better than raw.
        device: Where to compute.

    Returns:
        Restored frames.

    Raises:
        ValueError: If the timing has frame start times, frames are joined, or the full scale is not known.
    """
    if timing.frame_start_times is not None:
        raise ValueError("timing must not have frame_start_times: a block does not know where it lies in the stack")
    options = dict(restoration or {})
    if options.get("joint", False) is True:
        raise ValueError("joint=True makes one image of a block; restore_block keeps its shape")
    check_dtype(frames.dtype)
    scale = known_full_scale(frames.dtype, full_scale)
    stored = frames.astype(frames.dtype.newbyteorder("="), copy=False)
    faults = [frame_fault(frame, index, scale) for index, frame in enumerate(stored)]
    if len(faults) < 2 or any(faults):
        return frames
    taken = counts_to_frames(stored, scale, "frames").to(device)
    try:
        found = detect_vibration(taken, timing, **(detection or {}))
        restored = restore_trusted(taken, timing, found, options, force=force, most_pairs=2)
    except (ValueError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]
        return frames
    return frames_to_counts(restored.frames, np.dtype(frames.dtype), scale) if restored.restored else frames
