"""Videos from file to file, followed from frame to frame: ``process_video``."""

import math
import tempfile
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rsvib_torch.core.atomic import whole_file
from rsvib_torch.core.free_memory import check_fits
from rsvib_torch.core.outputs import check_outputs
from rsvib_torch.core.validation import fields_of
from rsvib_torch.frames.entry_points import file_options
from rsvib_torch.io.frame_times import exposure_times
from rsvib_torch.io.stack_format import FrameReader
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.stack_reading import PathLike, open_stack
from rsvib_torch.io.stack_writing import check_info_target, metadata_not_kept, stack_files
from rsvib_torch.io.video import CONTAINERS
from rsvib_torch.io.video_parts import PartWriter, PlaneReader, join_parts, planes_of
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import ProcessVideoOptions, Progress, ResourceOptions, RestorationOptions, StackOptions
from rsvib_torch.stacks.engines import results_in_order
from rsvib_torch.stacks.heap import share_one_heap
from rsvib_torch.stacks.job import StackJob, plan_job
from rsvib_torch.stacks.manifest import manifest_header
from rsvib_torch.stacks.resumable_run import StackReport, manifest_path, run_to_file
from rsvib_torch.stacks.run_folder import RunFolder, disk_errors_named, work_folder
from rsvib_torch.stacks.video_frames import FrameLayout, RestoredFrame, VideoRestorer
from rsvib_torch.stacks.video_passes import PART_FRAMES, VideoPasses
from rsvib_torch.stacks.video_tracks import FrameTrack
from rsvib_torch.tracking import Margins

_MAX_INITIAL_FAILURES = 8  # parts; a run stops if the motion is known in none of them

Frame = NDArray[Any]
Planes = list[Frame]


@file_options(ProcessVideoOptions)
def process_video(source: PathLike, sink: PathLike, timing: SensorTiming, options: ProcessVideoOptions) -> StackReport:
    """Restore a video of any length from file to file, and steady it.

    The vibration is followed from frame to frame (``VibrationTracker``) instead of detected in windows: neighbouring
    frames are restored alike, nothing changes at the borders of windows, and detection takes little time. Frames of
    4:2:0 videos are restored as they are stored: luma with the method, chroma, which has half the resolution, with
    ``"dewarp"``. Decoding, tracking, restoration and encoding run in threads.

    Frames that cannot be decoded, constant frames and copies are replaced by the frame before. Frames whose motion is
    not known are written as taken; the manifest counts them. The video is encoded in parts of 32 frames in the folder
    ``.NAME.rsvib`` beside it, from which an interrupted run is resumed.

    Args:
        source: A video, or another stack as in ``read_stack``.
        sink: The video to write: .mp4, .mov, .m4v (H.264) or .mkv, .avi (FFV1, without loss). Times, sound and metadata
            are those of the source.
        timing: As in ``process_stack``.
        options: Options. A part of the video is a window in the manifest; its detection is that of the last frame, at
            ``start_time``.

    Returns:
        Summary of the run.

    Raises:
        FileExistsError: If there is an interrupted run and ``resume`` is False.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        OSError: If a file cannot be read or written; the run can then be resumed.
        TypeError: If an option is unknown.
        ValueError: If a value is out of range, the source is not readable, margins leave nothing, an output would
            replace the input, or input, settings or versions differ from those of the run to resume.

    Example:
        >>> process_video("shaky.mp4", "steady.mp4", timing, steady=1.0, border="crop")  # doctest: +SKIP
    """
    begin, source, sink = time.perf_counter(), Path(source), Path(sink)
    border, steady = options.border, options.steady
    video, at_once = _planned(source, timing, options)
    job = video.job
    if sink.suffix.lower() not in CONTAINERS:
        raise ValueError(f"{sink}: videos are written to {', '.join(CONTAINERS)}")
    target = manifest_path(sink, options)
    check_outputs([sink, work_folder(sink), target], stack_files(source))
    content = _content(job, timing)
    if border != "crop":
        check_info_target(sink, content, check_folder=False)
    header = manifest_header(job, sink.name, None)
    header["settings"] |= {
        "window": None,  # for the commands that read manifests: parts are not windows of their own
        "video": {"border": border, "steady": steady, "columns": options.columns, "window": options.window},
    }
    waiting = math.ceil(0.5 * steady / timing.frame_period) * 2 * content.frame_bytes
    check_fits(f"{source}: the frames of half of steady={steady:g} s", waiting, "choose a shorter time")

    def compute(folder: RunFolder) -> dict[str, Any]:
        nonlocal content
        shown = _Progress(options.progress, len(video.starts), 2 if border == "crop" else 1)
        with tempfile.TemporaryFile() as tracks, closing(open_stack(source)) as reader:
            margins = video.margins(tracks, shown) if border == "crop" else None
            content = _cut_content(content, margins)
            check_info_target(sink, content, check_folder=False)
            planes = planes_of(reader) if video.layout.planar else None
            with closing(_Encoder(folder, sink, content, planes)) as encoder:
                followed_frames = video.tracked(None if margins is None else tracks)
                _restore_parts(video, followed_frames, folder, encoder, border, margins, at_once, shown)
        return {"margins": None if margins is None else asdict(margins)}

    def write(folder: RunFolder) -> None:
        with whole_file(sink) as part:
            join_parts(part, content, (folder.open(name) for name in folder.files() if not name.endswith(".npy")))

    report = run_to_file(
        sink,
        target,
        header,
        windows=video.parts,
        resume=options.resume,
        compute=compute,
        write=write,
        not_kept=lambda _: metadata_not_kept(job.info, sink, tuple(content.shape)),
    )
    return replace(report, seconds=time.perf_counter() - begin)


