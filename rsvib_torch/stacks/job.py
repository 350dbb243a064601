"""What a run over a stack is: its settings and windows, and the computation of one window from its frames."""

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import PathLike, check_device
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
from rsvib_torch.options import RestorationOptions, StackOptions, VibrationOptions
from rsvib_torch.restoration.restore import check_optics
from rsvib_torch.results.presentation import plain_values
from rsvib_torch.stacks.memory import windows_at_once
from rsvib_torch.stacks.window_restoration import (
    WindowMotion,
    measured_motion,
    restore_trusted,
    usable_frame,
    without_data,
)
from rsvib_torch.stacks.windows import Window, WindowRecord, cut_windows, window_timing

WindowFrames = list[Array | str]  # pixels as stored, or why a frame cannot be read


@dataclass(frozen=True, eq=False)
class StackJob:
    """Everything on which the result of a window depends, except its frames."""

    source: Path  # the stack
    info: StackInfo  # what its file states
    timing: SensorTiming  # timing of the whole stack
    options: StackOptions  # with the full scale (None for floats) and the device that are used
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

    def compute(self, window: Window, pixels: WindowFrames) -> tuple[WindowRecord, Array, DetectedVibration | None]:
        """Detect the vibration in a window, restore its frames, and judge the result.

        The result is the record of the window, its frames as the file has them, and the detection in the first window.
        Frames that were not restored are unchanged. One that cannot be read is stored as NaN, or 0 for integers.
        """
        # 1. The frames that can be used, of which the first ones are written.
        options, images, faults = self.options, dict[int, Tensor](), dict[int, str]()
        for index, frame in zip(window.frames, pixels, strict=True):
            try:
                images[index] = usable_frame(frame, index, options.full_scale, self.info.nodata)
            except ValueError as error:
                faults[index] = str(error)
        kept = [index for index in images if index in window.written]
        record = WindowRecord(
            window.index,
            window.first,
            window.last,
            start_time=float(self.timing.frame_starts(window.first + 1)[-1]),
            written=1 if self.is_joined else window.kept,
            bad_frames={str(index): fault for index, fault in faults.items() if index in window.written},
        )
        tones, restored = None, dict[int, Tensor]()
        try:
            if faults and len(images) < 2:
                raise ValueError(next(iter(faults.values())))
            taken = torch.stack(list(images.values())).to(options.device)
            # 2. Their motion.
            motion = self._motion(window, taken, window_timing(self.timing, window, list(images)))
            tones = motion.tones
            record = replace(
                record,
                detection=None if tones is None else DetectedVibration.of(tones).to("cpu"),
                motion=None if motion.free is None else motion.free.to("cpu"),
                lost_before=None if motion.lost_before is None else window.first + motion.lost_before,
            )
            # 3. The frames without it, and whether they are better.
            done = restore_trusted(
                taken,
                motion.timing,
                motion.motion,
                self._for_counts(taken),
                force=options.force,
                first_frames=len(kept) if len(kept) > 1 and not self.chosen.joint else None,
                most_pairs=8 if window.alone else 2,  # limits the time of the verdict
            )
            verdict = done.verdict
            unknown = "cannot determine whether restoration helps: no two frames show the same scene"
            record = replace(
                record,
                frames="restored" if done.restored else "as taken",
                left_alone=done.left_alone,
                outcome=None if verdict is None else verdict.overall,
                verdict=verdict.sentence if verdict is not None else unknown if done.restored else None,
                predicted_gain=None if verdict is None else plain_values(verdict.predicted_gain.nanmean()),
                lost_rows={str(index): done.lost_rows[at] for at, index in enumerate(kept) if at in done.lost_rows},
            )
            # 4. Those that are written; one image of all in place of the middle one.
            if done.restored:
                places = [window.middle] if self.is_joined else kept
                of_places = taken if self.is_joined else taken[: len(kept)]
                frames = done.frames[: len(places)]
                frames = frames if self.info.nodata is None else without_data(frames, of_places)
                restored = dict(zip(places, frames, strict=True))
        except (ValueError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
            record = replace(record, error=" ".join(str(error).split()))
        written = [window.middle] if self.is_joined else window.written
        stored = [
            self._counts(restored[index]) if index in restored else self._as_taken(pixels[index - window.first])
            for index in written
        ]
        # channels may be stored last
        return record, np.ascontiguousarray(np.stack(stored)), tones if window.index == 0 else None

    def _motion(self, window: Window, frames: Tensor, timing: SensorTiming) -> WindowMotion:
        """The motion in the frames of a window, given or measured."""
        if self.given is None:
            return measured_motion(frames, timing, self.options.detection or {})
        motion = self.given[window.index]
        if motion is None:
            raise ValueError("no detection was given for this window")
        return WindowMotion(motion, motion if isinstance(motion, DetectedVibration) else None, timing)

    def _counts(self, frames: Tensor) -> Array:
        """Frames as the file has them."""
        return scales.frames_to_counts(frames, np.dtype(self.info.dtype), self.options.full_scale, self.info.nodata)

    def _as_taken(self, frame: Array | str) -> Array:
        """A frame that was not restored, in the shape of restored ones."""
        dtype, mosaic, scale = np.dtype(self.info.dtype), self.chosen.mosaic, self.chosen.scale
        if isinstance(frame, str):
            frame = np.full(self.info.shape[1:], np.nan if dtype.kind == "f" else 0, dtype)
        if scale == 1 and mosaic is None:
            return frame
        taken = scales.counts_to_frames(frame[None], self.options.full_scale, str(self.source), self.info.nodata)
        return self._counts(enlarged(taken if mosaic is None else colour_frames(taken, mosaic), scale)[0])

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
    options: StackOptions, info: StackInfo, timing: SensorTiming, windows: list[Window]
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


def chosen_device(name: str) -> torch.device:
    """The device of an option, which must be available."""
    check_choice("device", name.partition(":")[0], ("auto", "cpu", "cuda"))
    default = "cuda" if torch.cuda.is_available() else "cpu"
    return check_device("device", default if name == "auto" else name)


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
    device, restoration = str(chosen_device(options.device)), options.restoration or {}
    stated = replace(options, full_scale=full_scale, device=device, restoration=restoration)
    windows = cut_windows(info.shape[0], stated.window)
    job = StackJob(Path(source), info, timing, stated, _given(stated, info, timing, windows))
    if job.chosen.mosaic is not None:
        check_mosaic(job.chosen.mosaic, info.shape, str(source))
    check_optics(job.chosen.optics)
    joint, most = job.chosen.joint, min(stated.window, info.shape[0])
    if joint is not True and joint > most:
        raise ValueError(f"joint must be at most {most}, the number of frames of a window, got {joint}")
    return job, windows, windows_at_once(info, stated)
