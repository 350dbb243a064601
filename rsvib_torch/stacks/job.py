"""What a run over a stack is: its settings and windows, and the computation of one window from its frames."""

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import PathLike
from rsvib_torch.checks.values import check_choice
from rsvib_torch.frames import full_scale as scales
from rsvib_torch.frames.pixels import check_mosaic, colour_frames, enlarged
from rsvib_torch.frames.prepare import largest_count
from rsvib_torch.io.frame_reader import FrameError, FrameReader
from rsvib_torch.io.frame_times import exposure_times, timing_of_stack
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.stack_reading import open_stack, read_stack_info
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import (
    ProcessStackOptions,
    RestorationOptions,
    StackOptions,
    VibrationOptions,
)
from rsvib_torch.restoration.restore import check_optics
from rsvib_torch.stacks.memory import windows_at_once
from rsvib_torch.stacks.window_restoration import (
    WindowMotion,
    measured_motion,
    restore_trusted,
    usable_frame,
    without_data,
)
from rsvib_torch.stacks.windows import Window, WindowRecord, WindowResult, cut_windows, window_timing

WindowFrames = list[Array | str]  # pixels as stored, or why a frame cannot be read


@dataclass(frozen=True, eq=False)
class StackJob:
    """Everything on which the result of a window depends, except its frames."""

    source: Path  # the stack
    info: StackInfo  # what its file states
    timing: SensorTiming  # timing of the whole stack
    options: ProcessStackOptions  # with the full scale (None for floats) and the device that are used
    # of every window, the motion to use instead of a detection, from its first frame on; None: it has none
    given: Sequence[DetectedVibration | FreeMotion | None] | None = None

    @cached_property
    def chosen(self) -> RestorationOptions:
        """All options of ``restore``."""
        return RestorationOptions(**(self.options.restoration or {}))

    @property
    def is_joined(self) -> bool:
        """Whether one image is made of a window."""
        return self.chosen.joint is True

    def open(self) -> FrameReader:
        """Open the stack, which must not have changed."""
        reader = open_stack(self.source)
        if reader.info != self.info:
            reader.close()
            raise ValueError(f"{self.source} has changed since it was first opened; start again")
        return reader

    def content(self, out: StackInfo, timing: SensorTiming) -> StackInfo:
        """The output ``out`` with full scale, times and frame rate; ``timing`` is that of the caller."""
        times = None if out.frame_times is None else exposure_times(self.info, timing)
        rate = out.frame_rate or timing.frame_rate
        return replace(out, full_scale=self.options.full_scale, frame_times=times, time_error=0.0, frame_rate=rate)

    def compute(self, window: Window, pixels: WindowFrames) -> WindowResult:
        """Detect the vibration in a window, restore its frames and judge the result."""
        # 1. The frames that can be used.
        options, images, faults = self.options, dict[int, Tensor](), dict[int, str]()
        for index, stored in zip(window.frames, pixels, strict=True):
            try:
                images[index] = usable_frame(stored, index, options.full_scale, self.info.nodata)
            except ValueError as error:
                faults[index] = str(error)
        kept = tuple(index for index in images if index in window.written)
        none = torch.empty((0, *self.info.shape[1:]), dtype=torch.float32, device="cpu")
        taken = (torch.stack(list(images.values())) if images else none).to(options.device)
        bad = {index: fault for index, fault in faults.items() if index in window.written}
        result = WindowResult(window, kept, self._unchanged(taken[: len(kept)]), None, None, None, bad)
        if faults and len(images) < 2:
            return replace(result, error=next(iter(faults.values())))
        timing = window_timing(self.timing, window, list(images))
        try:
            # 2. Their motion.
            if self.given is None:
                moved = measured_motion(taken, timing, options.detection or {})
            else:
                given = self.given[window.index]
                if given is None:
                    return replace(result, error="no detection was given for this window")
                moved = WindowMotion(given, given if isinstance(given, DetectedVibration) else None, timing)
            lost_before = None if moved.lost_before is None else window.first + moved.lost_before
            result = replace(result, detection=moved.tones, motion=moved.free, lost_before=lost_before)
            # 3. The frames without it, and whether they are better.
            restoration = restore_trusted(
                taken,
                moved.timing,
                moved.motion,
                self._for_counts(taken),
                force=options.force,
                first_frames=len(kept) if len(kept) > 1 and not self.chosen.joint else None,
                most_pairs=8 if window.alone else 2,  # limits the time of the verdict
            )
        except (ValueError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
            return replace(result, error=" ".join(str(error).split()))
        result = replace(result, restoration=restoration)
        if not restoration.restored:
            return result
        # 4. Those that are written, or one image of all.
        frames = restoration.frames
        if self.is_joined:
            result = replace(result, indices=())
        else:
            taken, frames = taken[: len(kept)], frames[: len(kept)]
        return replace(result, frames=frames if self.info.nodata is None else without_data(frames, taken))

    def compute_stored(self, window: Window, pixels: WindowFrames) -> tuple[WindowRecord, Array, WindowResult | None]:
        """The record of a window, its frames as the file has them, and the result of the first window of the stack.

        Frames that were not restored are unchanged. One that cannot be read is stored as NaN, or 0 for integers.
        """
        result, dtype = self.compute(window, pixels), np.dtype(self.info.dtype)

        def counts(images: Tensor) -> Array:
            return scales.frames_to_counts(images, dtype, self.options.full_scale, self.info.nodata)

        def as_taken(index: int) -> Array:
            frame = pixels[index - window.frames.start]
            if isinstance(frame, str):
                frame = np.full(self.info.shape[1:], np.nan if dtype.kind == "f" else 0, dtype)
            if self.chosen.scale == 1 and self.chosen.mosaic is None:
                return frame
            taken = scales.counts_to_frames(frame[None], self.options.full_scale, str(self.source), self.info.nodata)
            return counts(self._unchanged(taken)[0])  # the shape of restored ones

        if result.restored and self.is_joined:
            frames = list(counts(result.frames))
        else:
            restored = dict(zip(result.indices, result.frames, strict=True)) if result.restored else {}
            middle = window.written[window.kept // 2]
            written = [middle] if self.is_joined else window.written
            frames = [counts(restored[index]) if index in restored else as_taken(index) for index in written]
        record, first = WindowRecord.of(result, self.timing, len(frames)), result if window.index == 0 else None
        return record, np.ascontiguousarray(np.stack(frames)), first  # channels may be stored last

    def _unchanged(self, frames: Tensor) -> Tensor:
        """Frames that were not restored, in the shape of restored ones."""
        mosaic = self.chosen.mosaic
        return enlarged(frames if mosaic is None else colour_frames(frames, mosaic), self.chosen.scale)

    def _for_counts(self, frames: Tensor) -> RestorationOptions:
        """The options of ``restore``, with the level at which the counts of the file are saturated by themselves."""
        full_scale = self.options.full_scale
        if self.chosen.saturation != "auto" or full_scale is None:
            return self.chosen
        counts = (frames * full_scale).round().nan_to_num(0.0).to(torch.int64)
        return replace(self.chosen, saturation=largest_count(counts, full_scale) / full_scale)


def stored_frame(read: Callable[[int], Array], index: int) -> Array | str:
    """A frame as stored, or why it cannot be read."""
    try:
        return read(index)
    except FrameError as error:
        return " ".join(str(error).split())


def read_windows(job: StackJob, windows: Iterable[Window]) -> Generator[tuple[Window, WindowFrames], None, None]:
    """Windows with the pixels of their frames, or why they cannot be read; frames that two share are read once."""
    with closing(job.open()) as reader:
        last: dict[int, Array | str] = {}  # the last frame of the window before
        for window in windows:
            frames = [last[index] if index in last else stored_frame(reader.frame, index) for index in window.frames]
            last = {window.last: frames[-1]}
            yield window, frames


def _given(
    options: ProcessStackOptions, info: StackInfo, timing: SensorTiming, windows: list[Window]
) -> Sequence[DetectedVibration | FreeMotion | None] | None:
    """The given motion of every window, with the time origin at its first frame; None if none is given."""
    motion, given = options.motion, options.given
    if motion is None:
        if given is not None and len(given) != len(windows):
            raise ValueError(
                f"given has {len(given)} detections for {len(windows)} windows of at most {options.window} frames; "
                "pass one for each window"
            )
        return given
    if options.detection or given is not None or not isinstance(motion, FreeMotion):
        raise ValueError("motion must be a FreeMotion; it has no detection and no given detections beside it")
    starts: list[float] = (timing.frame_starts(info.shape[0]) - timing.frame_starts(1)).tolist()
    readout = info.shape[int(timing.scan_axis)] * timing.row_time + timing.exposure_time
    if motion.start > motion.spacing or motion.end < starts[-1] + readout - motion.spacing:
        raise ValueError(
            f"motion covers {motion.start:.6g} to {motion.end:.6g} s on the clock of the frames, the frames need 0 to "
            f"{starts[-1] + readout:.6g} s; check its offset: motion.retimed(seconds), or --offset"
        )
    ends = [(starts[window.first], starts[window.last]) for window in windows]
    parts = [motion.within(first - readout, last + 2 * readout).retimed(first) for first, last in ends]
    return [part.to(options.device) for part in parts]


def plan_job(source: PathLike, timing: SensorTiming, options: StackOptions) -> tuple[StackJob, list[Window], int]:
    """The job of a run, its windows, and how many of them to compute at once.

    The free memory limits the number of windows that are computed at once, on this machine.
    """
    info = read_stack_info(source)
    full_scale = info.full_scale if options.full_scale is None else options.full_scale
    full_scale = scales.required_full_scale(full_scale, np.dtype(info.dtype), source) if info.is_integer else None
    timing = timing_of_stack(timing, info)
    timing.frame_starts(info.shape[0])  # raises an error if there are too few frame start times
    timing.check_rows(info.shape[int(timing.scan_axis)])
    VibrationOptions(**options.detection or {})  # raises an error for wrong ones
    check_choice("device", options.device.partition(":")[0], ("auto", "cpu", "cuda"))
    default = "cuda" if torch.cuda.is_available() else "cpu"
    device = default if options.device == "auto" else options.device
    of_job = {"full_scale": full_scale, "device": device, "restoration": options.restoration or {}, "progress": None}
    stated = ProcessStackOptions(**{**vars(options), **of_job})
    windows = cut_windows(info.shape[0], stated.window)
    job = StackJob(Path(source), info, timing, stated, _given(stated, info, timing, windows))
    if job.chosen.mosaic is not None:
        check_mosaic(job.chosen.mosaic, info.shape, str(source))
    check_optics(job.chosen.optics)
    joint, most = job.chosen.joint, min(stated.window, info.shape[0])
    if joint is not True and joint > most:
        raise ValueError(f"joint must be at most {most}, the number of frames of a window, got {joint}")
    return job, windows, windows_at_once(info, stated)
