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
from rsvib_torch.registration.corners import Grey, eight_bits, find_corners, follow_corners, rows_of_points

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
        residual = (self.offsets - middle[index]).abs()
        near = (residual < 5 * 1.4826 * residual.median(0).values.clamp(min=0.1)).all(-1)
        return near[:, None, None] * torch.eye(2, dtype=residual.dtype)


def corner_tracks(
    frames: Iterable[tuple[int, Tensor, Tensor | None]], starts: Sequence[float], timing: SensorTiming
) -> CornerTracks:
    """Follow the corners of frames to the next ones.

    Frames are given with their number, as grey pixels (H, W) in image axes, and with a mask (H, W), False at missing
    pixels, or None; their exposures start at ``starts`` in s. A frame is compared with the one before if their numbers
    follow each other. Refused are frames of which fewer than half of the pairs have enough corners.
    """
    levels: Array | None = None
    before: tuple[int, Grey, Grey | None] | None = None
    pairs: dict[int, Array] = {}
    for number, frame, valid in frames:
        values = frame.cpu().numpy()
        if levels is None:  # the same for all frames, so that places keep their grey level
            levels = np.percentile(values, (0.1, 99.9))
        grey, mask = eight_bits(values, levels), None if valid is None else _inner(valid)
        if before is not None and before[0] == number - 1:
            pairs[number - 1] = followed_pair(before[1], grey, (before[2], mask))
        before = number, grey, mask
    return tracks_of_pairs(pairs, starts, timing, (0, 0) if before is None else before[1].shape)


def followed_pair(first: Grey, second: Grey, masks: tuple[Grey | None, Grey | None] = (None, None)) -> Array:
    """Places (N, 2, 2) px, (x, y) of corners in a grey frame (H, W) and in the next one, none where a mask (H, W) is 0.

    Every frame has its own corners, whose errors are independent of those before.
    """
    corners = find_corners(first, _MOST_CORNERS, mask=masks[0])
    ends, good = follow_corners(first, second, corners)
    points = np.stack([corners, ends], 1)[good]
    if masks[1] is None:
        return points
    x, y = points[:, 1].round().astype(np.int64).T
    return points[masks[1][y, x] > 0]


def tracks_of_pairs(
    followed: Mapping[int, Array], starts: Sequence[float], timing: SensorTiming, size: tuple[int, int]
) -> CornerTracks:
    """The corners (``followed_pair``) of frames (height, width) = ``size``, by the number of the earlier frame.

    The exposures of all frames start at ``starts`` in s. Refused as in ``corner_tracks``.
    """
    if not followed:
        raise ValueError("no two different frames follow each other")
    counts = np.array([*map(len, followed.values())])
    enough = counts >= _LEAST_CORNERS
    if enough.mean() < 0.5:
        raise ValueError(
            f"only {enough.sum()} of {len(counts)} pairs of frames have {_LEAST_CORNERS} corners that can be followed: "
            "the frames have too little detail, or show different scenes"
        )
    used = np.repeat(enough, counts)
    pair, points = np.repeat(np.arange(len(counts)), counts)[used], np.concatenate([*followed.values()])[used]
    sides = np.array(size[::-1])
    place = points[:, 0] - 0.5 * (sides - 1)
    cells = np.floor((place / sides + 0.5) * [CELL_COLUMNS, CELL_ROWS]).astype(np.int64)
    return CornerTracks(
        pair=torch.from_numpy(pair),
        cell=torch.from_numpy(cells @ [1, CELL_COLUMNS]),
        rows=tensor(rows_of_points(points, timing, size)),
        place=tensor(place),
        offsets=tensor(points[:, 1] - points[:, 0]),
        starts=tensor(np.array([[starts[number], starts[number + 1]] for number in followed])),
        size=size,
        exposure_time=timing.exposure_time,
    )


def _inner(valid: Tensor) -> NDArray[np.uint8]:
    """Pixels (H, W) around which no pixel of the patch that is compared is missing."""
    side = 2 * _BORDER + 1
    return cv2.erode(valid.cpu().numpy().astype(np.uint8), np.ones((side, side)), borderValue=1).astype(np.uint8)
