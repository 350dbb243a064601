"""Sessions of ``rsvib live`` with a camera are ended in every way: the recording is kept, and can be played."""

import os
import pty
import random
import resource
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import cycle
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from attacks.trial import Outcome, Process, Trial, outcome_of_command, rsvib

_SIZE, _RATE = 128, 30  # px, frames/s
_RECORDED = (12, 40)  # frames in the file, after which a session is ended
_WAITING = 4  # frames that may be missing at the end of a recording: those in queues, and an incomplete one
_LIMIT = 120.0  # s for the start of a session, which takes 4 s on an idle machine, and for its end without a signal
_LONGEST_END = 20.0  # s from a signal to the end, which takes 1 to 3 s on an idle machine; at most 10 s are waited
_CAMERA = ("--row-time", "200us", "--exposure", "0.8ms", "--frame-rate", str(_RATE))


class StreamingCamera(ThreadingHTTPServer):
    """Motion JPEG over HTTP; after its frames it ``disappears``, or keeps the connection and sends nothing."""

    def __init__(self, frames: int, *, disappears: bool = True, pictures: Sequence[Any] = ()) -> None:
        scene = cv2.blur(np.random.default_rng(0).integers(0, 256, (_SIZE, _SIZE), np.uint8), (5, 5))
        shown = pictures or [np.roll(scene, (n // 3, n), (0, 1)) for n in range(8)]
        self.parts = [cv2.imencode(".jpg", picture)[1].tobytes() for picture in shown]
        self.frames, self.disappears = frames, disappears
        self.viewers = threading.Semaphore(0)  # released when a viewer has connected
        self.begin, self.end = threading.Event(), threading.Event()  # of the first frame, and of the need for a camera
        super().__init__(("127.0.0.1", 0), _Stream)
        self.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server_address[1]}/video.mjpg"


class _Stream(BaseHTTPRequestHandler):
    """The answer to a viewer."""

    server: StreamingCamera

    def do_GET(self) -> None:
        """Send frames until the camera ends or the viewer leaves."""
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=part")
        self.end_headers()
        self.server.viewers.release()
        self.server.begin.wait()
        for _, part in zip(range(self.server.frames), cycle(self.server.parts), strict=False):
            try:
                self.wfile.write(b"--part\r\nContent-Type: image/jpeg\r\n\r\n" + part + b"\r\n")
            except OSError:
                return
            time.sleep(1 / _RATE)
        if not self.server.disappears:
            self.server.end.wait()

    def log_message(self, *_: Any) -> None:
        """Requests are not printed."""


@contextmanager
def streaming_camera(*, frames: int = 10**6, begins: bool = False, **options: Any) -> Iterator[StreamingCamera]:
    """A running camera; if it ``begins``, it does not wait for the event."""
    with StreamingCamera(frames, **options) as camera:
        threading.Thread(target=camera.serve_forever, daemon=True).start()
        if begins:
            camera.begin.set()
        try:
            yield camera
        finally:
            camera.begin.set()
            camera.end.set()
            camera.shutdown()


def _frames(path: Path) -> int:
    """Number of frames that can be decoded, also while the file is written; 0 if it cannot be opened."""
    count = 0
    try:
        with av.open(str(path)) as video:
            for _ in video.decode(video=0):
                count += 1
    except (OSError, av.error.FFmpegError):
        pass  # the last frame may be incomplete
    return count


@dataclass
class _Session:
    """A running session: its process, its recording, the file with what it prints, and the other end of its output."""

    child: subprocess.Popen[bytes]
    out: Path
    printed: Path
    reader: int = -1
    begin: float = field(default_factory=time.monotonic)

    def recorded(self, least: int) -> int:
        """Wait until the recording has a number of frames; returns how many must be left.

        These are fewer if the machine is too slow to record them in time, but not after an early end.
        """
        end = time.monotonic() + _LIMIT
        while (count := _frames(self.out)) < least and self.child.poll() is None and time.monotonic() < end:
            time.sleep(0.1)
        return count if self.child.poll() is None else max(count, least)

    def send(self, *numbers: signal.Signals) -> None:
        """Send signals, 1 ms apart."""
        for number in numbers:
            self.child.send_signal(number)
            time.sleep(0.001)

    def fill_disk(self) -> None:
        """Let the recording grow by a few frames only."""
        limit = 50_000 + (self.out.stat().st_size if self.out.exists() else 0)
        resource.prlimit(self.child.pid, resource.RLIMIT_FSIZE, (limit, limit))

    def close_reader(self) -> None:
        """Close the other end of the pipe or terminal."""
        os.close(self.reader)

    def ended(self, limit: float | None = None) -> Process:
        """Wait for the end of the process; it is killed after the limit.

        Without a limit it is ``_LONGEST_END``, or three times the duration up to now if the machine is slow.
        """
        begin = time.perf_counter()
        limit = limit or max(_LONGEST_END, 3.0 * (time.monotonic() - self.begin))
        try:
            code: int | None = self.child.wait(limit)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()
            code = None
        return Process(code, self.printed.read_text(errors="replace"), time.perf_counter() - begin, 0)


def _start(url: str, out: Path, output: str = "file") -> _Session:
    """Start a session that records to ``out``; its output is a ``file``, a ``pipe``, or a ``terminal``."""
    printed = out.with_name(f"{len(list(out.parent.iterdir()))}.txt")
    command = rsvib("live", url, *_CAMERA, "--out", out)
    reader, writer = os.pipe() if output == "pipe" else pty.openpty() if output == "terminal" else (-1, -1)
    with printed.open("wb") as file:
        if output == "terminal":
            command = ["setsid", "--ctty", *command]
            child = subprocess.Popen(command, stdin=writer, stdout=writer, stderr=writer)
        else:
            stdout = writer if output == "pipe" else file
            child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=file)
    if writer >= 0:
        os.close(writer)
    return _Session(child, out, printed, reader)


def _judged(
    name: str, session: _Session, process: Process, *, least: int, expected: Outcome, message: str = ""
) -> Trial:
    """Outcome of a session whose recording has at least a number of frames, and which ends as expected."""
    outcome, frames, detail = outcome_of_command(process), _frames(session.out), f"{process.code}: {process.output}"
    if frames < least:
        return Trial(name, "lost", f"{frames} of {least} frames are left; exit code {detail}")
    if outcome in ("traceback", "hang"):
        return Trial(name, outcome, f"exit code {detail}")
    if outcome != expected or message not in process.output or process.output.count("error: ") > 1:
        return Trial(name, "wrong", f"exit code {detail}")
    return Trial(name, outcome)


@dataclass(frozen=True)
class _Ending:
    """How a session ends while it records."""

    act: Callable[[_Session], None]  # what ends it
    expected: Outcome = "completed"  # its outcome
    message: str = ""  # part of what it prints; {out} is the recording
    output: str = "file"  # see ``_start``

    def __call__(self, name: str, out: Path, frames: int) -> Trial:
        """A trial."""
        with streaming_camera(begins=True) as camera:
            session = _start(camera.url, out, self.output)
            count = session.recorded(frames)
            if session.child.poll() is None:
                self.act(session)
            message = self.message.format(out=out)
            process = session.ended()
            return _judged(name, session, process, least=count, expected=self.expected, message=message)


def _signals(*numbers: signal.Signals) -> Callable[[_Session], None]:
    return lambda session: session.send(*numbers)


def _without_reader(session: _Session) -> None:
    session.close_reader()
    session.send(signal.SIGTERM)


def _killed(name: str, out: Path, frames: int) -> Trial:
    """SIGKILL; the next session of the same name is refused, and names the recording."""
    with streaming_camera(begins=True) as camera:
        session = _start(camera.url, out)
        count = session.recorded(frames)
        session.child.kill()
        session.child.wait()
        again = _start(camera.url, out)
        process = again.ended(_LIMIT)
        return _judged(name, again, process, least=count, expected="refused", message=out.name)


def _camera_ends(name: str, out: Path, frames: int, *, disappears: bool) -> Trial:
    """The camera disappears, which ends the session, or sends nothing more until SIGTERM arrives."""
    with streaming_camera(frames=frames, begins=True, disappears=disappears) as camera:
        session, least = _start(camera.url, out), frames - _WAITING
        if not disappears:
            session.recorded(least)
            session.send(signal.SIGTERM)
        process = session.ended(_LIMIT if disappears else None)
        return _judged(name, session, process, least=least, expected="completed")


def _before_the_first_frame(name: str, out: Path, frames: int) -> Trial:
    """SIGINT while OpenCV waits for the first frame."""
    with streaming_camera() as camera:
        session = _start(camera.url, out)
        camera.viewers.acquire(timeout=_LIMIT)
        time.sleep(0.5)
        session.send(signal.SIGINT)
        process = session.ended()
        return _judged(name, session, process, least=0, expected="refused", message="no frame was read")


def _pipe(name: str, out: Path, frames: int, *, reader_ends: bool) -> Trial:
    """Frames from an open pipe to a reader, which ends, or which reads no more while SIGTERM arrives."""
    command = rsvib("live", "-", *_CAMERA, "--out", "-")
    printed, frame = out.with_name("pipe.txt"), b"FRAME\n" + bytes(range(256)) * (_SIZE * _SIZE // 256)
    with printed.open("wb") as errors:
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors)
    assert child.stdin is not None
    assert child.stdout is not None
    session = _Session(child, out, printed)
    child.stdin.write(f"YUV4MPEG2 W{_SIZE} H{_SIZE} F{_RATE}:1 Cmono\n".encode() + frame * frames)
    child.stdin.flush()
    child.stdout.read(3 * _SIZE * _SIZE)
    if reader_ends:
        child.stdout.close()
    else:
        time.sleep(1.0)  # the pipe is full: it holds one frame
        session.send(signal.SIGTERM)
    process = session.ended()
    child.stdin.close()
    child.stdout.close()
    return _judged(name, session, process, least=0, expected="completed")


# tests run the first ones only
_WAYS: dict[str, Callable[[str, Path, int], Trial]] = {
    "SIGTERM": _Ending(_signals(signal.SIGTERM)),
    "full disk": _Ending(_Session.fill_disk, "refused", "{out}: File too large"),
    "answer into a closed pipe": _Ending(_without_reader, "refused", "the answer cannot be written", "pipe"),
    "SIGINT before the first frame": _before_the_first_frame,
    "SIGINT": _Ending(_signals(signal.SIGINT)),
    "SIGHUP": _Ending(_signals(signal.SIGHUP)),
    "SIGINT twice": _Ending(_signals(signal.SIGINT, signal.SIGINT)),
    "SIGHUP and SIGTERM": _Ending(_signals(signal.SIGHUP, signal.SIGTERM)),
    "closed terminal": _Ending(_Session.close_reader, "refused", output="terminal"),
    "SIGKILL": _killed,
    "the camera disappears": partial(_camera_ends, disappears=True),
    "SIGTERM while the camera sends nothing more": partial(_camera_ends, disappears=False),
    "the reader of raw frames ends": partial(_pipe, reader_ends=True),
    "SIGTERM while the reader of raw frames is blocked": partial(_pipe, reader_ends=False),
}


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """All ways in turn, with .mkv and .mp4; the number of frames before the end is random."""
    choice = random.Random(seed)
    for ignored in (signal.SIGINT, signal.SIGHUP):  # by nohup, or in the background of a script; sessions inherit it
        if signal.getsignal(ignored) is signal.SIG_IGN:
            signal.signal(ignored, signal.SIG_DFL)
    for number in range(count):
        way, ending = list(_WAYS)[number % len(_WAYS)], (".mkv", ".mp4")[number // len(_WAYS) % 2]
        frames, place = choice.randint(*_RECORDED), folder / "trial"
        place.mkdir()
        yield _WAYS[way](f"{way}, {ending}, {frames} frames", place / f"recorded{ending}", frames)
        shutil.rmtree(place)
