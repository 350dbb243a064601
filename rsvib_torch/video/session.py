"""A live session: a source of frames, the tracker, and outputs, in three threads.

The times at which frames arrive are not accurate enough for rows (a millisecond is 0.3 rad at 50 Hz). Frames of a
camera therefore get times that are whole frame periods apart; clocks only determine how many frames are missing in
between (``FrameCounter``).
"""

import math
import os
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.checks.values import check_whole_number, needed_package
from rsvib_torch.detection import DetectionResult
from rsvib_torch.execution.parallel import prefetched
from rsvib_torch.files.atomic import sync
from rsvib_torch.frames.full_scale import frames_to_counts
from rsvib_torch.io.frame_times import timing_from_first_frame
from rsvib_torch.io.stack_info import H264, StackInfo
from rsvib_torch.io.stack_reading import open_stack, read_stack_info
from rsvib_torch.io.video import CONTAINERS, VideoEncoder, check_video
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.tracking import TrackedFrame, VibrationTracker

if TYPE_CHECKING:
    from av.container import OutputContainer

Frame = NDArray[np.uint8]  # (H, W) grey or (H, W, 3) RGB

_CHECK = 0.05  # s between checks whether the source has ended, or the session
_LONGEST_READ = 2.0  # s that the end of a session waits for a frame of the source; OpenCV waits 30 s for a camera
# of FFmpeg: every frame is written when it is encoded, in a fragment (.mp4, .mov, .m4v) or cluster (.mkv) of its own.
# After a kill, 2 of 100 frames are missing in .mp4 and 1 in .mkv; with the defaults, .mp4 cannot be read
_FRAGMENTS = {"flush_packets": "1", "movflags": "frag_every_frame+empty_moov+default_base_moof"}
_CLUSTERS = {"flush_packets": "1", "cluster_time_limit": "0"}  # ms
_WAITING_RESTORED = 2  # frames between tracking and writing: the largest delay of the output in frames
_LATENCY_COUNTS = 64  # frames; longer delays are counted as this
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, end of a service, end of a terminal
_LONGEST_END = 10.0  # s from such a signal until outputs that do not take frames, such as a full pipe, are abandoned


# Sources


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """A frame of a source."""

    pixels: Array  # (H, W) or (3, H, W) counts, or floats whose full scale is 1
    time: float  # s from the first frame
    arrived: float  # s of ``time.perf_counter``, when it was read


class FrameSource(Protocol):
    """A source of frames."""

    lost: int  # frames that the source did not deliver, by its clock
    waits: bool  # whether it delivers a frame when there is room for it; frames of others are dropped

    def frames(self) -> Iterator[TimedFrame]:
        """The frames; called once, in the thread that reads. A generator releases the source in its ``finally``."""


class FrameCounter:
    """Numbers of the frames of a camera, which may have lost some.

    The time stamps of the stream decide how many frames are missing, if their clock runs at the rate of the computer's:
    the streams of some cameras have made-up stamps. Otherwise the times of arrival decide. A late frame is not a lost
    one: the times behind a lost frame are later than before by whole periods. Arrival is therefore compared with the
    least delay of the last frames: with random delays of 3 to 10 ms at 30 frames/s, 0 to 6 frames in five minutes are
    counted as lost by mistake; with the intervals between frames, 30 to 850 were.
    """

    _FRAMES = 300  # of which the least delay is taken; the clock of a camera deviates by less than 0.1 periods in them

    def __init__(self, period: float) -> None:
        self._period, self._number = period, -1
        self._delays: deque[float] = deque(maxlen=self._FRAMES)  # periods

    def number(self, arrived: float, stamp: float) -> int:
        """Number of the next frame, from the time when it was read and that in the stream, both in s."""
        if self._number < 0:
            self._first = self._before = arrived, stamp
        by_arrival, by_stamp = (arrived - self._first[0]) / self._period, (stamp - self._first[1]) / self._period
        periods = 1
        if 0.9 * by_arrival < by_stamp < 1.1 * by_arrival:
            periods = round((stamp - self._before[1]) / self._period)
        elif self._delays:
            periods = math.floor(by_arrival - min(self._delays) - self._number + 0.1)
        self._number += max(1, periods)
        self._before = arrived, stamp
        delay = by_arrival - self._number
        # after a frame that was counted as lost by mistake, delays seem to be shorter by one period
        if len(self._delays) < self._FRAMES // 5 or delay > min(self._delays) - 0.05:
            self._delays.append(delay)
        return self._number


