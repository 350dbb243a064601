"""Outputs of video frames: files, pipes and a window."""

from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.atomic import whole_file
from rsvib_torch.io.stack_format import needed_package

__all__ = ["FrameOutput", "PipeOutput", "PreviewOutput", "VideoOutput"]

Frame = NDArray[np.uint8]  # (H, W) grey or (H, W, 3) RGB


class FrameOutput(Protocol):
    """An output of video frames."""

    def write(self, frame: Frame, index: int) -> None:
        """Write a frame (H, W) or (H, W, 3); ``index`` counts frame periods from the first frame."""

    def close(self, *, complete: bool) -> None:
        """Finish the output; if it is not complete, a file is not written."""


class PipeOutput:
    """Raw frames, 8 bits per channel, grey or RGB, one behind the other."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def write(self, frame: Frame, index: int) -> None:
        """Write a frame."""
        self._stream.write(np.ascontiguousarray(frame).tobytes())
        self._stream.flush()

    def close(self, *, complete: bool) -> None:
        """The pipe belongs to the caller."""


class VideoOutput:
    """A video file: H.264 for .mp4, .mov and .m4v, FFV1 (without loss) for .mkv.

    The file gets its name when it is complete.

    Args:
        path: The file.
        frame_rate: Frames per second.

    Raises:
        ValueError: If the file ending is another one.
    """

    def __init__(self, path: Path, frame_rate: float) -> None:
        if path.suffix.lower() not in (".mp4", ".mov", ".m4v", ".mkv"):
            raise ValueError(f"{path}: a live video is written to .mp4, .mov, .m4v or .mkv; or to a pipe with --out -")
        self._av = needed_package("av", "writing video", "video")
        self._rate = Fraction(frame_rate).limit_denominator(1001)
        self._lossy = path.suffix.lower() != ".mkv"
        self._opened = ExitStack()
        self._container = self._av.open(str(self._opened.enter_context(whole_file(path))), "w")
        self._stream: Any = None

    def write(self, frame: Frame, index: int) -> None:
        """Encode a frame."""
        grey = frame.ndim == 2
        if self._stream is None:
            # ultrafast keeps up with a camera; the other presets make smaller files of the same quality
            options = {"crf": "16", "preset": "ultrafast"} if self._lossy else {"level": "3", "g": "1"}
            self._stream = self._container.add_stream("libx264" if self._lossy else "ffv1", self._rate, options=options)
            self._stream.height, self._stream.width = frame.shape[:2]
            self._stream.pix_fmt = "yuv420p" if self._lossy else "gray" if grey else "bgr0"
            self._stream.codec_context.time_base = 1 / self._rate
        picture = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="gray" if grey else "rgb24")
        picture.pts, picture.time_base = index, 1 / self._rate
        self._container.mux(self._stream.encode(picture))

    def close(self, *, complete: bool) -> None:
        """Finish the file."""
        if not complete or self._stream is None:
            self._container.close()
            self._opened.__exit__(InterruptedError, InterruptedError("no complete video"), None)  # removes the part
            return
        self._container.mux(self._stream.encode())
        self._container.close()
        self._opened.close()


class PreviewOutput:
    """A window of OpenCV.

    Raises:
        ValueError: If the installed OpenCV has no windows.
    """

    def __init__(self) -> None:
        import cv2  # noqa: PLC0415

        windows = next((line for line in cv2.getBuildInformation().splitlines() if line.strip().startswith("GUI:")), "")
        if "NONE" in windows or not windows:
            raise ValueError(
                "--preview: the installed OpenCV (opencv-python-headless) has no windows; use --page 8080 and a browser"
            )
        self._cv2 = cv2

    def write(self, frame: Frame, index: int) -> None:
        """Show a frame."""
        self._cv2.imshow("rsvib live", frame if frame.ndim == 2 else frame[..., ::-1])
        self._cv2.waitKey(1)

    def close(self, *, complete: bool) -> None:
        """Close the window."""
        self._cv2.destroyAllWindows()
