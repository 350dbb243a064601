"""Corners followed from frame to frame, by OpenCV: for motions that vary over the frame, such as roll and parallax."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]  # (N, 2) px, (x, y) from the middle of the first pixel

_CELLS = 6  # of the shorter side: every cell has the same number of corners, so that one object does not hold them all
_QUALITY = 0.01  # of the best corner of a cell, below which there is none
PATCH = 11  # px, side of the patch that is compared; 21 px blur the motion of the rows, with 1.7 times the residuals
_COARSE = 21  # px, side of the patch in the pyramid, where the motion is found
_LARGEST_MOTION = 0.25  # of the longer side, which the coarsest level of the pyramid reaches
_MAX_RETURN = 0.3  # px, between a corner and the point where the way back from the other frame ends


def find_corners(
    grey: NDArray[np.uint8], known: Points | None = None, mask: NDArray[np.uint8] | None = None, *, most: int
) -> Points:
    """The known corners (N, 2) of a frame (H, W), and new ones where a cell has less than half of its number.

    All cells of the frame have the same number; together, they have at most ``most`` corners. There are none where the
    mask (H, W) is 0.
    """
    height, width = grey.shape
    side = min(height, width) / _CELLS
    rows, columns = max(1, round(height / side)), max(1, round(width / side))
    number = -(-most // (rows * columns))
    distance = max(3.0, 0.5 * side / math.sqrt(number))
    known = np.zeros((0, 2)) if known is None else known
    cells = np.floor(known / [width / columns, height / rows]).astype(int) @ [1, columns]
    filled = np.bincount(cells, minlength=rows * columns).reshape(rows, columns)
    corners = [known]
    for row, column in zip(*np.nonzero(filled <= number // 2), strict=True):
        top, left = row * height // rows, column * width // columns
        part = slice(top, (row + 1) * height // rows), slice(left, (column + 1) * width // columns)
        inner = None if mask is None else np.ascontiguousarray(mask[part])
        found = cv2.goodFeaturesToTrack(grey[part], number, _QUALITY, distance, mask=inner)
        if found is not None:
            places = found[:, 0].astype(np.float64) + np.array([left, top])
            apart = np.abs(places[:, None] - known).max(-1).min(-1, initial=np.inf) >= distance
            corners.append(places[apart][: number - filled[row, column]])
    return np.concatenate(corners)


def follow_corners(
    first: NDArray[np.uint8], second: NDArray[np.uint8], corners: Points
) -> tuple[Points, NDArray[np.bool_]]:
    """Places (N, 2) of the corners of the first frame in the second, and whether (N) the way back ends at the corner.

    Pyramids of Lucas and Kanade (``cv2.calcOpticalFlowPyrLK``).
    """
    if not len(corners):
        return corners, np.zeros(0, bool)
    levels = max(1, math.ceil(math.log2(_LARGEST_MOTION * max(first.shape) / _COARSE)) + 1)
    start = corners.astype(np.float32)[:, None]
    coarse, fine = (_COARSE, _COARSE), (PATCH, PATCH)
    end, there, _ = cv2.calcOpticalFlowPyrLK(first, second, start, start.copy(), winSize=coarse, maxLevel=levels)
    guess = cv2.OPTFLOW_USE_INITIAL_FLOW
    end, again, _ = cv2.calcOpticalFlowPyrLK(first, second, start, end, winSize=fine, maxLevel=0, flags=guess)
    back, return_, _ = cv2.calcOpticalFlowPyrLK(second, first, end, start.copy(), winSize=fine, maxLevel=0, flags=guess)
    returned = np.abs(back - start).max((1, 2)) < _MAX_RETURN
    inside = ((end[:, 0] >= 0) & (end[:, 0] <= np.array(first.shape[::-1]) - 1)).all(1)
    good = returned & inside & (there[:, 0] == 1) & (again[:, 0] == 1) & (return_[:, 0] == 1)
    return end[:, 0].astype(np.float64), good
