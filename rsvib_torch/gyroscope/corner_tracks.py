"""Corners that are followed between consecutive frames, with the times at which their rows were exposed."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array, tensor
from rsvib_torch.registration.corners import CornerFollower, Corners, Grey, eight_bits

CELL_ROWS, CELL_COLUMNS = 6, 8  # cells of a frame, in which residuals may be alike
_MOST_CORNERS = 480  # of a pair of frames
_LEAST_CORNERS = 12  # of a pair of frames; 3 angles and 3 components of a translation are fitted to each
_BORDER = 11  # px, half of the patch that OpenCV compares, in which no pixel may be missing


@dataclass(frozen=True, eq=False)
class CornerTracks:
    """M corners of P pairs of consecutive frames, on the CPU in float64, in image axes."""

    pair: Tensor  # (M,) index of the pair of frames, ascending
    cell: Tensor  # (M,) index of the cell of the frame
    rows: Tensor  # (M, 2) row times from the first rows of both frames to the rows of the corner
    place: Tensor  # (M, 2) px from the centre of the frame, (x, y) in the earlier frame
    offsets: Tensor  # (M, 2) px, (x, y)
    starts: Tensor  # (P, 2) s, exposure starts of the first rows of both frames of each pair
    size: tuple[int, int]  # (height, width) of the frames in px
    exposure_time: float  # s

    @property
    def radius(self) -> float:
        """Root-mean-square distance of the pixels from the centre in px."""
        height, width = self.size
        return float((height**2 + width**2 - 2) / 12) ** 0.5

    def times(self, row_time: float, part: float = 0.5) -> Tensor:
        """(M, 2) s, in the exposures of the corners in both frames, of which a ``part`` 0 ... 1 is over."""
        return self.starts[self.pair] + self.rows * row_time + part * self.exposure_time

    def roughly(self) -> Tensor:
        """(M, 2, 2) information for a start: 1 for displacements near the median of their pair, and 0."""
        used, index = self.pair.unique(return_inverse=True)
        middle = torch.stack([self.offsets[self.pair == pair].median(0).values for pair in used])
        rest = (self.offsets - middle[index]).abs()
        near = (rest < 5 * 1.4826 * rest.median(0).values.clamp(min=0.1)).all(-1)
        return near[:, None, None] * torch.eye(2, dtype=rest.dtype)


def corner_tracks(
    frames: Iterable[tuple[int, Tensor, Tensor | None]], starts: Sequence[float], timing: SensorTiming
) -> CornerTracks:
    """Follow the corners of frames to the next ones.

    Frames are given with their number, as grey pixels (H, W) in image axes, and with a mask (H, W), False at missing
    pixels, or None; their exposures start at ``starts`` in s. A frame is compared with the one before if their numbers
    follow each other. Refused are frames of which fewer than half of the pairs have enough corners.
    """
    follower = CornerFollower(timing, most=_MOST_CORNERS, consistent=False)
    levels: Array | None = None
    size, before = (0, 0), -2
    pairs: dict[int, Corners] = {}
    for number, frame, valid in frames:
        values = frame.cpu().numpy()
        if levels is None:  # the same for all frames, so that places keep their grey level
            levels, size = np.percentile(values, (0.1, 99.9)), (values.shape[0], values.shape[1])
        grey = eight_bits(values, levels)
        followed = follower.next(grey, starts[number], None if valid is None else _inner(valid))
        if followed is not None and before == number - 1:
            pairs[before] = followed
        before = number
    return tracks_of_pairs(pairs, starts, timing, size)


def followed_pair(first: Grey, second: Grey, starts: Sequence[float], timing: SensorTiming) -> Corners:
    """Corners between two grey frames (H, W), whose exposures start at ``starts`` (2,) in s."""
    follower = CornerFollower(timing, most=_MOST_CORNERS, consistent=False)
    follower.next(first, starts[0])
    followed = follower.next(second, starts[1])
    assert followed is not None
    return followed


def tracks_of_pairs(
    followed: Mapping[int, Corners], starts: Sequence[float], timing: SensorTiming, size: tuple[int, int]
) -> CornerTracks:
    """The corners of pairs of frames (height, width) = ``size``, by the number of the earlier frame.

    The exposures of all frames start at ``starts`` in s. Refused as in ``corner_tracks``.
    """
    if not followed:
        raise ValueError("no two different frames follow each other")
    pairs = list(followed.values())
    enough = np.array([len(pair.rows) >= _LEAST_CORNERS for pair in pairs])
    if enough.mean() < 0.5:
        raise ValueError(
            f"only {enough.sum()} of {len(pairs)} pairs of frames have {_LEAST_CORNERS} corners that can be followed: "
            "the frames have too little detail, or show different scenes"
        )
    (height, width), corners = size, Corners.joined(pairs)
    used = enough[corners.pairs]
    pair, offsets, times = corners.pairs[used], corners.offsets[used], corners.times[used]
    place = corners.places[used] - 0.5 * offsets
    of_pairs = np.array([[starts[number], starts[number + 1]] for number in followed])
    cells = np.floor((place / [width, height] + 0.5) * [CELL_COLUMNS, CELL_ROWS]).astype(np.int64)
    return CornerTracks(
        pair=torch.from_numpy(pair),
        cell=torch.from_numpy(cells @ [1, CELL_COLUMNS]),
        rows=tensor((times - of_pairs[pair] - 0.5 * timing.exposure_time) / timing.row_time),
        place=tensor(place),
        offsets=tensor(offsets),
        starts=tensor(of_pairs),
        size=size,
        exposure_time=timing.exposure_time,
    )


def _inner(valid: Tensor) -> NDArray[np.uint8]:
    """Pixels (H, W) around which no pixel of the patch that is compared is missing."""
    side = 2 * _BORDER + 1
    return cv2.erode(valid.cpu().numpy().astype(np.uint8), np.ones((side, side)), borderValue=1).astype(np.uint8)
