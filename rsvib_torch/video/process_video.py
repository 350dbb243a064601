"""Videos from file to file, followed from frame to frame: ``process_video``."""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from itertools import count, groupby
from pathlib import Path

import numpy as np
import torch

from rsvib_torch.checks.arguments import PathLike
from rsvib_torch.checks.values import fields_of
from rsvib_torch.execution.parallel import in_threads
from rsvib_torch.files.atomic import whole
from rsvib_torch.frames.entry_points import file_options
from rsvib_torch.gyroscope.gpmf_track import read_camera_track
from rsvib_torch.gyroscope.read_gyroscope import read_gyroscope
from rsvib_torch.gyroscope.rotation_alignment import RotationAlignment
from rsvib_torch.io.stack_info import StackInfo, split_range
from rsvib_torch.io.stack_reading import open_stack
from rsvib_torch.io.stack_writing import check_info_target, metadata_not_kept, stack_files
from rsvib_torch.io.video import CONTAINERS, VideoReader, join_parts, part_of_video
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import table
from rsvib_torch.options import ProcessVideoOptions, ResourceOptions, StackOptions
from rsvib_torch.results.presentation import plain_values
from rsvib_torch.stacks.job import plan_job
from rsvib_torch.stacks.manifest import fingerprint, manifest_header, rms_shaking
from rsvib_torch.stacks.memory import share_one_heap
from rsvib_torch.stacks.run_folder import FileRun, RunFolder, StackReport
from rsvib_torch.video import Margins
from rsvib_torch.video.video_frames import Frame, FrameTrack, VideoFrames
from rsvib_torch.video.video_motion import PART_FRAMES, VideoMotion, VideoPart, shakes_more, video_motion

_TOGETHER = ("joint", "scale", "mosaic", "optics")  # options of restore that frames one by one do not have

# What the manifest states of the alignment of a gyroscope.
_OF_GYROSCOPE = ("orientation", "offset", "offset_std", "scale", "bias", "focal_length", "focal_length_std")


