"""The video stabiliser vidstab (PyPI), for comparison: features, optical flow, one similarity transform per frame.

It depends on ``opencv-python``, which must not replace the headless one, so that it is installed apart:
``pip install --no-deps --target FOLDER vidstab imutils progress``, and FOLDER in ``PYTHONPATH``.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["stabilised"]


def _stabiliser() -> Any:
    """A ``VidStab``; its last version (1.7.4) looks up names that OpenCV 5 has moved or removed."""
    import imutils  # noqa: PLC0415

    if not hasattr(cv2, "BRISK_create"):
        cv2.BRISK_create = None  # type: ignore[attr-defined]  # a detector that is not used here
    imutils.is_cv4 = lambda *_: True  # and later
    from vidstab import VidStab  # noqa: PLC0415

    return VidStab()


def stabilised(frames: NDArray[np.uint8], window: int = 30) -> NDArray[np.uint8]:
    """Frames (T, H, W) moved to the moving average over ``window`` frames; the first ``window`` results are missing."""
    stabiliser, results = _stabiliser(), []
    for frame in [*frames, *([None] * window)]:
        colours = None if frame is None else cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)
        moved = stabiliser.stabilize_frame(input_frame=colours, smoothing_window=window)
        if moved is not None:
            results.append(moved[..., 0])
    return np.stack(results[-len(frames) :])