class _Encoder:
    """Encodes the parts of a video into files of a run, and keeps the last frame of each part before it is cut."""

    def __init__(self, folder: RunFolder, video: Path, info: StackInfo, planes: PlaneReader | None) -> None:
        self._folder, self._video, self._info, self._planes = folder, video, info, planes
        self._writer: PartWriter | None = None

    def _names(self, part: int) -> tuple[str, str]:
        return f"{part:06d}{self._video.suffix.lower()}", f"{part:06d}.npy"

    def write(self, part: int, frame: Frame) -> None:
        """Encode the next frame of a part."""
        if self._writer is None:
            self._writer = PartWriter(self._folder.create(self._names(part)[0]), self._video, self._info, self._planes)
        self._writer.write(frame)

    def finish_part(self, record: Mapping[str, Any], last: Frame) -> None:
        """Finish a part with its ``WindowRecord`` and its last frame."""
        assert self._writer is not None
        self._writer.close()
        self._writer = None
        names = self._names(record["window"])
        with self._folder.create(names[1]) as file:
            np.save(file, last)
        self._folder.add(record, names)

    def last_frame(self, part: int) -> Frame | None:
        """The frame that a part ends with; None for the part before the first one."""
        if part < 0:
            return None
        with self._folder.open(self._names(part)[1]) as file:
            frame: Frame = np.load(file, allow_pickle=False)
        return frame

    def close(self) -> None:
        """Close the file of an unfinished part."""
        if self._writer is not None:
            self._writer.abandon()


def _cut_content(content: StackInfo, margins: Margins | None) -> StackInfo:
    """The content of the video without the margins."""
    if margins is None:
        return content
    kept = margins.cut(torch.empty(content.shape[-2:], device="meta")).shape
    return replace(content, shape=(*content.shape[:-2], *kept))


def _check_known(known: list[bool], parts: int, folder: RunFolder) -> None:
    """Raise a ``ValueError`` if the motion is known in none of the parts so far."""
    if len(known) >= min(_MAX_INITIAL_FAILURES, parts) and not any(known):
        folder.remove()
        raise ValueError(
            "no vibration was found that the rows of the frames have in common; detect it in windows, which states the "
            "reasons (process_stack; rsvib run with --output restored.mp4 instead of --video)"
        )


