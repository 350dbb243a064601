"""Stacks in video files, read through OpenCV."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsvib_torch.stacks.formats import StackFormat, register_format
from rsvib_torch.stacks.info import FrameError, StackInfo

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


def _count(path: Path) -> int:
    """Frames that can be decoded: containers only estimate their number."""
    video = _opened(path)
    with _silent():
        promised, count = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0
        while video.grab():
            count += 1
        video.release()
    if count == 0:
        raise ValueError(f"{path}: no frame of the video can be read")
    if count < promised - max(1, promised // 10):
        raise ValueError(f"{path}: truncated: {count} of {promised} frames can be read")
    return count


class VideoReader:
    """Frames (3, H, W), uint8 RGB, of a video: always three channels, grey videos too.

    Frames are decoded one after another; going back starts over.
    """

    def __init__(self, path: Path) -> None:
        self._path, count = path, _count(path)
        self._video: Any = _opened(path)
        self._next = 0
        height, width = (int(self._video.get(key)) for key in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH))
        self.info = StackInfo((count, 3, height, width), "uint8", 255.0, channels_last=True)

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
