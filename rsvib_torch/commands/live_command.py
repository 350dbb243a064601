"""The command ``live``: follow the vibration of a running camera."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, BinaryIO

from rsvib_torch import io, tracking, video
from rsvib_torch.checks.values import NotNegative, options
from rsvib_torch.commands.answers import without_curves
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.shared_options import CameraOptions, check_file, seconds
from rsvib_torch.commands.terminal import Answer, warn
from rsvib_torch.files.reading import Table
from rsvib_torch.options import TrackerOptions, method_options
from rsvib_torch.text import number_of


@options
class LiveOptions(CameraOptions):
    """Options of ``live``."""

    source: str = argument()
    """Number or URL of a camera, a file with frames, or - for a video on standard input that can be read from a pipe
    (Matroska, MPEG-TS, fragmented MP4)."""
    out: Path | None = None
    """Video to write (.mp4, .mov, .m4v, .mkv), or - for raw frames to stdout."""
    tracker: Annotated[
        Table,
        Given(
            TrackerOptions,
            ("window", "columns"),
            forms={"method": {"show_default": "from the configuration, or dewarp"}},
        ),
    ]
    steady: NotNegative = option(0.0, parser=seconds, metavar="SECONDS")
    """Stabilise the image to a straight line through the last part of its path."""


def live_session(command: LiveOptions) -> Answer:
    """Follow the vibration of a running camera, and restore its frames.

    The source is never blocked: if frames come faster than they are processed, the oldest waiting ones are dropped and
    counted. Ctrl-C ends the session. The video can be played at any moment, also after a crash or on a full disk.
    """
    camera = command.source == "-" or command.source.isdecimal() or "://" in command.source
    inputs = [] if camera else io.stack_files(command.source)
    if inputs and not inputs[0].exists():
        raise FileNotFoundError(f"{command.source}: no such file; a camera is a number or a URL")
    settings = command.settings_for(None if camera else Path(command.source))
    written = [] if command.out is None or str(command.out) == "-" else [command.out]
    for path in written:
        check_file(path, command.overwrite, [*inputs, settings.path])
    method: str = (settings.restoration | command.tracker).get("method", "dewarp")
    available = set(method_options(method)) - {"joint"}
    restoration = {name: value for name, value in settings.restoration.items() if name in available}
    source: video.CameraSource | video.FileSource
    if camera:
        number = int(command.source) if command.source.isdecimal() else command.source
        source = video.CameraSource(number, settings.timing, command.full_scale)
    else:
        source = video.FileSource(Path(command.source), settings.timing, command.full_scale or settings.full_scale)
    with _frames_on_standard_output(enabled=str(command.out) == "-") as stream:
        outputs: list[video.FrameOutput] = [
            video.VideoOutput(path, settings.timing.frame_rate, overwrite=command.overwrite) for path in written
        ]
        outputs += [] if stream is None else [video.PipeOutput(stream)]
        tracker = tracking.VibrationTracker(
            settings.timing,
            **restoration | command.tracker | {"method": method},
            steady=command.steady,
            full_scale=source.full_scale,
            channels="first",
        )
        report = video.run_live(source, tracker, outputs)
    if report.frames == 0:
        raise ValueError(f"{command.source}: no frame was read")
    slow = "dropped, because processing was too slow (fewer --columns)"
    missing = {slow: report.dropped, "not delivered by the source": report.lost}
    parts = [f"{number_of(count, 'frame')} {why}" for why, count in missing.items() if count]
    if parts:
        warn("; ".join(parts))
    return _answer(command.source, report, written, waits=source.waits)


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


def _answer(source: str, report: video.LiveReport, files: list[Path], *, waits: bool) -> Answer:
    rate = f"{report.seconds:.1f} s ({report.frames / report.seconds:.1f} per second)"
    shares = {"delay_median": 0.5, "delay_99": 0.99}
    delays = {name: None if waits else report.latency(share) for name, share in shares.items()}
    lines = [
        f"{number_of(report.frames, 'frame')} in {rate}, {report.tracked} with known motion, "
        f"{report.corrected} corrected",
        f"dropped {report.dropped}, not delivered {report.lost}, unusable {report.unusable}; vibration detected "
        f"{number_of(report.detections, 'time')}",
    ]
    if not waits:
        lines.append(
            f"delay: {delays['delay_median']} frame periods in the median, {delays['delay_99']} in 99 % of the frames"
        )
    if report.predicted:
        lines.append(f"{number_of(report.predicted, 'late frame')} predicted instead of measured")
    last = report.detection
    names = ("frames", "tracked", "corrected", "predicted", "unusable", "dropped", "lost", "detections", "seconds")
    data = {name: getattr(report, name) for name in names} | delays
    data["detection"] = None if last is None else without_curves(last)
    results = {f"Live frames of {source}": lines}
    if last is not None:
        results["Vibration at the last frame"] = [last.summary()]
    return Answer(results, data, files)
