"""The loop from a source of frames to its outputs: reading, tracking and writing in three threads."""

import math
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.live.frame_outputs import FrameOutput
from rsvib_torch.live.sources import FrameReader, FrameSource
from rsvib_torch.live.spectrogram import Spectrogram
from rsvib_torch.tracking import TrackedFrame, VibrationTracker, VideoBorder

_WAITING_RESTORED = 2  # frames between tracking and writing: the largest delay of the output in frames
_LATENCY_COUNTS = 64  # frames; longer delays are counted as this
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, end of a service, end of a terminal
_LONGEST_END = 10.0  # s from such a signal until outputs that do not take frames, such as a full pipe, are abandoned
_CHECK = 0.5  # s between checks whether a signal has arrived


@dataclass(eq=False)
class LiveReport:
    """What happened in a session.

    Attributes:
        frames: Frames that were written.
        tracked: Frames whose motion was known.
        predicted: Tracked frames whose motion was predicted and not measured, because they were late.
        unusable: Frames that were constant, or copies.
        dropped: Frames that arrived and were dropped, because processing was too slow.
        lost: Frames that the source did not deliver, by its clock.
        detections: Calls of ``detect_vibration``.
        seconds: Duration of the session.
        latencies: Number of frames by their delay: how many frames had arrived behind it when a frame was written.
        detection: The last vibration.
        size: (height, width) of the written frames.
    """

    frames: int = 0
    tracked: int = 0
    predicted: int = 0
    unusable: int = 0
    dropped: int = 0
    lost: int = 0
    detections: int = 0
    seconds: float = 0.0
    latencies: list[int] = field(default_factory=lambda: [0] * (_LATENCY_COUNTS + 1))
    detection: DetectionResult | None = None
    size: tuple[int, int] | None = None

    def latency(self, share: float) -> int:
        """Delay in frames that ``share`` (0 to 1) of the frames do not exceed."""
        counts = np.cumsum(self.latencies)
        return int(np.searchsorted(counts, share * counts[-1]))


