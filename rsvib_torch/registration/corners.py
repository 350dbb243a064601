"""Corners followed from frame to frame, by OpenCV: for motions that vary over the frame, such as roll and parallax."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]  # (N, 2) px, (x, y) from the middle of the first pixel

_CELLS = 6  # of the shorter side: every cell has the same number of corners, so that one object does not hold them all
_QUALITY = 0.01  # of the best corner of a cell, below which there is none
_WINDOW = 21  # px, side of the patch that is compared
_LARGEST_MOTION = 0.25  # of the longer side, which the coarsest level of the pyramid reaches
_MAX_RETURN = 0.3  # px, between a corner and the point where the way back from the other frame ends


def find_corners(grey: NDArray[np.uint8], most: int = 480, mask: NDArray[np.uint8] | None = None) -> Points:
    """At most ``most`` corners of a frame (H, W), distributed over cells of equal size."""
    height, width = grey.shape
    side = min(height, width) / _CELLS
    rows, columns = max(1, round(height / side)), max(1, round(width / side))
    distance = max(3.0, 0.5 * side / math.sqrt(most / (rows * columns)))
    corners = []
    for row in range(rows):
        for column in range(columns):
            top, left = row * height // rows, column * width // columns
            part = slice(top, (row + 1) * height // rows), slice(left, (column + 1) * width // columns)
            of_cell = cv2.goodFeaturesToTrack(
                grey[part],
                -(-most // (rows * columns)),
                _QUALITY,
                distance,
                mask=None if mask is None else np.ascontiguousarray(mask[part]),
            )
            if of_cell is not None:
                corners.append(of_cell[:, 0].astype(np.float64) + (left, top))
    return np.concatenate(corners) if corners else np.zeros((0, 2))


def follow_corners(
    first: NDArray[np.uint8], second: NDArray[np.uint8], corners: Points
) -> tuple[Points, NDArray[np.bool_]]:
    """Places (N, 2) of the corners of the first frame in the second, and whether (N) the way back ends at the corner.

    Pyramids of Lucas and Kanade (``cv2.calcOpticalFlowPyrLK``).
    """
    if not len(corners):
        return corners, np.zeros(0, bool)
    reach = _LARGEST_MOTION * max(first.shape)
    levels = max(1, math.ceil(math.log2(reach / _WINDOW)) + 1)
    options = {"winSize": (_WINDOW, _WINDOW), "maxLevel": levels}
    start = corners.astype(np.float32)[:, None]
    end, there, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **options)
    back, again, _ = cv2.calcOpticalFlowPyrLK(
        second, first, end, start.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options
    )
    returned = np.abs(back - start).max((1, 2)) < _MAX_RETURN
    inside = ((end[:, 0] >= 0) & (end[:, 0] <= np.array(first.shape[::-1]) - 1)).all(1)
    good = returned & inside & (there[:, 0] == 1) & (again[:, 0] == 1)
    return end[:, 0].astype(np.float64), good
