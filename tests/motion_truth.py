"""Observable and unobservable parts of the error of a motion (T, R, 2) of the rows of frames, in NumPy.

Scene row s appears at row r = s + Y(r) of a frame. A scene that is warped by w(s) gives the same frames as a
motion that is larger by w(s): w is not observable. Offsets between frames do not depend on w.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rms(values: Array) -> Array:
    return np.sqrt(np.nanmean(np.square(values), axis=tuple(range(values.ndim - 1))))


def interpolated(rows: Array, scene_rows: Array, values: Array) -> Array:
    """Values (R, A) of rows interpolated at other scene rows, NaN outside."""
    return np.stack([np.interp(scene_rows, rows, v, left=np.nan, right=np.nan) for v in values.T], axis=-1)


def offsets(motion: Array, first: int, later: int) -> Array:
    """Offsets (R, 2) of the rows of one frame to another frame for a motion (T, R, 2); NaN outside the frame."""
    rows = np.arange(motion.shape[1], dtype=float)
    scene_rows = rows - motion[first, :, 1]
    found = interpolated(rows - motion[later, :, 1], scene_rows, motion[later])
    return found - motion[first]


def offset_error(found: Array, truth: Array) -> Array:
    """RMS error of the offsets between all pairs of frames."""
    pairs = [(p, q) for p in range(len(truth)) for q in range(p + 1, len(truth))]
    return rms(np.stack([offsets(found, p, q) - offsets(truth, p, q) for p, q in pairs]))


def common_warp(error: Array, truth: Array) -> Array:
    """w at each row of each frame (T, R, 2): mean error over all frames at the same scene row."""
    rows = np.arange(error.shape[1], dtype=float)
    scene_rows = rows - truth[..., 1]
    wide = np.arange(np.floor(scene_rows.min()), np.ceil(scene_rows.max()) + 1)
    each = np.stack([interpolated(places, wide, e) for places, e in zip(scene_rows, error, strict=True)])
    mean = np.nansum(each, axis=0) / np.maximum(np.isfinite(each).sum(0), 1)
    return np.stack([interpolated(wide, places, mean) for places in scene_rows])
