"""Steady videos: every frame is moved to the mean of the path around it."""

from collections import deque
from collections.abc import Iterator
from typing import Protocol, Self, TypeVar

import torch
from torch import Tensor

_ROUNDING = 1e-6  # s, of frame times


class PlacedFrame(Protocol):
    """A frame whose place on the path is known, such as ``TrackedFrame``."""

    @property
    def time(self) -> float:
        """Exposure start of its first row in s."""

    @property
    def path(self) -> Tensor:
        """Place (2,) on the path in px; NaN if it is not known."""

    def moved_to(self, place: Tensor) -> Self:
        """The frame with its content at another place."""


Placed = TypeVar("Placed", bound=PlacedFrame)
Item = TypeVar("Item")


def steadied(frames: Iterator[tuple[Placed, Item]], duration: float) -> Iterator[tuple[Placed, Item]]:
    """Frames moved to the mean of the path over ``duration`` s around them, so that slow motion is kept.

    Near both ends of the video the interval is shorter, and stays symmetric. Frames without path stay.

    Args:
        frames: Tracked frames in order, each with anything that belongs to it.
        duration: s; 0: all frames stay.

    Yields:
        The frames, as soon as those half of ``duration`` behind them are known.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=8)
        >>> tracker = rsv.VibrationTracker(timing, window=4, wobble=True)
        >>> tracked = ((tracker.update(frame), number) for number, frame in enumerate(frames))
        >>> [number for _, number in steadied(tracked, 0.05)]
        [0, 1, 2, 3, 4, 5, 6, 7]
    """
    if duration == 0:
        yield from frames
        return
    around: deque[Placed] = deque()  # frames whose place counts for those to yield
    items: deque[Item] = deque()  # what belongs to the frames to yield
    half = 0.5 * duration

    def interval() -> float:
        return (around[-1].time - around[0].time) / max(len(around) - 1, 1) or 1.0

    def placed() -> tuple[Placed, Item]:
        frame, paths = around[len(around) - len(items)], torch.stack([other.path for other in around])
        known = torch.isfinite(paths).all(1)
        if not bool(torch.isfinite(frame.path).all()):
            return frame, items.popleft()
        # the same distance on both sides, so that a uniform motion is kept at the ends as well
        reach = min(half, frame.time - around[0].time, around[-1].time - frame.time)
        distances = paths.new_tensor([abs(other.time - frame.time) for other in around])
        # a frame stands for the time of one interval; half of it counts at the end of the time around the frame
        weights = ((reach - distances) / interval() + 0.5).clamp(0.0, 1.0)[known]
        return frame.moved_to((weights[:, None] * paths[known]).sum(0) / weights.sum()), items.popleft()

    for latest, item in frames:
        around.append(latest)
        items.append(item)
        while len(items) > 1 and (around[len(around) - len(items)].time + half + interval() <= latest.time + _ROUNDING):
            yield placed()
        while around[0].time < around[len(around) - len(items)].time - half - 2.0 * interval():
            around.popleft()
    while items:
        yield placed()
