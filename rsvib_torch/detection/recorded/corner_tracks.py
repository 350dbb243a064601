"""Corners that are followed between consecutive frames, with the times at which their rows were exposed."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.frames.orientation import offsets_from_row_order
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.registration.corners import find_corners, follow_corners

CELL_ROWS, CELL_COLUMNS = 6, 8  # cells of a frame, in which residuals may be alike
_MOST_CORNERS = 480  # of a pair of frames
_LEAST_CORNERS = 12  # of a pair of frames; 3 angles and 3 components of a translation are fitted to each
_Frame = tuple[NDArray[np.uint8], NDArray[np.uint8] | None]  # grey levels and the mask of usable pixels
_BORDER = 11  # px, half of the patch that OpenCV compares, in which no pixel may be missing


@dataclass(frozen=True, eq=False)
class CornerTracks:
    """M corners of P pairs of consecutive frames, on the CPU in float64, in image axes."""

    pair: Tensor  # (M,) index of the pair of frames, ascending
    cell: Tensor  # (M,) index of the cell of the frame
    starts: Tensor  # (M, 2) s, exposure starts of the first rows of both frames
    rows: Tensor  # (M, 2) row times from there to the rows of the corner, in both frames
    place: Tensor  # (M, 2) px from the centre of the frame, (x, y) in the earlier frame
    offsets: Tensor  # (M, 2) px, (x, y)
    num_pairs: int  # pairs of frames
    radius: float  # px, root-mean-square distance of the pixels from the centre

    def times(self, row_time: float) -> Tensor:
        """(M, 2) s, exposure starts of the corners in both frames."""
        return self.starts + self.rows * row_time

    def roughly(self) -> Tensor:
        """(M, 2, 2) information for a start: 1 for displacements near the median of their pair, and 0."""
        used, index = self.pair.unique(return_inverse=True)
        middle = torch.stack([self.offsets[self.pair == pair].median(0).values for pair in used])
        rest = (self.offsets - middle[index]).abs()
        near = (rest < 5 * 1.4826 * rest.median(0).values.clamp(min=0.1)).all(-1)
        return near[:, None, None] * torch.eye(2, dtype=rest.dtype)


def corner_tracks(frames: Iterable[tuple[Tensor, Tensor | None]], timing: SensorTiming) -> CornerTracks:
    """Follow the corners of every frame to the next one; two frames at a time are in memory.

    Args:
        frames: Grey frames (H, W) in row order, each with a mask of the valid pixels or None.
        timing: The sensor, in image axes.

    Raises:
        ValueError: If fewer than half of the pairs of frames have enough corners.
    """
    limits: NDArray[np.float64] | None = None
    before: _Frame | None = None
    columns: list[NDArray[np.float64]] = []
    count = 0
    for frame, valid in frames:
        pixels = frame.cpu().numpy()
        # The same scale for all frames, so that places keep their grey level.
        limits = np.percentile(pixels, (0.1, 99.9)) if limits is None else limits
        grey = (255 * np.clip((pixels - limits[0]) / max(limits[1] - limits[0], 1e-12), 0, 1)).round().astype(np.uint8)
        now = grey, None if valid is None else _inner(valid)
        if before is not None:
            found = _followed(before, now)
            columns.append(np.column_stack([np.full(len(found), count - 1), found]))
        before, count = now, count + 1
    table = np.concatenate(columns)
    height, width = grey.shape
    enough = np.bincount(table[:, 0].astype(np.int64), minlength=count - 1) >= _LEAST_CORNERS
    if enough.mean() < 0.5:
        raise ValueError(
            f"only {enough.sum()} of {count - 1} pairs of frames have {_LEAST_CORNERS} corners that can be followed: "
            "the frames have too little detail, or show different scenes"
        )
    values = torch.from_numpy(table[enough[table[:, 0].astype(np.int64)]])
    pair, place, later = values[:, 0].long(), values[:, 1:3], values[:, 3:5]
    starts = timing.in_row_order().frame_starts(count).cpu()
    centre = torch.tensor([width - 1, height - 1], dtype=torch.float64) / 2
    cells = (place / torch.tensor([width, height]) * torch.tensor([CELL_COLUMNS, CELL_ROWS])).long()
    return CornerTracks(
        pair=pair,
        cell=cells[:, 1] * CELL_COLUMNS + cells[:, 0],
        starts=torch.stack([starts[pair], starts[pair + 1]], -1),
        rows=torch.stack([place[:, 1], later[:, 1]], -1),
        place=offsets_from_row_order(place - centre, timing),
        offsets=offsets_from_row_order(later - place, timing),
        num_pairs=count - 1,
        radius=float((height**2 + width**2 - 2) / 12) ** 0.5,
    )


def _inner(valid: Tensor) -> NDArray[np.uint8]:
    """Pixels (H, W) around which no pixel of the patch that is compared is missing."""
    side = 2 * _BORDER + 1
    return cv2.erode(valid.cpu().numpy().astype(np.uint8), np.ones((side, side)), borderValue=1).astype(np.uint8)


def _followed(first: _Frame, second: _Frame) -> NDArray[np.float64]:
    """(N, 4) px, x and y of the corners in both frames."""
    start = find_corners(first[0], mask=first[1], most=_MOST_CORNERS)
    end, good = follow_corners(first[0], second[0], start)
    if second[1] is not None:
        x, y = end[good].round().astype(np.int64).T
        good[good] = second[1][y, x] > 0
    return np.concatenate([start[good], end[good]], -1)
