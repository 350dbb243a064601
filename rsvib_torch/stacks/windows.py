"""Windows: consecutive frames that are processed together. They depend only on the length of the stack."""

import itertools
from dataclasses import dataclass, replace

import torch

from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.motion.timing import SensorTiming


@dataclass(frozen=True)
class Window:
    """Consecutive frames whose vibration is detected together.

    Neighbouring windows share one frame, so that every pair of consecutive frames belongs to exactly one window; the
    later window writes the shared frame.

    Attributes:
        index: Number of the window.
        first: Index of its first frame.
        last: Index of its last frame (inclusive).
        kept: Number of frames that it writes.
        before: Number of frames before the first that are read as well, to begin to follow the vibration.
    """

    index: int
    first: int
    last: int
    kept: int
    before: int = 0

    @property
    def frames(self) -> range:
        """Indices of the frames that are read."""
        return range(self.first - self.before, self.last + 1)

    @property
    def written(self) -> range:
        """Indices of the frames that it writes."""
        return range(self.first, self.first + self.kept)

    @property
    def alone(self) -> bool:
        """Whether it is the whole stack."""
        return self.index == 0 and self.kept == len(self.frames)


def cut_windows(num_frames: int, window: int, before: int = 0) -> list[Window]:
    """Cut a stack into windows of at most ``window`` frames, of equal length to within one frame.

    Args:
        num_frames: Number of frames of the stack.
        window: Maximum number of frames of a window, at least 2.
        before: Number of frames before each window that are read as well, if there are so many.

    Returns:
        Windows in order; a stack of up to ``window`` frames is one window.

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
        Window(index, first, last, last - first + (index == count - 1), min(before, first))
        for index, (first, last) in enumerate(itertools.pairwise(borders))
    ]


def window_timing(timing: SensorTiming, window: Window, frames: list[int]) -> SensorTiming:
    """Timing of the usable ``frames`` of a window as a stack, with the time origin at the first frame of the window."""
    if timing.frame_start_times is None and frames == list(window.frames):
        return timing
    starts = timing.frame_starts(window.last + 1)
    return replace(timing, frame_start_times=starts[torch.tensor(frames, device="cpu")] - starts[window.first])