class CameraSource:
    """A camera of OpenCV, by its number or URL, or ``"-"``, a video on standard input; frames are RGB with 8 bits."""

    def __init__(self, camera: int | str, timing: SensorTiming, full_scale: float | None = None) -> None:
        self._camera, self._period, self.lost, self.waits = camera, timing.frame_period, 0, False
        self.full_scale = full_scale or 255.0

    def frames(self) -> Iterator[TimedFrame]:
        """The frames; times are whole frame periods apart."""
        is_pipe = self._camera == "-"
        problem = (
            "standard input is not a video that can be read from a pipe: send Matroska, MPEG-TS or fragmented MP4, or "
            "give the name of the file"
            if is_pipe
            else f"camera {self._camera} cannot be opened; check its number or URL, and whether it is in use"
        )
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # only the error below is shown
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        try:
            capture = cv2.VideoCapture("pipe:0" if is_pipe else self._camera)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            raise OSError(problem)
        counter, before = FrameCounter(self._period), -1
        try:
            while (answer := capture.read())[0]:
                pixels, now = answer[1], time.perf_counter()
                # a pipe may be slower than the camera, and delivers every frame
                stamp = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
                number = before + 1 if is_pipe else counter.number(now, stamp)
                self.lost, before = self.lost + number - before - 1, number
                if pixels.ndim == 3:
                    pixels = np.ascontiguousarray(np.moveaxis(pixels[..., ::-1], -1, 0))
                yield TimedFrame(pixels, number * self._period, now)
            if is_pipe and before < 0:  # an MP4 whose table is at its end can be opened
                raise OSError(problem)
        finally:
            capture.release()


class FileSource:
    """A file, as ``open_stack`` reads it, with its frame times; ``full_scale`` is that of its counts."""

    def __init__(self, path: Path, timing: SensorTiming, full_scale: float | None = None) -> None:
        info = read_stack_info(path)
        self._starts = timing_from_first_frame(timing, info).frame_starts(info.shape[0]).tolist()
        self._path, self.lost, self.waits = path, 0, True
        self.full_scale = (full_scale or info.full_scale) if info.is_integer else None

    def frames(self) -> Iterator[TimedFrame]:
        """The frames of the file."""
        with closing(open_stack(self._path)) as reader:
            for index, start in enumerate(self._starts):
                yield TimedFrame(reader.frame(index), start - self._starts[0], time.perf_counter())


class FrameReader:
    """Frames of a source, read in a thread; up to a number of them wait.

    If the source does not wait, the oldest waiting frames are dropped and counted.
    """

    def __init__(self, source: FrameSource, waiting: int = 64) -> None:
        self._source, self._stopped, self.dropped = source, False, 0
        self._frames: queue.Queue[TimedFrame] = queue.Queue(check_whole_number("waiting", waiting, at_least=1))
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._read, name="rsvib-read", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def _read(self) -> None:
        try:
            for frame in self._source.frames():
                while not self._stopped and not self._put(frame):
                    if not self._source.waits:
                        with suppress(queue.Empty):  # it has just been taken
                            self._frames.get_nowait()
                            self.dropped += 1
                if self._stopped:
                    return
        except Exception as error:  # raised again in the thread that takes the frames
            self._error = error

    def _put(self, frame: TimedFrame) -> bool:
        """Whether there was room for a frame."""
        try:
            self._frames.put(frame, block=self._source.waits, timeout=_CHECK)
        except queue.Full:
            return False
        return True

    def __iter__(self) -> Iterator[TimedFrame]:
        while not self._stopped:
            ended = not self._thread.is_alive()
            try:
                yield self._frames.get(block=not ended, timeout=_CHECK)
            except queue.Empty:
                if ended:
                    break
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End the iteration; may be called by a signal handler, because it waits for no other thread."""
        self._stopped = True

    def close(self) -> None:
        """Stop reading. The thread itself releases the source, because libraries crash if another one does so.

        A thread that waits for a source longer than ``_LONGEST_READ`` ends with the process.
        """
        self.stop()
        self._thread.join(_LONGEST_READ)


# Outputs


class FrameOutput(Protocol):
    """An output of video frames."""

    def write(self, frame: Frame, index: int) -> None:
        """Write a frame (H, W) or (H, W, 3); ``index`` counts frame periods from the first frame, and rises."""

    def close(self) -> None:
        """Finish the output."""


class PipeOutput:
    """Raw frames, 8 bits per channel, grey or RGB, one behind the other, in a pipe without a buffer."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def write(self, frame: Frame, index: int) -> None:
        """Write a frame."""
        data = memoryview(np.ascontiguousarray(frame).tobytes())
        while data:  # a signal may interrupt writing
            data = data[self._stream.write(data) :]

    def close(self) -> None:
        """The pipe belongs to the caller."""


