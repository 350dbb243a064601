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

from rsvib_torch.io.formats import StackFormat, register_format
from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = ["open_video"]


@contextmanager
def _silent() -> Iterator[None]:
    """The decoder's own messages are kept off the terminal."""
    level = cv2.utils.logging.getLogLevel()
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _opened(path: Path) -> Any:
    with path.open("rb"):
        pass  # a file that may not be read is an OSError of its own
    with _silent():
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not video.isOpened():
            video.release()
            raise ValueError(f"{path}: not a readable video")
    return video


def _playback_times(path: Path) -> list[float]:
    """When each frame that can be decoded is to be shown, in seconds: containers only estimate their number."""
    video = _opened(path)
    times = []
    with _silent():
        promised = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        while video.grab():
            times.append(1e-3 * float(video.get(cv2.CAP_PROP_POS_MSEC)))
        video.release()
    count = len(times)
    if count == 0:
        raise ValueError(f"{path}: no frame of the video can be read")
    if count < promised - max(1, promised // 10):
        raise ValueError(f"{path}: truncated: {count} of {promised} frames can be read")
    return times


class VideoReader:
    """Frames (3, H, W), uint8 RGB, of a video: always three channels, grey videos too.

    Frames are decoded one after another; going back starts over.
    """

    def __init__(self, path: Path) -> None:
        self._path, times = path, _playback_times(path)
        self._video: Any = _opened(path)
        self._next = 0
        height, width = (int(self._video.get(key)) for key in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH))
        rising = all(0.0 <= a < b < math.inf for a, b in itertools.pairwise(times))
        self.info = StackInfo(
            (len(times), 3, height, width),
            "uint8",
            255.0,
            tuple(times) if rising and len(times) > 1 else None,
            channels_last=True,
            times_of_playback=True,
        )

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame."""
        with _silent():
            if index < self._next:
                self._video.release()
                self._video, self._next = _opened(self._path), 0
            while self._next < index and self._video.grab():
                self._next += 1
            pixels = self._video.read()[1] if self._next == index else None
        if pixels is None:
            raise FrameError(f"{self._path}: frame {index} cannot be decoded")
        self._next += 1
        if pixels.shape != (*self.info.shape[2:], 3):
            raise FrameError(f"{self._path}: frames of different size: frame {index} is {pixels.shape[:2]}")
        return np.ascontiguousarray(np.moveaxis(pixels[..., ::-1], -1, 0))

    def close(self) -> None:
        """Let go of the file."""
        self._video.release()


def open_video(path: Path) -> VideoReader:
    """Open a video and count its frames."""
    return VideoReader(path)


register_format(StackFormat("video", (".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm"), open_video))