def run_live(
    source: FrameSource,
    tracker: VibrationTracker,
    outputs: Sequence[FrameOutput],
    *,
    border: VideoBorder | None = None,
    drops: bool = True,
    waiting: int = 64,
    max_frames: int | None = None,
    spectrogram: Spectrogram | None = None,
    progress: Callable[[TrackedFrame, LiveReport], None] | None = None,
    save: Callable[[], object] | None = None,
) -> LiveReport:
    """Track the frames of a source, and write the restored ones, until the source ends or a signal arrives.

    SIGINT (Ctrl-C), SIGTERM and SIGHUP end the session in the main thread, unless the caller handles or ignores them.

    Args:
        source: The source.
        tracker: The tracker.
        outputs: They get frames of 8 bits, (H, W) or (H, W, 3), and are closed at the end. The session ends if the
            program behind a pipe does.
        border: Treatment of pixels that the sensor did not record.
        drops: Whether the source must not wait. If processing is too slow, the motion of late frames is then predicted
            instead of measured, and beyond ``waiting`` frames the oldest are dropped.
        waiting: Largest number of frames that wait.
        max_frames: Number of frames to process; None for all.
        spectrogram: Collects the offsets.
        progress: Called for every tracked frame.
        save: Called when all frames are written, also after an error; no signal ends the process before it returns.

    Returns:
        The report.

    Raises:
        Exception: Errors of the source, the tracker and the outputs. Videos contain the frames before an error of the
            source or the tracker.
    """
    report, begin, threads = LiveReport(), time.perf_counter(), torch.get_num_threads()
    torch.set_num_threads(max(1, threads // 2))  # tracking and writing share the processors
    reader = FrameReader(source, waiting, drops=drops)
    writer = _Writer(outputs, border or VideoBorder("mirror"), report, reader, tracker.timing.frame_period)
    with ExitStack() as ending:  # frames before an error of the source are not lost
        ending.callback(torch.set_num_threads, threads)
        ending.enter_context(_signals_call(reader.stop))
        ending.push(partial(_save, save, report))
        ending.callback(reader.close)
        ending.callback(writer.finish)
        reader.start()
        for tracked, arrived in _tracked(reader, tracker, report, drops, max_frames):
            if spectrogram is not None:
                spectrogram.add(tracked)
            if progress is not None:
                progress(tracked, report)
            if not writer.put((tracked, arrived)):
                break
    report.dropped, report.lost = reader.dropped, source.lost
    report.seconds = time.perf_counter() - begin
    return report


def _save(save: Callable[[], object] | None, report: LiveReport, _: Any, error: BaseException | None, *__: Any) -> None:
    """Save what belongs to the written frames; after an error of the session, errors of ``save`` are not shown."""
    if save is not None and report.frames > 0:
        with suppress(*[] if error is None else [Exception]):
            save()


@contextmanager
def _signals_call(stop: Callable[[], None]) -> Iterator[None]:
    """Signals that end the process call ``stop`` instead; only the main thread can set their handlers."""
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        usual = (signal.SIG_DFL, signal.default_int_handler)
        before = {number: signal.getsignal(number) for number in _SIGNALS if signal.getsignal(number) in usual}
    for number in before:
        signal.signal(number, lambda *_: stop())
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _tracked(
    reader: FrameReader, tracker: VibrationTracker, report: LiveReport, drops: bool, max_frames: int | None
) -> Iterator[tuple[TrackedFrame, float]]:
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
        report.tracked += is_tracked
        report.predicted += is_tracked and tracked.measurements is None
        report.unusable += tracked.state == "unusable"
        report.detections += tracked.detected
        yield tracked, frame.arrived


class _Writer:
    """Restores and writes frames in a thread, while the next ones are tracked."""

    def __init__(
        self,
        outputs: Sequence[FrameOutput],
        border: VideoBorder,
        report: LiveReport,
        reader: FrameReader,
        period: float,
    ) -> None:
        self._outputs, self._border, self._report = outputs, border, report
        self._reader, self._period = reader, period
        self._queue: queue.Queue[tuple[TrackedFrame, float] | None] = queue.Queue(_WAITING_RESTORED)
        self._error: Exception | None = None
        self._last: TrackedFrame | None = None
        self._threads = torch.get_num_threads()
        self._thread = threading.Thread(target=self._run, name="rsvib-write", daemon=True)
        self._thread.start()

    def put(self, item: tuple[TrackedFrame, float] | None) -> bool:
        """Hand over a frame, or None behind the last one; waits while the thread is behind.

        Returns:
            Whether it was handed over.
        """
        while self._is_running():
            try:
                self._queue.put(item, timeout=_CHECK)
            except queue.Full:
                continue
            return True
        return False

    def _is_running(self) -> bool:
        """Whether the thread has not ended, and is not abandoned."""
        stopped = self._reader.stopped_at
        return self._thread.is_alive() and (stopped is None or time.perf_counter() < stopped + _LONGEST_END)

    def finish(self) -> None:
        """Wait until all frames are written and the outputs are closed; raises the error of the thread."""
        self.put(None)
        while self._is_running():
            self._thread.join(_CHECK)
        if self._error is not None:
            raise self._error
        if self._last is not None:
            self._report.detection = self._last.detection

    def _run(self) -> None:
        torch.set_num_threads(self._threads)  # of this thread
        try:
            with ExitStack() as opened:
                for output in self._outputs:
                    opened.callback(output.close)
                while (item := self._queue.get()) is not None:
                    self._write(*item)
        except BrokenPipeError:  # the program behind a pipe has ended
            pass
        except Exception as error:  # raised again in the main thread
            self._error = error

    def _write(self, tracked: TrackedFrame, arrived: float) -> None:
        frame = to_counts(self._border(tracked))
        index = round(tracked.time / self._period)
        for output in self._outputs:
            output.write(frame, index)
        self._last = tracked
        self._report.size = frame.shape[:2]
        self._report.frames += 1
        late = math.floor((time.perf_counter() - arrived) / self._period)
        self._report.latencies[min(late, _LATENCY_COUNTS)] += 1


def to_counts(frame: Tensor) -> NDArray[np.uint8]:
    """A frame (H, W) or (C, H, W) of full scale 1 as 8-bit counts (H, W) or (H, W, C)."""
    counts = frame.nan_to_num(0.0).mul_(255.0).round_().clamp_(0.0, 255.0).to(torch.uint8)
    counts = counts if frame.ndim == 2 else counts[0] if frame.shape[0] == 1 else counts.movedim(0, -1)
    return counts.cpu().numpy()
