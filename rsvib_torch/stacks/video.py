"""Stacks in video files, read through OpenCV."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsvib_torch.stacks.info import StackInfo

__all__ = ["read_video", "read_video_info"]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An open video; the decoder's own messages are kept off the terminal."""
    with path.open("rb"):
        pass  # a file that may not be read is an OSError of its own
    level = cv2.utils.logging.getLogLevel()
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            raise ValueError(f"{path}: not a readable video")
        yield video
    finally:
        video.release()
        cv2.utils.logging.setLogLevel(level)


def _info(video: Any, count: int) -> StackInfo:
    height, width = int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(video.get(cv2.CAP_PROP_FRAME_WIDTH))
    return StackInfo((count, 3, height, width), "uint8", 255.0)


def read_video_info(path: Path) -> StackInfo:
    """What the container says; its number of frames may be an estimate."""
    with _opened(path) as video:
        return _info(video, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))


def read_video(path: Path) -> tuple[NDArray[Any], StackInfo]:
    """Pixels (T, 3, H, W), uint8 RGB: always three channels, grey videos too."""
    frames = []
    with _opened(path) as video:
        promised = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        while True:
            done, frame = video.read()
            if not done:
                break
            frames.append(np.moveaxis(frame[..., ::-1], -1, 0))
        if not frames:
            raise ValueError(f"{path}: no frame of the video can be read")
        # Containers without an index only estimate their number of frames.
        if len(frames) < promised - max(1, promised // 10):
            raise ValueError(f"{path}: truncated: {len(frames)} of {promised} frames can be read")
        if len({frame.shape for frame in frames}) > 1:
            raise ValueError(f"{path}: frames of different size")
        return np.stack(frames), _info(video, len(frames))