@file_options(ProcessVideoOptions)
def process_video(source: PathLike, sink: PathLike, timing: SensorTiming, options: ProcessVideoOptions) -> StackReport:
    """Restore a video of any length from file to file, and steady it.

    The video is read twice. The first pass follows corners, each at the time of its row, and fits the path of the
    camera (x, y, roll, zoom) and the tones of its vibration in overlapping windows of 96 frames, or of 24 frames where
    tones sweep. The second pass undoes the tones and, with ``steady``, the skew and wobble by the path, and moves the
    frames to a smooth path. With ``gyroscope``, the path is the rotation that it recorded, aligned as in
    ``align_motion``, and no tones are fitted. Of 4:2:0 videos, luma is restored with the method, and chroma with
    ``"dewarp"``; H.264 gets 8 of 10 bits. The track of a GoPro video replaces the exposure of ``timing`` (``SHUT``); if
    it states that the camera has stabilised the images (``IORI``), they are moved as a whole.

    Of a part of 32 frames whose first eight would shake more than as taken, rows are not moved apart. Frames that
    cannot be decoded and constant frames are replaced by the frame before (at the beginning of a part by the one behind
    them); copies of the frame before are moved along the smooth path. Parts are encoded in the folder ``.NAME.rsvib``,
    from which an interrupted run is resumed. A video whose corners would shake more than in the input is not written.

    Args:
        source: A video, or another stack as in ``read_stack``.
        sink: The video to write: .mp4, .mov, .m4v (H.264) or .mkv (FFV1, without loss). Times, sound and metadata
            are those of the source.
        timing: As in ``process_stack``.
        options: Options. A part of the video is a window in the manifest; its detection is that of its middle, with the
            time origin ``start_time``.

    Returns:
        Summary of the run.

    Raises:
        FileExistsError: If there is an interrupted run and ``resume`` is False.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        OSError: If a file cannot be read or written; the run can then be resumed.
        ValueError: If a value is out of range, the source is not readable, margins leave nothing, an output would
            replace the input, input, settings or versions differ from those of the run to resume, frames have no motion
            in common, the alignment of the gyroscope is not reliable, or the result shakes more than the source.

    Example:
        >>> process_video("shaky.mp4", "steady.mp4", timing, steady=1.0, border="crop")  # doctest: +SKIP
    """
    source, sink = Path(source), Path(sink)
    border = options.border
    recording = None if options.gyroscope is None else Path(options.gyroscope)
    if recording == Path("auto"):
        recording = split_range(source)[0]
    rates = None if recording is None else read_gyroscope(recording)
    if rates is None and options.lens_profile is not None:
        raise ValueError("lens_profile belongs to a gyroscope: give gyroscope as well")
    frames, at_once = _planned(source, sink, timing, options)
    job, profile = frames.job, options.lens_profile
    camera = None if profile is None else Camera.from_gyroflow(profile, frames.size[1], frames.size[0])
    if sink.suffix.lower() not in CONTAINERS:
        raise ValueError(f"{sink}: videos are written to {', '.join(CONTAINERS)}")
    content = job.content(job.info, timing)
    if border != "crop":
        check_info_target(sink, content, parent_exists=False)
    header = manifest_header(job, sink.name)
    header["settings"] |= {
        "window": None,  # for the commands that read manifests: parts are not windows of their own
        "video": {
            "border": border,
            "steady": options.steady,
            "crop_limit": options.crop_limit,
            "gyroscope": None if recording is None else fingerprint(recording),
            "camera": camera and asdict(camera),
            "stabilised": frames.stabilised,
            "exposures": None if frames.exposures is None else np.sort(frames.exposures)[[0, -1]].tolist(),
        },
    }

    inputs = [*stack_files(source), *(Path(file) for file in (recording, profile) if file is not None)]
    run = FileRun(sink, options, header, inputs)
    finished = run.finished()
    if finished is not None:
        return finished
    with run.folder() as folder:
        resumed = len(folder.records())
        counter = count(1)  # both passes through the video count as half of it each

        def progress() -> None:
            if options.progress is not None:
                options.progress(next(counter) // 2, len(frames.starts))

        if options.progress is not None:
            options.progress(0, len(frames.starts))
        motion = video_motion(frames, options, rates, camera, progress)
        margins = motion.margins() if border == "crop" else None
        if margins is not None:
            size = margins.cut(torch.empty(content.shape[-2:], device="meta")).shape
            content = replace(content, shape=(*content.shape[:-2], *size))
        check_info_target(sink, content, parent_exists=False)
        _SecondPass(motion, folder, content, margins, progress).run(at_once)
        parts = range(-(-len(frames.starts) // PART_FRAMES))
        _check_shaking(folder, is_explained=any(map(motion.is_explained, parts)))
        gyroscope = None
        if isinstance(motion.path, RotationAlignment):
            gyroscope = {name: plain_values(getattr(motion.path, name)) for name in _OF_GYROSCOPE}
        not_kept = metadata_not_kept(job.info, sink, content.shape)
        fields = {"margins": margins and asdict(margins), "gyroscope": gyroscope, "not_kept": not_kept}
        with run.writing(folder, **fields) as manifest, whole(sink) as part:
            join_parts(part, content, map(folder.open, folder.files()))
    return run.report(manifest, resumed)


def _check_shaking(folder: RunFolder, *, is_explained: bool) -> None:
    """Raise a ``ValueError`` if the restored frames shake more than those of the input; nothing is kept.

    This also happens if it is unknown, and path and tones do not explain the corners of any part.
    """
    names = {"frame_to_frame": "from frame to frame", "rows": "between the rows"}
    shaking = rms_shaking(record.shaking for record in folder.records())
    if not shaking and not is_explained:
        folder.remove()
        raise ValueError(
            "the frames have too little detail: no path of the camera explains the motion of their corners, and the "
            "shaking of the restored video cannot be measured"
        )
    for key, (before, after) in shaking.items():
        if shakes_more(before, after):
            folder.remove()
            raise ValueError(
                f"the restored video would shake more than the input: {after:.2g} px {names[key]}, {before:.2g} px "
                "before. Check the timing (row_time, readout_direction, scan_axis), or whether the camera has "
                "stabilised the frames already"
            )


def _planned(source: Path, sink: Path, timing: SensorTiming, options: ProcessVideoOptions) -> tuple[VideoFrames, int]:
    """The job of a run with the layout of its frames, and the number of frames to restore at the same time."""
    restoration = options.restoration or {}
    for name in _TOGETHER:
        if restoration.get(name) is True or restoration.get(name) not in (None, False, 1):
            raise ValueError(
                f"{name} must be left out where frames are followed one by one; use process_stack "
                "(rsvib run without --video)"
            )
    restoration = {name: value for name, value in restoration.items() if name not in _TOGETHER}
    resources = {name: getattr(options, name) for name in fields_of(ResourceOptions)}
    job, _, at_once = plan_job(source, timing, StackOptions(restoration=restoration, window=2, **resources))
    with closing(open_stack(source)) as reader:
        stored = reader.picture if isinstance(reader, VideoReader) else None
    picture = stored if stored is not None and stored.fits(sink.suffix.lower()) else None
    if job.info.shape[0] < 3:
        raise ValueError(
            f"{source}: to be followed, a video needs at least 3 frames, it has {job.info.shape[0]}; use process_stack "
            "(rsvib run without --video)"
        )
    starts = table(job.timing.frame_starts(job.info.shape[0]))
    starts = starts - starts[0]
    # What the track of a GoPro video states of its frames. Rows are read at equal intervals, where exposures end:
    # frames of a longer exposure are exposed earlier in the mean.
    path, used = split_range(source)
    track, exposures = read_camera_track(path), None
    if track is not None and len(track.exposures):
        begin = 0.0 if used is None else used[0] * job.timing.frame_period
        exposures = track.exposures_at(starts + begin)
        starts = starts - 0.5 * (exposures - job.timing.exposure_time)
        starts = starts - starts[0]
    return VideoFrames(job, picture, starts, exposures, track is not None and track.stabilised), at_once


@dataclass(frozen=True, eq=False)
class _SecondPass:
    """Restores the parts of a video that are not in the folder, and encodes them there."""

    motion: VideoMotion
    folder: RunFolder
    info: StackInfo  # of the video to write
    margins: Margins | None  # which are cut off
    progress: Callable[[], None]

    def run(self, at_once: int) -> None:
        """Restore a number of frames at the same time."""
        share_one_heap()
        threads = 1 if self.motion.frames.job.options.device == "cpu" else torch.get_num_threads()
        with closing(in_threads(self._restored, self._missing(), at_once=at_once, threads=threads)) as frames:
            for part, of_part in groupby(frames, lambda one: one[0]):
                self._encode(part, (restored for _, restored in of_part))

    def _missing(self) -> Generator[tuple[VideoPart, FrameTrack, Frame | str], None, None]:
        """The frames to restore, with their part and what is removed from them."""
        with closing(self.motion.frames.decoded()) as decoded:
            for number, frames in groupby(enumerate(decoded), lambda one: one[0] // PART_FRAMES):
                if number in self.folder:
                    for _ in frames:
                        self.progress()
                    continue
                part = self.motion.part(number)
                for track, (_, frame) in zip(part.tracks, frames, strict=True):
                    yield part, track, frame

    def _restored(self, part: VideoPart, track: FrameTrack, frame: Frame | str) -> tuple[VideoPart, Frame | None]:
        """A restored frame; None if it could not be used."""
        if isinstance(frame, str) or track.fault is not None:
            return part, None
        layout = self.motion.frames
        return part, layout.frame(_cut(layout.restored(frame, track), self.margins))

    def _encode(self, part: VideoPart, frames: Iterator[Frame | None]) -> None:
        """Encode the frames of a part, and enter it in the folder."""
        layout, folder = self.motion.frames, self.folder
        name, waiting = f"{part.number:06d}{folder.sink.suffix.lower()}", 0
        shown: Frame | None = None  # the last frame that could be used
        with part_of_video(folder.create(name), folder.sink, self.info, layout.picture) as write:
            for number, frame in enumerate(frames):
                if number:
                    self.progress()  # the frame before is complete
                shown, waiting = shown if frame is None else frame, waiting + 1
                while waiting and shown is not None:  # the first frame that can be used also replaces those before it
                    write(shown)
                    waiting -= 1
            for _ in range(waiting):
                write(layout.frame(_cut(layout.black(), self.margins)))
        folder.add(self.motion.record(part), name)
        self.progress()


def _cut(planes: list[Frame], margins: Margins | None) -> list[Frame]:
    """Planes without margins; those of chroma are half as wide."""
    if margins is None:
        return planes
    luma, top, left = margins.cut(planes[0]), margins.top // 2, margins.left // 2
    rows, columns = luma.shape[-2] // 2, luma.shape[-1] // 2
    return [luma, *(chroma[..., top : top + rows, left : left + columns] for chroma in planes[1:])]
