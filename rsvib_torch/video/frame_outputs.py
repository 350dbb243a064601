"""Outputs of video frames: files, pipes, and a page for browsers on this machine."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

import cv2
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
_HOST = "127.0.0.1"  # never reachable from other machines
# the next frame is requested when one is shown: a slow browser gets fewer of them
_PAGE = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>rsvib live</title>
<style>body{font-family:sans-serif;margin:1em}img{max-width:100%}pre{background:#f4f4f4;padding:.6em}</style>
</head><body><h1>rsvib live</h1><img id="frame" alt="restored frames"><pre id="state"></pre>
<script>const image = document.getElementById("frame"), text = document.getElementById("state");
const next = () => {image.src = "/frame?" + Date.now()};
image.onload = () => setTimeout(next, 20); image.onerror = () => setTimeout(next, 500); next();
setInterval(async () => {text.textContent = await (await fetch("/state")).text()}, 500)</script></body></html>"""


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


class _PageFrame:
    """A frame of the page, which is encoded at its first request only."""

    def __init__(self, frame: Frame) -> None:
        self._frame = frame

    @cached_property
    def jpeg(self) -> bytes:
        """The frame in a JPEG file."""
        colours = self._frame if self._frame.ndim == 2 else np.ascontiguousarray(self._frame[..., ::-1])
        return cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


class PageOutput:
    """Restored frames at ``http://127.0.0.1:PORT``; the port 0 chooses a free one. ``url`` is the address."""

    def __init__(self, port: int) -> None:
        self._frame: _PageFrame | None = None  # the last one
        self._state = "waiting for frames"
        output = self

        class Handler(BaseHTTPRequestHandler):
            """Answers of the page."""

            timeout = 10.0  # s, without a byte; connections that are never used would keep a thread each

            def do_GET(self) -> None:
                """Answer a request."""
                name = self.path.partition("?")[0]
                if self.headers.get("Host", "").rpartition(":")[0] not in (_HOST, "localhost"):
                    self.send_error(403, f"the page is at {output.url}")  # another site refers to this machine
                elif name == "/":
                    self._send("text/html; charset=utf-8", _PAGE.encode())
                elif name == "/state":
                    self._send("text/plain; charset=utf-8", output._state.encode())
                elif name == "/frame" and output._frame is not None:
                    self._send("image/jpeg", output._frame.jpeg)
                else:
                    self.send_error(404)

            def _send(self, kind: str, data: bytes) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                with suppress(OSError):  # the browser has left
                    self.wfile.write(data)

            def log_message(self, *_: object) -> None:
                """Requests are not printed."""

        try:
            self._server = ThreadingHTTPServer((_HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise OSError(f"--page {port}: {error}; choose another port") from error
        self._server.daemon_threads = True
        self.url = f"http://{_HOST}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, name="rsvib-page", daemon=True).start()

    def show_state(self, text: str) -> None:
        """Show a text below the frames."""
        self._state = text

    def write(self, frame: Frame, index: int) -> None:
        """Show a frame."""
        self._frame = _PageFrame(frame)

    def close(self) -> None:
        """End the page."""
        self._server.shutdown()
        self._server.server_close()
