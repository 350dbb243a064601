"""The loop from a source of frames to its outputs: frames are read, tracked and written in three threads."""

import math
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.execution.parallel import prefetched
from rsvib_torch.frames.full_scale import frames_to_counts
from rsvib_torch.tracking import TrackedFrame, VibrationTracker
from rsvib_torch.video.frame_outputs import FrameOutput
from rsvib_torch.video.sources import FrameReader, FrameSource

_WAITING_RESTORED = 2  # frames between tracking and writing: the largest delay of the output in frames
_LATENCY_COUNTS = 64  # frames; longer delays are counted as this
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, end of a service, end of a terminal
_LONGEST_END = 10.0  # s from such a signal until outputs that do not take frames, such as a full pipe, are abandoned


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


def run_live(
    source: FrameSource,
    tracker: VibrationTracker,
    outputs: Sequence[FrameOutput],
    *,
    drops: bool = True,
    max_frames: int | None = None,
    progress: Callable[[TrackedFrame, LiveReport], None] | None = None,
) -> LiveReport:
    """Track the frames of a source, and write the restored ones, until the source ends or a signal arrives.

    SIGINT (Ctrl-C), SIGTERM and SIGHUP end the session in the main thread, unless the caller handles or ignores them.

    Args:
        source: The source.
        tracker: The tracker.
        outputs: They get frames of 8 bits, (H, W) or (H, W, 3), and are closed at the end. The session ends if the
            program behind a pipe does.
        drops: Whether the source must not wait. If processing is too slow, the motion of late frames is then predicted
            instead of measured, and beyond 64 waiting frames the oldest are dropped.
        max_frames: Number of frames to process; None for all.
        progress: Called for every tracked frame.

    Returns:
        The report.

    Raises:
        Exception: Errors of the source, the tracker and the outputs. Videos contain the frames before an error of the
            source or the tracker.
    """
    report, begin, threads = LiveReport(), time.perf_counter(), torch.get_num_threads()
    period = tracker.timing.frame_period
    reader, last, index = FrameReader(source, drops=drops), None, -1

    with ExitStack() as ending:  # from the last line to the first
        ending.callback(torch.set_num_threads, threads)
        torch.set_num_threads(max(1, threads // 2))  # tracking and writing share the processors
        in_time = ending.enter_context(_signals_stop(reader))
        ending.enter_context(suppress(BrokenPipeError, _AbandonedError))  # the program behind a pipe has ended
        ending.callback(in_time)
        ending.callback(reader.close)
        for output in outputs:
            ending.callback(output.close)
        tracked_frames = prefetched(
            _tracked(reader, tracker, report, drops, max_frames), _WAITING_RESTORED, torch.get_num_threads()
        )
        ending.enter_context(closing(tracked_frames))
        ending.callback(reader.stop)
        reader.start()
        for tracked, arrived in tracked_frames:
            if progress is not None:
                progress(tracked, report)
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
    reader: FrameReader, tracker: VibrationTracker, report: LiveReport, drops: bool, max_frames: int | None
) -> Generator[tuple[TrackedFrame, float], None, None]:
    """Tracked frames with the times of ``perf_counter`` at which they arrived.

    The motion of frames that have waited for half a frame period is predicted if the source must not wait: without
    this, 3 % of the frames had a delay of more than two frame periods in ten minutes (1024 x 1024, 30 frames/s).
    """
    for count, frame in enumerate(reader):
        if count == max_frames:
            return
        is_late = drops and time.perf_counter() - frame.arrived > 0.5 * tracker.timing.frame_period
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
