"""The command ``live``: follow the vibration of a running camera."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO

from rsvib_torch import io, tracking, video
from rsvib_torch.checks.values import NotNegative, options
from rsvib_torch.commands.answers import detection_data
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.shared_options import CameraOptions, check_file
from rsvib_torch.commands.terminal import Answer, warn
from rsvib_torch.files.reading import Table
from rsvib_torch.options import PixelFormat, TrackerOptions, method_options
from rsvib_torch.text import number_of

if TYPE_CHECKING:
    from rsvib_torch.config import Config


@options
class LiveOptions(CameraOptions):
    """Options of ``live``."""

    source: str = argument()
    """Number or URL of a camera, - for raw frames on standard input, or a file with frames."""
    out: Path | None = None
    """Video to write (.mp4, .mov, .m4v, .mkv), or - for raw frames to stdout."""
    size: str | None = option(None, metavar="WIDTHxHEIGHT")
    """Size of the frames on standard input, e.g. 1024x768."""
    pixel_format: PixelFormat = "gray8"
    """Pixels of the frames on standard input."""
    tracker: Annotated[
        Table,
        Given(
            TrackerOptions,
            ("window", "columns"),
            forms={"method": {"show_default": "from the configuration, or dewarp"}},
        ),
    ]
    steady: NotNegative = option(0.0, metavar="SECONDS")
    """Stabilise the image to a straight line through the last part of its path."""


def live_session(given: LiveOptions) -> Answer:
    """Follow the vibration of a running camera, and restore its frames.

    The source is never blocked: if frames come faster than they are processed, the oldest waiting ones are dropped and
    counted. Ctrl-C ends the session. The video can be played at any moment, also after a crash or on a full disk.
    """
    file = _file_of(given)
    settings = given.settings_for(file)
    written = [] if given.out is None or str(given.out) == "-" else [given.out]
    for path in written:
        check_file(path, given.overwrite, [*([] if file is None else io.stack_files(file)), settings.path])
    method: str = (settings.restoration | given.tracker).get("method", "dewarp")
    available = set(method_options(method)) - {"joint"}
    restoration = {name: value for name, value in settings.restoration.items() if name in available}
    source = _source(given, file, settings)
    with _frames_on_standard_output(enabled=str(given.out) == "-") as stream:
        outputs: list[video.FrameOutput] = [
            video.VideoOutput(path, settings.timing.frame_rate, overwrite=given.overwrite) for path in written
        ]
        outputs += [] if stream is None else [video.PipeOutput(stream)]
        tracker = tracking.VibrationTracker(
            settings.timing,
            **restoration | given.tracker | {"method": method},
            steady=given.steady,
            full_scale=source.full_scale if given.full_scale is None or file else given.full_scale,
            channels="first",
        )
        report = video.run_live(
            source,
            tracker,
            outputs,
            drops=file is None,
        )
    if report.frames == 0:
        raise ValueError(f"{given.source}: no frame was read")
    slow = "dropped, because processing was too slow (fewer --columns)"
    missing = {slow: report.dropped, "not delivered by the source": report.lost}
    parts = [f"{number_of(count, 'frame')} {why}" for why, count in missing.items() if count]
    if parts:
        warn("; ".join(parts))
    return _answer(given.source, report, written, drops=file is None)


def _file_of(given: LiveOptions) -> Path | None:
    """The file of the frames; None for the number or URL of a camera, and for standard input."""
    if (given.source == "-") != (given.size is not None):
        raise ValueError("--size WIDTHxHEIGHT is required for raw frames on standard input (-), and only for them")
    if given.source == "-" or given.source.isdecimal() or "://" in given.source:
        return None
    if not io.stack_files(given.source)[0].exists():
        raise FileNotFoundError(f"{given.source}: no such file; a camera is a number or a URL")
    return Path(given.source)


def _source(given: LiveOptions, file: Path | None, settings: Config) -> video.FrameSource:
    if file is not None:
        scale = given.full_scale if given.full_scale is not None else settings.full_scale
        return video.FileSource(file, settings.timing, scale)
    if given.size is None:
        return video.CameraSource(int(given.source) if given.source.isdecimal() else given.source, settings.timing)
    width, _, height = given.size.partition("x")
    if not (width.isdecimal() and height.isdecimal() and 0 < int(width) < 10**6 and 0 < int(height) < 10**6):
        raise ValueError(f"--size must be WIDTHxHEIGHT in px such as 1024x768, got {given.size!r}")
    # not sys.stdin.buffer: Python aborts at the exit if a thread still waits in it
    stream = os.fdopen(sys.stdin.fileno(), "rb", closefd=False)
    return video.PipeSource(stream, (int(height), int(width)), given.pixel_format, settings.timing)


@contextmanager
def _frames_on_standard_output(*, enabled: bool) -> Iterator[BinaryIO | None]:
    """Standard output for frames; everything that is printed then and later goes to standard error."""
    if not enabled:
        yield None
        return
    if sys.stdout.isatty():
        raise ValueError("--out - writes raw frames to standard output, which is a terminal; redirect it")
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb", buffering=0) as frames:
        sys.stdout = sys.stderr
        yield frames


def _answer(source: str, report: video.LiveReport, files: list[Path], *, drops: bool) -> Answer:
    rate = f"{report.seconds:.1f} s ({report.frames / report.seconds:.1f} per second)"
    lines = [
        f"{number_of(report.frames, 'frame')} in {rate}, {report.tracked} with known motion, "
        f"{report.corrected} corrected",
        f"dropped {report.dropped}, not delivered {report.lost}, unusable {report.unusable}; vibration detected "
        f"{number_of(report.detections, 'time')}",
    ]
    if report.predicted:
        lines.append(f"{number_of(report.predicted, 'late frame')} predicted instead of measured")
    if drops:
        delay = f"delay: {report.latency(0.5)} frame periods in the median"
        lines.append(f"{delay}, {report.latency(0.99)} in 99 % of the frames")
    found = report.detection
    names = ("frames", "tracked", "corrected", "predicted", "unusable", "dropped", "lost", "detections", "seconds")
    delays = {"delay_median": 0.5, "delay_99": 0.99}
    data = {name: getattr(report, name) for name in names}
    data |= {name: report.latency(part) if drops else None for name, part in delays.items()}
    data["detection"] = None if found is None else detection_data(found)
    results = {f"Live frames of {source}": lines}
    if found is not None:
        results["Vibration at the last frame"] = [found.summary()]
    return Answer(results, data, files)
