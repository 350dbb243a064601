"""The path of a camera whose frames come one by one, and the displacement of each frame in a steady image.

The path is that of corners in the last frames, fitted as that of a file (``window_fit``): roll, zoom, a heel that
strikes, and a person who crosses are not mistaken for a motion of the rows, and tones need not be known.

Invariant: the displacement depends on the row only (docs/architecture.md); roll and zoom are measured beside it.
"""

import math
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self

import numpy as np

from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.tables import Array, table, tensor
from rsvib_torch.registration.corners import CornerFollower, Corners, Grey, repetition
from rsvib_torch.tracking.window_fit import ROUNDS, WindowFit

# Pairs of frames, and corners of each, in which the path is fitted. Steps of five clips were wrong by 0.02 to 0.05 px
# rms, of one that a person crosses by 0.07 and 0.16 px; with twice the pairs, or 256 corners, by as much
_PAIRS, _CORNERS = 2, 96
_LONGEST = 12  # frame periods, over which frames are compared
# frames, after which the scene is looked at for repetitions, which takes 20 ms. A fence, whose path is not known from
# corners, shook by 0.79 and 0.90 px instead of 0.30 and 0.86 px
_LOOKED_AT = 32

_zeros = partial(np.zeros, 2)


@dataclass(frozen=True, eq=False)
class LivePath:
    """The path so far, and the displacement of the last frame in the steady image; in image axes."""

    timing: SensorTiming
    follower: CornerFollower  # a step changes a copy of it
    pairs: tuple[Corners, ...] = ()  # of the last frames, without the tones that are removed; none if it is not known
    followed_frames: int = 0  # so far
    repeats: bool = False  # whether the scene repeats itself, such as a fence: corners do not show its path
    middle: float = math.nan  # s, of the last frame
    place: Array = field(default_factory=_zeros)  # (2,) px, there; where the path is lost, that of the frame before
    rates: Array = field(default_factory=partial(np.zeros, (2, 2)))  # px/s and px/s^2 of x and y, there
    places: tuple[Array, ...] = ()  # (3,) time, x and y of the frames that the steady image follows
    shift: Array = field(default_factory=_zeros)  # (2,) px, of the last frame
    held: Array = field(default_factory=_zeros)  # (2,) px, part of it that is left from before the path was known

    @classmethod
    def started(cls, timing: SensorTiming) -> Self:
        """The path before the first frame."""
        return cls(timing, CornerFollower(timing, most=_CORNERS))

    def followed(self, grey: Grey, start: float, removed: Vibration) -> Self:
        """The path to the next frame (H, W), exposed from ``start`` in s; removed tones count from its middle."""
        middle = start + self.timing.time_to_middle(grey.shape[int(self.timing.scan_axis)])
        follower, exposure_time = copy(self.follower), self.timing.exposure_time
        corners = follower.next(grey, start)
        # 1. The last pairs of frames, without the tones. Frames without a scene in common begin a new path, and where
        # the scene repeats itself, the path is not known.
        repeats = self.repeats if self.followed_frames % _LOOKED_AT else repetition(grey) is not None
        pairs = self.pairs
        if corners is None or repeats:
            pairs = ()
        else:
            tones = replace(removed.scaled(0.0), amplitude=removed.amplitude)
            shift = tones.mean_displacement(tensor(corners.times - middle - 0.5 * exposure_time), exposure_time)
            pairs = (*pairs, replace(corners, offsets=corners.offsets - np.diff(table(shift), axis=1)[:, 0]))[-_PAIRS:]
            longest = _LONGEST * self.timing.frame_period
            pairs = tuple(pair for pair in pairs if middle - pair.times.min() < longest)
        path = replace(
            self,
            follower=follower,
            followed_frames=self.followed_frames + 1,
            repeats=repeats,
            pairs=pairs,
            middle=middle,
            rates=np.zeros((2, 2)),
        )
        if not pairs:
            return path
        # 2. The path through them: the step from the frame before, and how the rows are displaced.
        # The layer counts always, because no tones move its rows apart; where a person covers half of a frame, what
        # explains more of all corners is the person in some frames.
        joined = Corners.joined(pairs)
        fit = WindowFit(joined, self.timing.frame_period, (0.0, 0.0))
        fit.layer, fit.weights = joined.layer, joined.layer.astype(np.float64)
        fit.solve(ROUNDS)
        window = fit.path()
        step = np.diff(window.path(np.array([self.middle, middle])), axis=0)[0, :2]
        rates = np.stack([window.path(np.array([middle]), order)[0, :2] for order in (1, 2)])
        return replace(path, place=self.place + step, rates=rates)

    def steadied(self, step: float, duration: float) -> Self:
        """The path with the displacement of the last frame, a ``step`` behind the frame before, in s.

        It leads from the place of the frame to a straight line through the last ``duration``. While the place is not
        known, and from where it is known again, the displacement of the frames before fades: nothing jumps.
        """
        fade = math.exp(-step / duration)
        if not self.pairs:
            return replace(self, places=(), shift=fade * self.shift, held=fade * self.shift)
        # Half a step, because rounding would decide whether a place a duration ago counts, and the image would shake.
        reached, first = (*self.places, np.array([self.middle, *self.place])), self.middle - duration + 0.5 * step
        places = tuple(one for one in reached if one[0] >= min(first, self.middle))
        line = np.polyfit(np.array(places)[:, 0] - self.middle, np.array(places)[:, 1:], min(len(places) - 1, 1))
        held = fade * self.held
        return replace(self, places=places, shift=self.place - line[-1] + held, held=held)