class VideoOutput:
    """A video file: H.264 for .mp4, .mov and .m4v, FFV1 (without loss) for .mkv.

    The file is created with the first frame, and can be played from then on, however the process ends. A file that
    exists then is replaced only to ``overwrite`` it.
    """

    def __init__(self, path: Path, frame_rate: float, *, overwrite: bool = False) -> None:
        if path.suffix.lower() not in CONTAINERS:
            raise ValueError(f"{path}: a live video is written to .mp4, .mov, .m4v or .mkv; or to a pipe with --out -")
        self._av = needed_package("av", "writing video", "video")
        self._path, self._rate, self._overwrite = path, frame_rate, overwrite
        self._container: OutputContainer | None = None

    def write(self, frame: Frame, index: int) -> None:
        """Encode a frame; after an error, the file has the frames before."""
        pixels = frame if frame.ndim == 2 else np.moveaxis(frame, -1, 0)
        if self._container is None:
            self._create(pixels.shape)
        with self._errors_named():
            self._encoder.write(pixels, index * self._encoder.step)

    def _create(self, shape: tuple[int, ...]) -> None:
        info = StackInfo((2, *shape), "uint8", 255.0, frame_rate=self._rate)  # of any number of frames
        check_video(self._path, info)
        if self._overwrite:
            self._path.unlink(missing_ok=True)  # a link is replaced, not the file behind it
        try:
            self._path.open("xb").close()
        except FileExistsError as error:
            raise FileExistsError(f"{self._path} was created by another program; choose another name") from error
        sync(self._path.absolute().parent)
        lossy = self._path.suffix.lower() in H264
        self._container = self._av.open(str(self._path), "w", options=_FRAGMENTS if lossy else _CLUSTERS)
        # ultrafast keeps up with a camera; the other presets make smaller files of the same quality
        options = {"crf": "16", "preset": "ultrafast"} if lossy else {}
        self._encoder = VideoEncoder(self._container, self._path, info, None, options=options)

    @contextmanager
    def _errors_named(self) -> Iterator[None]:
        """State the file in errors of FFmpeg, after which nothing more is written."""
        try:
            yield
        except self._av.error.FFmpegError as error:
            with suppress(self._av.error.FFmpegError):
                if self._container is not None:
                    self._container.close()
            self._container = None  # libav would crash if more was written after a header that could not be written
            raise OSError(f"{self._path}: {error.strerror}; the video has the frames before") from error

    def close(self) -> None:
        """Finish the file."""
        if self._container is not None:
            with self._errors_named():
                self._encoder.finish()
            self._container.close()
            sync(self._path)


# The session


@dataclass(eq=False)
class LiveReport:
    """What happened in a session."""

    frames: int = 0  # that were written
    tracked: int = 0  # frames whose motion, or path, was known
    corrected: int = 0  # frames whose rows or content were moved
    predicted: int = 0  # tracked frames whose motion was predicted and not measured, because they were late
    unusable: int = 0  # frames that were constant, or copies
    dropped: int = 0  # frames that arrived and were dropped, because processing was too slow
    lost: int = 0  # frames that the source did not deliver, by its clock
    detections: int = 0  # calls of ``detect_vibration``
    seconds: float = 0.0  # duration of the session
    # number of frames by their delay: how many frames had arrived behind it when a frame was written
    latencies: list[int] = field(default_factory=lambda: [0] * (_LATENCY_COUNTS + 1))
    detection: DetectionResult | None = None  # the last vibration

    def latency(self, share: float) -> int:
        """Delay in frames that ``share`` (0 to 1) of the frames do not exceed."""
        counts = np.cumsum(self.latencies)
        return int(np.searchsorted(counts, share * counts[-1]))


class _AbandonedError(Exception):
    """An output has taken no frames for too long after a signal."""