class _Progress:
    """Progress over the passes through a video, each of which counts alike."""

    def __init__(self, show: Progress, count: int, passes: int) -> None:
        self._show, self._count, self._passes, self._done = show, count, passes, 0
        if show is not None:
            show(0, count)

    def __call__(self) -> None:
        """Count one frame of a pass."""
        self._done += 1
        if self._show is not None:
            self._show(self._done // self._passes, self._count)


def _planned(source: Path, timing: SensorTiming, options: ProcessVideoOptions) -> tuple[VideoPasses, int]:
    """The job of a run with the layout of its frames, and the number of frames to restore at the same time."""
    given = dict(options.restoration or {})
    for name in ("joint", "scale", "mosaic", "optics"):
        if given.pop(name, None) not in (None, False, 1):
            raise ValueError(f"{name} is not available for videos that are followed frame by frame; use process_stack")
    resources = {name: getattr(options, name) for name in fields_of(ResourceOptions)}
    job, _, at_once = plan_job(source, timing, StackOptions(restoration=given, window=2, **resources))
    reader: FrameReader = open_stack(source)
    try:
        planes = planes_of(reader)
    finally:
        reader.close()
    method = RestorationOptions(**given)
    white = None
    if isinstance(method.saturation, float):
        black, full = (0.0, job.full_scale or 1.0) if planes is None else (planes.black, planes.white)
        white = black + method.saturation * (full - black)
    scale = 255.0 if planes is not None else job.full_scale
    layout = FrameLayout(job.info.shape[1:], planes is not None, scale, white, np.dtype(job.info.dtype))
    restorer = VideoRestorer(layout, job.timing, method, job.device, masks=options.border != "mirror")
    times = job.timing.frame_starts(job.info.shape[0]).tolist()
    starts = [start - times[0] for start in times]
    return VideoPasses(job, layout, restorer, starts, options.steady, options.columns, options.window), at_once


def _content(job: StackJob, timing: SensorTiming) -> StackInfo:
    return replace(
        job.info,
        full_scale=job.full_scale,
        frame_times=None if job.info.frame_times is None else exposure_times(job.info, timing),
        time_error=0.0,
        frame_rate=job.info.frame_rate or timing.frame_rate,
    )


def _restore_parts(
    video: VideoPasses,
    followed_frames: Generator[tuple[FrameTrack, Frame | str], None, None],
    folder: RunFolder,
    encoder: _Encoder,
    border: str,
    margins: Margins | None,
    at_once: int,
    progress: Callable[[], None],
) -> None:
    """Restore and encode all parts that are not in the folder."""
    share_one_heap()
    default_threads = torch.get_num_threads()
    threads = 1 if video.job.device == "cpu" else default_threads
    pool = ThreadPoolExecutor(at_once, "rsvib-restore", initializer=torch.set_num_threads, initargs=(threads,))
    tracks: list[FrameTrack] = []  # of the part
    pair: list[tuple[FrameTrack, Frame]] = []  # the first two neighbouring frames of known motion
    known = [record["detection"] is not None for record in folder.records()]
    before: Planes | None = None
    done = -1

    def missing() -> Iterator[tuple[FrameTrack, Frame | str]]:
        """Frames of the parts that are not in the folder."""
        for track, frame in followed_frames:
            if track.index // PART_FRAMES not in folder:
                yield track, frame
            else:
                progress()

    def restore(track: FrameTrack, frame: Frame | str) -> tuple[FrameTrack, Frame | str, RestoredFrame]:
        return track, frame, video.restorer.restored(frame, track)

    frames = results_in_order(missing(), lambda item: pool.submit(restore, *item), lambda: at_once + 2, deque())
    try:
        with closing(followed_frames), closing(frames):
            for track, frame, restored in frames:
                part = track.index // PART_FRAMES
                if track.index != done + 1 or before is None:
                    ended = encoder.last_frame(part - 1)
                    before = None if ended is None else video.layout.planes(ended)
                before, done = _without_gaps(restored, before, video.layout, border), track.index
                with disk_errors_named(folder):
                    encoder.write(part, video.layout.frame(_cut(before, margins)))
                tracks.append(track)
                if len(pair) < 2 and track.known and not isinstance(frame, str):
                    pair = [*pair[-1:], (track, frame)] if pair and pair[-1][0].index == done - 1 else [(track, frame)]
                if video.ends_part(done):
                    verdict = video.verdict(pair) if len(pair) == 2 else None
                    record = video.record(part, tracks, verdict)
                    known.append(any(track.known for track in tracks))
                    _check_known(known, video.parts, folder)
                    with disk_errors_named(folder):
                        encoder.finish_part(record, video.layout.frame(before))
                    tracks, pair = [], []
                progress()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        torch.set_num_threads(default_threads)


def _without_gaps(restored: RestoredFrame, before: Planes | None, layout: FrameLayout, border: str) -> Planes:
    """Planes of a frame to write: those of the frame before where there are none, and at hidden pixels if they hold."""
    planes = restored.planes
    if planes is None or (restored.fault is not None and before is not None):
        return layout.black() if before is None else before
    if border == "mirror" or restored.visible is None or before is None:
        return planes
    pairs = zip(restored.visible, planes, before, strict=True)
    return [np.where(visible, plane, old) for visible, plane, old in pairs]


def _cut(planes: Planes, margins: Margins | None) -> Planes:
    """Planes without margins; those of chroma are half as wide."""
    if margins is None:
        return planes
    first, *others = planes
    sides = (margins.top, margins.bottom, margins.left, margins.right)
    return [margins.cut(first), *(Margins(*(side // 2 for side in sides)).cut(plane) for plane in others)]
