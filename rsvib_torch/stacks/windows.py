"""A long stack cut into windows: where they begin and end depends on the stack alone."""

import itertools
from dataclasses import dataclass

import torch

from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.motion.timing import SensorTiming

__all__ = ["Window", "cut_windows", "window_timing"]


@dataclass(frozen=True)
class Window:
    """Consecutive frames whose vibration is detected together.

    Neighbouring windows share one frame, so that every pair of consecutive frames is in exactly one window; the
    shared frame is written by the later one.

    Attributes:
        index: Number of the window.
        first: Its first frame.
        last: Its last frame, which belongs to it.
        kept: Number of its frames that it writes.
    """

    index: int
    first: int
    last: int
    kept: int

    @property
    def frames(self) -> range:
        """Its frames."""
        return range(self.first, self.last + 1)

    @property
    def alone(self) -> bool:
        """Whether it is the whole stack."""
        return self.index == 0 and self.kept == len(self.frames)

    @property
    def written(self) -> range:
        """The frames that it writes."""
        return range(self.first, self.first + self.kept)


def cut_windows(num_frames: int, window: int) -> list[Window]:
    """Cut a stack into windows of at most ``window`` frames, as equal as they can be.

    Args:
        num_frames: Frames of the stack.
        window: Most frames of a window, at least 2.

    Returns:
        Windows in order; a stack that is no longer than one is one window.

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
    """Timing of some frames of a window as a stack of its own: time begins with the window's first frame.

    Args:
        timing: The sensor, for the whole stack.
        window: The window.
        frames: Those of its frames that are there.
    """
    if timing.frame_start_times is None and frames == list(window.frames):
        return timing
    starts = timing.frame_starts(window.last + 1)
    chosen = starts[torch.tensor(frames)] - starts[window.first]
    return SensorTiming(
        timing.row_time,
        timing.exposure_rows,
        timing.frame_rows,
        timing.scan_axis,
        timing.readout_direction,
        chosen,
    )
