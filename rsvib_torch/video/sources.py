"""Sources of frames: cameras, pipes of raw frames and files, and a thread that reads them without waiting.

The times at which frames arrive are not accurate enough for rows (a millisecond is 0.3 rad at 50 Hz). Frames of a
camera therefore get times that are whole frame periods apart; clocks only determine how many frames are missing in
between (``FrameCounter``).
"""

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol, get_args

import cv2
import numpy as np

from rsvib_torch.checks.values import check_choice, check_whole_number
from rsvib_torch.io import open_stack, read_stack_info, timing_from_first_frame
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import PixelFormat

_CHECK = 0.05  # s between checks whether the source has ended, or the session
_LONGEST_READ = 2.0  # s that the end of a session waits for a frame of the source; OpenCV waits 30 s for a camera


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """A frame of a source."""

    pixels: Array  # (H, W) or (3, H, W) counts, or floats whose full scale is 1
    time: float  # s from the first frame
    arrived: float  # s of ``time.perf_counter``, when it was read


class FrameSource(Protocol):
    """A source of frames."""

    full_scale: float | None  # count that means 1.0; None for floats
    lost: int  # frames that the source did not deliver, by its clock

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
    """A camera of OpenCV, by its index or URL."""

    full_scale: float | None = 255.0

    def __init__(self, camera: int | str, timing: SensorTiming) -> None:
        self._camera, self._period, self.lost = camera, timing.frame_period, 0

    def frames(self) -> Iterator[TimedFrame]:
        """The frames; times are whole frame periods apart."""
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # only the error below is shown
        try:
            capture = cv2.VideoCapture(self._camera)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            raise OSError(f"camera {self._camera} cannot be opened; check its number or URL, and whether it is in use")
        counter, before = FrameCounter(self._period), -1
        try:
            while (answer := capture.read())[0]:
                pixels, now = answer[1], time.perf_counter()
                number = counter.number(now, 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC))
                self.lost, before = self.lost + number - before - 1, number
                if pixels.ndim == 3:
                    pixels = _channels_first(pixels[..., ::-1])
                yield TimedFrame(pixels, number * self._period, now)
        finally:
            capture.release()


class PipeSource:
    """Raw frames of a size (height, width) one behind the other in a pipe."""

    def __init__(
        self, stream: BinaryIO, size: tuple[int, int], pixel_format: PixelFormat, timing: SensorTiming
    ) -> None:
        check_choice("pixel_format", pixel_format, get_args(PixelFormat))
        for side in size:
            check_whole_number("size", side, at_least=1)
        self._stream, self._size, self._format, self._period = stream, size, pixel_format, timing.frame_period
        self.full_scale: float | None = 65535.0 if pixel_format == "gray16le" else 255.0
        self.lost = 0

    def frames(self) -> Iterator[TimedFrame]:
        """The frames; an incomplete one at the end is left out."""
        height, width = self._size
        dtype = np.dtype("<u2" if self._format == "gray16le" else "u1")
        channels = 3 if self._format in ("rgb24", "bgr24") else 1
        count, index = height * width * channels * dtype.itemsize, 0
        while len(data := self._stream.read(count)) == count:
            pixels = np.frombuffer(data, dtype).reshape(height, width, channels)
            pixels = pixels[..., ::-1] if self._format == "bgr24" else pixels
            pixels = _channels_first(pixels) if channels == 3 else pixels[..., 0]
            yield TimedFrame(pixels, index * self._period, time.perf_counter())
            index += 1


class FileSource:
    """A file, as ``open_stack`` reads it, with its frame times.

    Frames come as fast as they are processed. ``full_scale`` is the count that means 1.0, if the file does not state
    it.
    """

    def __init__(self, path: Path, timing: SensorTiming, full_scale: float | None = None) -> None:
        info = read_stack_info(path)
        self._starts = timing_from_first_frame(timing, info).frame_starts(info.shape[0]).tolist()
        self._path, self.lost = path, 0
        self.full_scale = (full_scale or info.full_scale) if info.is_integer else None

    def frames(self) -> Iterator[TimedFrame]:
        """The frames of the file."""
        with closing(open_stack(self._path)) as reader:
            for index, start in enumerate(self._starts):
                yield TimedFrame(reader.frame(index), start - self._starts[0], time.perf_counter())


def _channels_first(pixels: Array) -> Array:
    return np.ascontiguousarray(np.moveaxis(pixels, -1, 0))


class FrameReader:
    """Frames of a source, read in a thread; up to a number of them wait.

    If frames may be dropped, the source never waits, and the oldest waiting frames are dropped and counted.
    """

    def __init__(self, source: FrameSource, waiting: int = 64, *, drops: bool = True) -> None:
        self._source, self._drops, self._stopped, self.dropped = source, drops, False, 0
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
                    if self._drops:
                        with suppress(queue.Empty):
                            self._frames.get_nowait()
                            self.dropped += 1
                if self._stopped:
                    return
        except Exception as error:  # raised again in the thread that takes the frames
            self._error = error

    def _put(self, frame: TimedFrame) -> bool:
        """Whether there was room for a frame; waits for it if no frames may be dropped."""
        try:
            self._frames.put(frame, block=not self._drops, timeout=_CHECK)
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