def run_live(source: FrameSource, tracker: VibrationTracker, outputs: Sequence[FrameOutput]) -> LiveReport:
    """Track the frames of a source, and write the restored ones, until the source ends or a signal arrives.

    If processing is too slow for a source that does not wait, the motion of late frames is predicted instead of
    measured, and beyond 64 waiting frames the oldest are dropped. SIGINT (Ctrl-C), SIGTERM and SIGHUP end the session
    in the main thread, unless the caller handles or ignores them.

    Args:
        source: The source.
        tracker: The tracker.
        outputs: They get frames of 8 bits, (H, W) or (H, W, 3), and are closed at the end. The session ends if the
            program behind a pipe does.

    Returns:
        The report.

    Raises:
        Exception: Errors of the source, the tracker and the outputs. Videos contain the frames before an error of the
            source or the tracker.
    """
    report, begin, threads = LiveReport(), time.perf_counter(), torch.get_num_threads()
    period = tracker.timing.frame_period
    reader, last, index = FrameReader(source), None, -1

    with ExitStack() as ending:  # from the last line to the first
        ending.callback(torch.set_num_threads, threads)
        torch.set_num_threads(max(1, threads // 2))  # tracking and writing share the processors
        in_time = ending.enter_context(_signals_stop(reader))
        ending.enter_context(suppress(BrokenPipeError, _AbandonedError))  # the program behind a pipe has ended
        ending.callback(in_time)
        ending.callback(reader.close)
        for output in outputs:
            ending.callback(output.close)
        of_source = _tracked(reader, tracker, report, waits=source.waits)
        tracked_frames = prefetched(of_source, _WAITING_RESTORED, torch.get_num_threads())
        ending.enter_context(closing(tracked_frames))
        ending.callback(reader.stop)
        reader.start()
        for tracked, arrived in tracked_frames:
            frame, index = to_counts(tracked.restored), max(index + 1, round(tracked.time / period))
            for output in outputs:
                output.write(frame, index)
            last = tracked
            report.frames += 1
            late = math.floor((time.perf_counter() - arrived) / period)
            report.latencies[min(late, _LATENCY_COUNTS)] += 1
    report.detection = None if last is None else last.detection
    report.dropped, report.lost = reader.dropped, source.lost
    report.seconds = time.perf_counter() - begin
    return report


@contextmanager
def _signals_stop(reader: FrameReader) -> Iterator[Callable[[], None]]:
    """Signals that end the process stop the reader instead; only the main thread can set their handlers.

    ``_LONGEST_END`` later the main thread is interrupted, unless the function that this yields was called before.
    """
    before: dict[signal.Signals, Callable[..., object] | int | None] = {}  # the handlers that are replaced

    def stop(*_: object) -> None:
        reader.stop()
        if signal.SIGALRM in before and not any(signal.getitimer(signal.ITIMER_REAL)):
            signal.setitimer(signal.ITIMER_REAL, _LONGEST_END)

    def interrupt(*_: object) -> None:
        raise _AbandonedError

    def in_time() -> None:
        if signal.SIGALRM in before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    if threading.current_thread() is threading.main_thread():
        usual = (signal.SIG_DFL, signal.default_int_handler)
        for number in (*_SIGNALS, signal.SIGALRM):
            if signal.getsignal(number) in usual:
                before[number] = signal.signal(number, interrupt if number == signal.SIGALRM else stop)
    try:
        yield in_time
    finally:
        in_time()
        for number, handler in before.items():
            signal.signal(number, handler)


def _tracked(
    reader: FrameReader, tracker: VibrationTracker, report: LiveReport, *, waits: bool
) -> Generator[tuple[TrackedFrame, float], None, None]:
    """Tracked frames with the times of ``perf_counter`` at which they arrived.

    The motion of frames that have waited for half a frame period is predicted: without this, 3 % of the frames had a
    delay of more than two frame periods in ten minutes (1024 x 1024, 30 frames/s).
    """
    for frame in reader:
        is_late = not waits and time.perf_counter() - frame.arrived > 0.5 * tracker.timing.frame_period
        tracked = tracker.update(frame.pixels, frame.time, measure=not is_late)
        is_tracked = tracked.state == "tracking"
        report.tracked += is_tracked or bool(tracked.path.isfinite().all())
        report.corrected += bool(tracked.motion.moving_axes().any())
        report.predicted += is_tracked and tracked.measurements is None
        report.unusable += tracked.state == "unusable"
        report.detections += tracked.detected
        yield tracked, frame.arrived


def to_counts(frame: Tensor) -> NDArray[np.uint8]:
    """A frame (H, W) or (C, H, W) of full scale 1 as 8-bit counts (H, W) or (H, W, C)."""
    counts = frames_to_counts(frame.nan_to_num(0.0), np.dtype(np.uint8), 255.0)
    return counts if frame.ndim == 2 else counts[0] if len(counts) == 1 else np.moveaxis(counts, 0, -1)
