"""Stacks in video files, read through OpenCV."""

import itertools
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.formats import StackFormat
from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = ["FORMAT"]


@contextmanager
def _silent() -> Iterator[None]:
    """Suppress messages that the decoder writes to the terminal."""
    level = cv2.utils.logging.getLogLevel()
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _open_decoder(path: Path) -> Any:
    with path.open("rb"):
        pass  # a file that cannot be opened is an OSError
    with _silent():
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not video.isOpened():
            video.release()
            raise ValueError(f"{path}: not a readable video")
    return video


def _playback_times(path: Path) -> list[float]:
    """Presentation time in seconds of every frame that can be decoded; containers state their number only roughly."""
    video = _open_decoder(path)
    times = []
    with _silent():
        stated = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        while video.grab():
            times.append(1e-3 * float(video.get(cv2.CAP_PROP_POS_MSEC)))
        video.release()
    if not times:
        raise ValueError(f"{path}: no frame of the video can be decoded")
    if len(times) < stated - max(1, stated // 10):
        raise ValueError(f"{path}: truncated: {len(times)} of {stated} frames can be decoded")
    return times


class _VideoReader:
    """Frames (3, H, W), uint8 RGB, of a video, also of grey ones.

    Frames are decoded in sequence; reading an earlier frame starts again at the beginning.
    """

    def __init__(self, path: Path) -> None:
        self._path, times = path, _playback_times(path)
        self._video, self._next = _open_decoder(path), 0
        height, width = (int(self._video.get(key)) for key in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH))
        rising = len(times) > 1 and all(0.0 <= a < b < math.inf for a, b in itertools.pairwise(times))
        self.info = StackInfo(
            (len(times), 3, height, width),
            "uint8",
            255.0,
            tuple(times) if rising else None,
            channels_last=True,
            times_of_playback=True,
        )

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame."""
        with _silent():
            if index < self._next:
                self._video.release()
                self._video, self._next = _open_decoder(self._path), 0
            while self._next < index and self._video.grab():
                self._next += 1
            pixels = self._video.read()[1] if self._next == index else None
        if pixels is None:
            raise FrameError(f"{self._path}: frame {index} cannot be decoded")
        self._next += 1
        if pixels.shape != (*self.info.shape[2:], 3):
            raise FrameError(f"{self._path}: frames of different size: frame {index} is {pixels.shape[:2]}")
        return np.ascontiguousarray(np.moveaxis(pixels[..., ::-1], -1, 0))  # OpenCV decodes to BGR

    def close(self) -> None:
        """Close the file."""
        self._video.release()


FORMAT = StackFormat("video", (".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm"), _VideoReader)
