"""Alignment of a gyroscope with a stack of any length: some of its frames are read and compared."""

import re
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.frames.full_scale import counts_to_frames
from rsvib_torch.gyroscope.corner_tracks import corner_tracks
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates
from rsvib_torch.gyroscope.rotation_alignment import AlignOptions, RotationAlignment, align_rates
from rsvib_torch.io.frame_times import timing_from_first_frame
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.stack_reading import open_stack
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks.job import stored_frame

_COMPARED_PAIRS = 48  # of frames, over the whole stack, by which a recording is aligned


def compared_pairs(count: int) -> list[int]:
    """First frames of the pairs of neighbouring frames, of ``count``, by which a recording is aligned."""
    return sorted({int(index) for index in np.linspace(0, count - 2, _COMPARED_PAIRS)}) if count > 1 else []


def mask_of_regions(regions: Sequence[str], size: tuple[int, int]) -> Tensor | None:
    """Mask (H, W) of regions of frames, rows or rows and columns as ``400:`` or ``:60,500:``; None without regions."""
    mask = torch.zeros(size, dtype=torch.bool, device="cpu")
    for region in regions:
        if not re.fullmatch(r"\d*:\d*(,\d*:\d*)?", region):
            form = "rows, or rows and columns, such as 400: or :60,500:"
            raise ValueError(f"ignore must be {form}, got {region!r}")
        part = mask[tuple(slice(*(int(end) if end else None for end in ends.split(":"))) for ends in region.split(","))]
        if part.numel() == 0:
            raise ValueError(f"ignore {region} has no pixel of frames of {size[0]} rows and {size[1]} columns")
        part.fill_(True)
    return mask if regions else None


def align_stack(
    source: Path,
    info: StackInfo,
    timing: SensorTiming,
    recorded: AngularRates,
    *,
    camera: Camera | None = None,
    ignore: Tensor | None = None,
) -> RotationAlignment:
    """``align_motion`` for a stack of any length, in bounded time and memory.

    The recording is compared with 48 pairs of neighbouring frames over the whole stack. ``info`` describes the stack,
    with its full scale; ``timing`` is that of the caller. The mask ``ignore`` (H, W) is that of all frames.
    """
    timing = timing_from_first_frame(timing, info)
    pairs, starts = compared_pairs(info.shape[0]), timing.frame_starts(info.shape[0]).tolist()
    tracks = corner_tracks(_grey_frames(source, info, pairs, ignore), starts, timing)
    return align_rates(tracks, timing, recorded, AlignOptions(camera=camera, ignore=ignore))


def _grey_frames(
    source: Path, info: StackInfo, pairs: list[int], ignore: Tensor | None
) -> Iterator[tuple[int, Tensor, Tensor | None]]:
    """Number and pixels (H, W) of the frames of pairs, and which of them count if some do not."""
    with closing(open_stack(source)) as reader:
        for index in sorted({*pairs, *(first + 1 for first in pairs)}):
            frame = stored_frame(reader.frame, index)
            if isinstance(frame, str):
                continue
            image = counts_to_frames(frame[None], info.full_scale, str(source), info.nodata)[0]
            image = image if image.ndim == 2 else image.mean(0)
            valid = torch.isfinite(image) if ignore is None else torch.isfinite(image) & ~ignore
            yield index, image.nan_to_num(0.0), None if bool(valid.all()) else valid
