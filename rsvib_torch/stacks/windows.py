"""Windows: consecutive frames that are processed together, and the records of their results."""

import itertools
from dataclasses import dataclass, field, replace
from typing import Literal

import torch

from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.results.reason import Reason


@dataclass(frozen=True)
class Window:
    """Consecutive frames whose vibration is detected together.

    Neighbouring windows share one frame, so that every pair of consecutive frames belongs to exactly one window; the
    later window writes the shared frame.
    """

    index: int
    first: int
    last: int  # inclusive
    kept: int  # number of frames that it writes

    @property
    def frames(self) -> range:
        """Indices of the frames that are read."""
        return range(self.first, self.last + 1)

    @property
    def written(self) -> range:
        """Indices of the frames that it writes."""
        return range(self.first, self.first + self.kept)

    @property
    def middle(self) -> int:
        """Index of the middle one of these, in whose place one image of all frames is written."""
        return self.written[self.kept // 2]

    @property
    def alone(self) -> bool:
        """Whether it is the whole stack."""
        return self.index == 0 and self.kept == self.last + 1 - self.first


def cut_windows(num_frames: int, window: int) -> list[Window]:
    """Cut a stack into windows of at most ``window`` frames, of equal length to within one frame.

    Example:
        >>> [(w.first, w.last, w.kept) for w in cut_windows(8, 4)]
        [(0, 2, 2), (2, 4, 2), (4, 7, 4)]
    """
    check_whole_number("window", window, at_least=2)
    pairs = max(1, num_frames - 1)
    count = -(-pairs // (window - 1))
    borders = [index * pairs // count for index in range(count + 1)]
    borders[-1] = num_frames - 1
    return [
        Window(index, first, last, last - first + (index == count - 1))
        for index, (first, last) in enumerate(itertools.pairwise(borders))
    ]


def window_timing(timing: SensorTiming, window: Window, frames: list[int]) -> SensorTiming:
    """Timing of the usable ``frames`` of a window as a stack, with the time origin at the first frame of the window."""
    if timing.frame_start_times is None and frames == list(range(window.first, window.last + 1)):
        return timing
    starts = timing.frame_starts(window.last + 1)
    return replace(timing, frame_start_times=starts[torch.tensor(frames, device="cpu")] - starts[window.first])


@dataclass(frozen=True, eq=False)
class WindowRecord:
    """Result of one window, as the manifest has it."""

    window: int  # its number
    first: int  # frame
    last: int  # frame
    start_time: float  # s, exposure start of its first row, the time origin of its detection
    written: int  # number of frames written
    frames: Literal["restored", "as taken"] = "as taken"  # those that are written
    detection: DetectedVibration | None = None  # None: it failed; with a ``motion``, tones in its place
    left_alone: tuple[Reason, ...] = ()  # a reason for each axis that was not restored
    outcome: str | None = None  # ``RestorationVerdict.overall``; None if the frames could not be compared
    verdict: str | None = None  # ``RestorationVerdict.sentence``
    predicted_gain: float | None = None  # dB, mean of ``RestorationVerdict.predicted_gain``; None if unknown
    error: str | None = None  # why detection or restoration failed
    bad_frames: dict[str, str] = field(default_factory=dict)  # index of each that could not be used, with the reason
    # Of a part of a video, rms motion in px before and after, in its first frames: ``frame_to_frame``, changes of the
    # motion of the frame, and ``rows``, of twelfths of the rows beside it. None: not measured.
    shaking: dict[str, tuple[float, ...]] | None = None
    motion: FreeMotion | None = None  # of a vibration that changes, in place of tones; axes that are not reliable rest
    lost_before: int | None = None  # frame of the stack before which one is lost: from it on, a frame period later
    lost_rows: dict[str, int] = field(default_factory=dict)  # number for each frame of the stack that has some
