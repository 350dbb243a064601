"""Outputs of video frames: files and pipes."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.checks.values import needed_package
from rsvib_torch.files.atomic import sync
from rsvib_torch.io.stack_info import H264, StackInfo
from rsvib_torch.io.video import CONTAINERS, VideoEncoder, check_video

if TYPE_CHECKING:
    from av.container import OutputContainer

Frame = NDArray[np.uint8]  # (H, W) grey or (H, W, 3) RGB

# of FFmpeg: every frame is written when it is encoded, in a fragment (.mp4, .mov, .m4v) or cluster (.mkv) of its own.
# After a kill, 2 of 100 frames are missing in .mp4 and 1 in .mkv; with the defaults, .mp4 cannot be read
_FRAGMENTS = {"flush_packets": "1", "movflags": "frag_every_frame+empty_moov+default_base_moof"}
_CLUSTERS = {"flush_packets": "1", "cluster_time_limit": "0"}  # ms


class FrameOutput(Protocol):
    """An output of video frames."""

    def write(self, frame: Frame, index: int) -> None:
        """Write a frame (H, W) or (H, W, 3); ``index`` counts frame periods from the first frame, and rises."""

    def close(self) -> None:
        """Finish the output."""


class PipeOutput:
    """Raw frames, 8 bits per channel, grey or RGB, one behind the other, in a pipe without a buffer."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def write(self, frame: Frame, index: int) -> None:
        """Write a frame."""
        data = memoryview(np.ascontiguousarray(frame).tobytes())
        while data:  # a signal may interrupt writing
            data = data[self._stream.write(data) :]

    def close(self) -> None:
        """The pipe belongs to the caller."""


class VideoOutput:
    """A video file: H.264 for .mp4, .mov and .m4v, FFV1 (without loss) for .mkv.

    The file is created with the first frame, and can be played from then on, however the process ends. A file that
    exists then is replaced only to ``overwrite`` it.
    """

    def __init__(self, path: Path, frame_rate: float, *, overwrite: bool = False) -> None:
        if path.suffix.lower() not in CONTAINERS:
            raise ValueError(f"{path}: a live video is written to .mp4, .mov, .m4v or .mkv; or to a pipe with --out -")
        self._av = needed_package("av", "writing video", "video")
        self._path, self._rate, self._overwrite = path, frame_rate, overwrite
        self._container: OutputContainer | None = None

    def write(self, frame: Frame, index: int) -> None:
        """Encode a frame; after an error, the file has the frames before."""
        pixels = frame if frame.ndim == 2 else np.moveaxis(frame, -1, 0)
        if self._container is None:
            self._create(pixels.shape)
        with self._errors_named():
            self._encoder.write(pixels, index * self._encoder.step)

    def _create(self, shape: tuple[int, ...]) -> None:
        info = StackInfo((2, *shape), "uint8", 255.0, frame_rate=self._rate)  # of any number of frames
        check_video(self._path, info)
        if self._overwrite:
            self._path.unlink(missing_ok=True)  # a link is replaced, not the file behind it
        try:
            self._path.open("xb").close()
        except FileExistsError as error:
            raise FileExistsError(f"{self._path} was created by another program; choose another name") from error
        sync(self._path.absolute().parent)
        lossy = self._path.suffix.lower() in H264
        self._container = self._av.open(str(self._path), "w", options=_FRAGMENTS if lossy else _CLUSTERS)
        # ultrafast keeps up with a camera; the other presets make smaller files of the same quality
        options = {"crf": "16", "preset": "ultrafast"} if lossy else {}
        self._encoder = VideoEncoder(self._container, self._path, info, None, options=options)

    @contextmanager
    def _errors_named(self) -> Iterator[None]:
        """State the file in errors of FFmpeg, after which nothing more is written."""
        try:
            yield
        except self._av.error.FFmpegError as error:
            with suppress(self._av.error.FFmpegError):
                if self._container is not None:
                    self._container.close()
            self._container = None  # libav would crash if more was written after a header that could not be written
            raise OSError(f"{self._path}: {error.strerror}; the video has the frames before") from error

    def close(self) -> None:
        """Finish the file."""
        if self._container is not None:
            with self._errors_named():
                self._encoder.finish()
            self._container.close()
            sync(self._path)
