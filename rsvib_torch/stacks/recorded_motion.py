"""Alignment of a recording with a stack of any length: some of its frames are read and compared."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.gyroscope.alignment import ClockAlignment, FittedClock, align_motion
from rsvib_torch.gyroscope.corner_tracks import corner_tracks
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates
from rsvib_torch.gyroscope.rotation_alignment import AlignOptions, RotationAlignment, align_rates, offset_range
from rsvib_torch.io.frame_times import timing_from_first_frame
from rsvib_torch.io.full_scale import counts_to_frames
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.stack_reading import open_stack, read_frames
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks.job import stored_frame
from rsvib_torch.stacks.memory import check_stack_fits

_COMPARED_PAIRS = 48  # of frames, over the whole stack, by which a gyroscope is aligned
_RUNS, _RUN_FRAMES = 3, 16  # runs of frames, over the whole stack, by which a motion is aligned
_CLOCK_ERROR = 1e-3  # of the ratio of two clocks; oscillators are within 1e-4


def compared_pairs(count: int) -> list[int]:
    """First frames of the pairs of neighbouring frames, of ``count``, by which a gyroscope is aligned."""
    return sorted({int(index) for index in np.linspace(0, count - 2, _COMPARED_PAIRS)}) if count > 1 else []


def compared_runs(count: int) -> list[slice]:
    """Frames, of ``count``, by which a motion is aligned: all of a short stack, or several runs."""
    if count <= _RUNS * _RUN_FRAMES:
        return [slice(0, count)]
    firsts = np.linspace(0, count - _RUN_FRAMES, _RUNS).astype(int).tolist()
    return [slice(first, first + _RUN_FRAMES) for first in firsts]


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


def part_of_stack(source: Path, info: StackInfo, timing: SensorTiming, part: slice) -> tuple[Tensor, SensorTiming]:
    """Some frames of a stack with the full scale of ``info``, and the timing from the start of its first frame."""
    check_stack_fits(info.with_frames(part.stop - part.start))
    starts = timing.frame_starts(info.shape[0])
    times = (starts[part] - starts[0]).tolist()
    images = read_frames(source, range(part.start, part.stop), info.full_scale)
    return images, replace(timing, frame_start_times=times)


def align_stack(
    source: Path,
    info: StackInfo,
    timing: SensorTiming,
    recorded: FreeMotion | AngularRates,
    *,
    camera: Camera | None = None,
    ignore: Tensor | None = None,
) -> ClockAlignment | RotationAlignment:
    """``align_motion`` for a stack of any length, in bounded time and memory.

    Angular rates are compared with 48 pairs of neighbouring frames over the whole stack, a motion with three runs of 16
    frames; of stacks that are not longer, all frames are used. ``info`` describes the stack, with its full scale;
    ``timing`` is that of the caller. The mask ``ignore`` (H, W) is that of all frames.
    """
    timing = timing_from_first_frame(timing, info)
    if isinstance(recorded, AngularRates):
        pairs = compared_pairs(info.shape[0])
        starts = timing.frame_starts(info.shape[0]).tolist()
        tracks = corner_tracks(_grey_frames(source, info, pairs, ignore), starts, timing)
        return align_rates(tracks, timing, recorded, AlignOptions(camera=camera, ignore=ignore))
    runs = compared_runs(info.shape[0])
    align = partial(align_motion, ignore=ignore)
    if len(runs) == 1:
        return align(*part_of_stack(source, info, timing, runs[0]), recorded)
    return _aligned_runs(source, info, timing, recorded, runs, align)


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


def _aligned_runs(
    source: Path,
    info: StackInfo,
    timing: SensorTiming,
    recorded: FreeMotion,
    runs: list[slice],
    align: Callable[..., ClockAlignment],
) -> ClockAlignment:
    """The clock by the runs of a long stack, each of which determines its reading at one time."""
    # 1. The run in the middle, at all offsets; then the others, near its clock.
    starts = timing.frame_starts(info.shape[0])
    readout = info.shape[int(timing.scan_axis)] * timing.row_time + timing.exposure_time
    limits = offset_range(recorded.start, recorded.end, 0.0, float(starts[-1] - starts[0]) + readout, None)
    found: list[ClockAlignment] = []
    middles: list[float] = []
    for run in sorted(runs, key=lambda run: abs(run.start - runs[len(runs) // 2].start)):
        frames, of_run = part_of_stack(source, info, timing, run)
        middles.append(0.5 * float(starts[run.start] + starts[run.stop - 1] - 2 * starts[0]) + 0.5 * readout)
        near = limits
        if found:
            error = _CLOCK_ERROR * abs(middles[-1] - middles[0]) + 4 * found[0].offset_std
            near = max(limits[0], found[0].offset - error), min(limits[1], found[0].offset + error)
        found.append(align(frames, of_run, recorded, offsets=near, fit_scale=False))
        if not found[-1].reliable:  # the others cannot make it reliable
            return found[-1]
    # 2. A straight line through the readings.
    times, readings = np.array(middles), np.array([one.offset for one in found])  # s; less the times of the frames
    weights, middle = 1 / np.array([one.offset_std for one in found]), float(np.mean(middles))
    line, covariance = np.polyfit(times - middle, readings, 1, w=weights, cov="unscaled")
    rest = float(np.square((readings - np.polyval(line, times - middle)) * weights).sum())  # 1 degree of freedom
    covariance *= max(1.0, rest)
    scale, gradient = 1.0 + float(line[0]), np.array([-middle, 1.0])
    offset, offset_std = float(gradient @ line), math.sqrt(gradient @ covariance @ gradient)
    # 3. The motion with the drift in the middle of the stack.
    clock = FittedClock(offset + scale * middle, scale, tuple(found[0].drift.tolist()), middle)
    return replace(
        found[0],
        motion=clock.motion(recorded),
        offset=offset,
        offset_std=offset_std,
        scale=scale,
        scale_std=math.sqrt(covariance[0, 0]),
    )
