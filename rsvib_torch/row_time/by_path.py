"""Row time from the path of a camera that a hand holds or that flies, by corners that are followed.

Each row of a frame shows the path of the camera at another time. At the right row time, one smooth path explains the
displacements of the corners in all rows; at other row times it leaves more of them. The path has roll and zoom, and
corners that move by themselves have little weight (``tracking.window_fit``), so that frames with parallax can be used.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.prepare import GreyFrames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import CornerFollower, Corners, eight_bits
from rsvib_torch.row_time.by_tones import CameraClock, RowTimeFit
from rsvib_torch.tracking.window_fit import ROUNDS, WindowFit, WindowPath, averaging, fit_window

_MAX_STD = 0.05  # of the row time; a twentieth of what the rows are displaced by remains in restored frames
_ROUGH = 0.25  # of the row time, standard deviation up to which a result is stated
_MIN_PAIRS, _MOST_FRAMES = 20, 192  # of frames that are compared
_PARTS = 12  # of consecutive pairs, whose scatter gives the standard deviation
_GRID_RATIO = 1.29  # between neighbouring row times of the search
_WIDTHS = 0.25, 0.12, 0.12  # of the row time, range of the parabolas that are fitted one after the other
# of the row time: beside their scatter, estimates from clips of a hand were wrong by 1 % without, and by up to 4 % with
# nearer content on a third of the frame that sways by 3 px
_SYSTEMATIC = 0.02
# Squares that a path leaves without a readout, over those at the row time: 1.2 to 1.4 of a phone behind a windscreen,
# 1.03 of a drone, whose row time was 44 to 76 us in parts of its flight. Where tones are found beside the path, 16
# recordings of tones alone have 1.04 to 2.5, and wrong row times; 9 of a hand 70 to 1000
_MIN_CONTRAST, _MIN_CONTRAST_BESIDE_TONES = 1.15, 4.0


@dataclass(frozen=True, eq=False)
class _FollowedCorners:
    """Corners between the frames of one stack, which can be timed by any row time."""

    corners: Corners
    starts: Array  # (N, 2) s, of the frames
    rows: Array  # (N, 2) rows from the middle of the frame
    clock: CameraClock
    size: tuple[int, int]  # (rows, columns)
    groups: list[list[NDArray[np.int64]]]  # (3, P) corners of each pair, and of both halves of it

    def timed(self, row_time: float) -> Corners:
        """The corners with the times of a row time in s, negative for a reverse readout."""
        return replace(self.corners, times=self.starts + self.rows * row_time)

    def _averaged(self, row_time: float) -> tuple[float, float]:
        return averaging(self.clock.exposure_time or 0.0, abs(row_time), self.size)

    def squares(self, row_time: float, tones: Sequence[tuple[int, float]]) -> Array:
        """(3, P) px^2, square of the median residual of the corners of each pair of frames, and of both halves of it.

        It is left by a path and ``tones``, of which axis and frequency in Hz are given.
        """
        fit = WindowFit(self.timed(row_time), self.clock.period, self._averaged(row_time))
        fit.add_tones(tones)
        fit.solve(ROUNDS)
        return np.array([[np.median(fit.distance[part]) for part in parts] for parts in self.groups]) ** 2

    def window(self, row_time: float) -> WindowPath:
        """The path and the tones at a row time."""
        timed, readout = self.timed(row_time), self.size[0] * abs(row_time)
        return fit_window(timed, self.clock.period, self._averaged(row_time), readout).path()

    def minimum(self, row_time: float, tones: Sequence[tuple[int, float]]) -> tuple[float, float] | None:
        """Row time near a first one at which least is left, and its standard deviation, in s; None without one."""
        std = math.inf
        for width in _WIDTHS:
            change = width * np.linspace(-1.0, 1.0, 5)
            squares = np.stack([self.squares(row_time * (1.0 + one), tones) for one in change])
            # of all pairs, without one part of them after the other (jackknife), and of the halves of the frames
            parts = np.array_split(np.arange(squares.shape[-1]), _PARTS)
            without = [np.delete(squares[:, 0], part, -1).mean(-1) for part in parts]
            bent, slope, _ = np.polyfit(change, np.stack([*squares.mean(-1).T, *without], 1), 2)
            if (bent[[0, *range(3, len(bent))]] <= 0).any():
                return None
            lowest = np.clip(-0.5 * slope / np.where(bent > 0, bent, np.inf), -2.0 * width, 2.0 * width)
            (place, *halves), places = np.split(np.where(bent > 0, lowest, lowest[0]), [3])
            # The parts contain the errors that neighbouring pairs share, and the halves those by parallax.
            std = math.hypot(math.sqrt((_PARTS - 1) * places.var()), 0.5 * (halves[1] - halves[0]), _SYSTEMATIC)
            row_time, std = row_time * (1.0 + float(place)), abs(row_time) * std
        return row_time, std


def row_time_of_path(stack: GreyFrames, clock: CameraClock) -> RowTimeFit | None:
    """Row time from the path of the camera; None if the frames do not show it, or tones explain them as well."""
    followed = _followed(stack, clock)
    if followed is None:
        return None
    # 1. What the path leaves over a grid of row times.
    count = 1 + max(1, math.ceil(math.log(clock.high / clock.low) / math.log(_GRID_RATIO)))
    sizes = np.geomspace(clock.low, clock.high, count)
    grid = [direction * float(size) for direction in clock.directions for size in sizes]
    advance, left = steps(len(grid), "row times"), list[float]()
    for tried in grid:
        left.append(float(followed.squares(tried, ())[0].mean()))
        advance()
    # 2. The lowest minimum, if the readout explains what the path leaves without one: parallax leaves as much at any
    # row time, and so do tones, unless a hand moves the rows by more.
    found = followed.minimum(grid[int(np.argmin(left))], ())
    if found is None or found[1] > _ROUGH * abs(found[0]):
        return None
    window = followed.window(found[0])
    contrast = followed.squares(0.0, ())[0].mean() / followed.squares(found[0], ())[0].mean()
    least = _MIN_CONTRAST_BESIDE_TONES if window.tones else _MIN_CONTRAST
    if contrast < least:
        return None
    if window.tones:
        found = followed.minimum(found[0], [(tone.axis, tone.frequency) for tone in window.tones])
        if found is None:
            return None
    row_time, std = found
    nearest = math.copysign(min(max(abs(row_time), clock.low), clock.high), row_time)
    if abs(nearest - row_time) > 2.0 * std:
        return None
    return RowTimeFit(nearest, std, permitted=_MAX_STD)


def _followed(stack: GreyFrames, clock: CameraClock) -> _FollowedCorners | None:
    """The corners between the frames of one stack; None with too few pairs of frames."""
    if stack.images.shape[1] <= _MIN_PAIRS:
        return None
    images = stack.images[0, :_MOST_FRAMES].cpu().numpy()
    size = images.shape[1], images.shape[2]
    row_time = clock.period / size[0]
    follower = CornerFollower(SensorTiming(row_time, 1.0, size[0]))
    levels = np.percentile(images[0], (0.1, 99.9))
    pairs, starts = list[Corners](), list[Array]()
    for number, image in enumerate(images):
        pair = follower.next(eight_bits(image, levels), number * clock.period)
        if pair is None:
            continue
        if stack.valid is not None:
            x, y = (pair.places + 0.5 * (np.array(size[::-1]) - 1)).round().astype(np.int64).T
            measured = stack.valid[0, number].cpu().numpy()[y, x]
            pair = Corners(*(values[measured] for values in vars(pair).values()))
        pairs.append(pair)
        starts.append(np.broadcast_to(clock.period * np.array([number - 1.0, number]), pair.times.shape))
    if len(pairs) < _MIN_PAIRS:
        return None
    corners, of_frames = Corners.joined(pairs), np.concatenate(starts)
    rows = (corners.times - of_frames) / row_time - 0.5 - 0.5 * (size[0] - 1)
    sides = corners.places[:, 0] < np.median(corners.places[:, 0])
    groups = [
        [np.flatnonzero(part & (corners.pairs == pair)) for pair in range(len(pairs))]
        for part in (np.ones_like(sides), sides, ~sides)
    ]
    if min(map(len, itertools.chain(*groups))) == 0:
        return None
    return _FollowedCorners(corners, of_frames, rows, clock, size, groups)
