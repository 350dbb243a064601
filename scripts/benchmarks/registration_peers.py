"""Registration of row bands with OpenCV and scikit-image, one band after another.

Offsets are (x, y) in px, the displacement in the later frame minus that in the earlier one; NaN for a failed band.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.registration import phase_cross_correlation

Array = NDArray[np.float64]

SEARCH = 16  # px
_ECC_STEPS, _ECC_CHANGE = 50, 1e-4
_ECC_SMOOTHING = 5  # px; default size of the smoothing filter of findTransformECC


def by_skimage(frames: NDArray[np.float32], tops: Sequence[int], band_rows: int) -> Array:
    """Phase correlation; skimage returns the reverse displacement (y, x)."""
    shifts = [phase_cross_correlation(*frames[:, top : top + band_rows], upsample_factor=100)[0][::-1] for top in tops]
    return -np.stack(shifts)


def by_phase_correlate(frames: NDArray[np.float32], tops: Sequence[int], band_rows: int) -> Array:
    """``cv2.phaseCorrelate`` with a Hann window, on copies, because it may overwrite its inputs."""
    window = cv2.createHanningWindow((frames.shape[-1], band_rows), cv2.CV_32F)
    bands = [frames[:, top : top + band_rows].copy() for top in tops]
    return np.array([cv2.phaseCorrelate(*band, window)[0] for band in bands])


def _between(before: float, at: float, after: float) -> float:
    """Position of the maximum of the parabola through three values, between -1/2 and 1/2."""
    bend = before - 2.0 * at + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _window(frames: NDArray[np.float32], top: int, band_rows: int) -> tuple[NDArray[np.float32], int]:
    """The part of the later frame in which a band is searched for, and its first row."""
    first = max(0, top - SEARCH)
    return frames[1, first : top + band_rows + SEARCH], first


def _template(frames: NDArray[np.float32], top: int, band_rows: int) -> NDArray[np.float32]:
    return np.ascontiguousarray(frames[0, top : top + band_rows, SEARCH:-SEARCH])


def by_match_template(frames: NDArray[np.float32], tops: Sequence[int], band_rows: int) -> Array:
    """``cv2.matchTemplate`` (normalised correlation), and a parabola through its peak along either axis."""
    offsets = []
    for top in tops:
        window, first = _window(frames, top, band_rows)
        score = cv2.matchTemplate(window, _template(frames, top, band_rows), cv2.TM_CCOEFF_NORMED)
        y, x = np.unravel_index(int(score.argmax()), score.shape)
        if not (0 < x < score.shape[1] - 1 and 0 < y < score.shape[0] - 1):
            offsets.append((np.nan, np.nan))  # the maximum may be outside
            continue
        fine_x = _between(*score[y, x - 1 : x + 2].tolist())
        fine_y = _between(*score[y - 1 : y + 2, x].tolist())
        offsets.append((x + fine_x - SEARCH, y + fine_y + first - top))
    return np.array(offsets, dtype=float)


def by_ecc(frames: NDArray[np.float32], tops: Sequence[int], band_rows: int) -> Array:
    """``cv2.findTransformECC`` (translation), started from ``cv2.matchTemplate``; it does not converge from 0."""
    enough = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ECC_STEPS, _ECC_CHANGE)
    offsets = by_match_template(frames, tops, band_rows)
    for found, top in zip(offsets, tops, strict=True):
        window, first = _window(frames, top, band_rows)
        start = np.nan_to_num(found)
        warp = np.float32([[1, 0, start[0] + SEARCH], [0, 1, start[1] + top - first]])
        template = _template(frames, top, band_rows)
        try:
            warp = cv2.findTransformECC(template, window, warp, cv2.MOTION_TRANSLATION, enough, None, _ECC_SMOOTHING)[1]
        except cv2.error:  # no convergence
            found[:] = np.nan
            continue
        found[:] = warp[0, 2] - SEARCH, warp[1, 2] - (top - first)
    return offsets


PEERS: dict[str, Callable[[NDArray[np.float32], Sequence[int], int], Array]] = {
    "cv2.matchTemplate, parabola": by_match_template,
    "cv2.findTransformECC, from matchTemplate": by_ecc,
    "cv2.phaseCorrelate": by_phase_correlate,
    "skimage phase_cross_correlation": by_skimage,
}
