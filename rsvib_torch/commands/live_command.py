"""The command ``live``: follow the vibration of a running camera."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO

from pydantic import Field

from rsvib_torch import io, tracking, video
from rsvib_torch.checks.validation import NotNegative, options
from rsvib_torch.commands.answers import detection_data
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.shared_options import CameraOptions, RangeOptions, check_file, size_of
from rsvib_torch.commands.terminal import Answer, warn
from rsvib_torch.files.reading import Table
from rsvib_torch.options import PixelFormat, TrackerOptions, method_options
from rsvib_torch.text import number_of

if TYPE_CHECKING:
    from rsvib_torch.config import Config

_AT_LEAST_2 = Annotated[int, Field(ge=2)]


@options
class LiveOptions(CameraOptions, RangeOptions):
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
    """Stabilise the image to a straight line through the last part of its path (a camera)."""
    num_frames: _AT_LEAST_2 | None = None
    """Stop after this number of frames."""

    @cached_property
    def file(self) -> Path | None:
        """The frames of a file that are used; None for the number or URL of a camera, and for standard input."""
        if self.source == "-" or self.is_camera:
            if self.frame_range is not None:
                raise ValueError(f"--frames goes with a file, not with {self.source}; --num-frames ends a session")
            return None
        if not io.stack_files(self.source)[0].exists():
            raise FileNotFoundError(f"{self.source}: no such file; a camera is a number or a URL")
        return self.part_of(Path(self.source))

    @property
    def is_camera(self) -> bool:
        """Whether the source is the number or URL of a camera."""
        return self.source.isdecimal() or "://" in self.source

    @property
    def written(self) -> Path | None:
        """The video; None for a pipe."""
        return None if self.out is None or str(self.out) == "-" else self.out


def live_session(given: LiveOptions) -> Answer:
    """Follow the vibration of a running camera, and restore its frames.

    The source is never blocked: if frames come faster than they are processed, the oldest waiting ones are dropped and
    counted. Ctrl-C ends the session. The video can be played at any moment, also after a crash or on a full disk.
    """
    settings = given.settings_for(None if given.file is None else Path(given.source), given.frame_range)
    _check_options(given)
    files = [] if given.written is None else [given.written]
    inputs = [*([] if given.file is None else io.stack_files(given.file)), settings.path]
    for path in files:
        check_file(path, given.overwrite, inputs)
    method: str = (settings.restoration | given.tracker).get("method", "dewarp")
    available = set(method_options(method)) - {"joint"}
    restoration = {name: value for name, value in settings.restoration.items() if name in available}
    drops, source = given.file is None, _source(given, settings)
    with _frames_on_standard_output(enabled=str(given.out) == "-") as stream:
        outputs = _outputs(given, settings, stream)
        tracker = tracking.VibrationTracker(
            settings.timing,
            **restoration | given.tracker | {"method": method},
            steady=given.steady,
            wobble=given.steady > 0,
            full_scale=source.full_scale if given.full_scale is None or given.file else given.full_scale,
            channels="first",
        )
        report = video.run_live(
            source,
            tracker,
            outputs,
            drops=drops,
            max_frames=given.num_frames,
        )
    if report.frames == 0:
        raise ValueError(f"{given.source}: no frame was read")
    slow = "dropped, because processing was too slow (fewer --columns)"
    missing = {slow: report.dropped, "not delivered by the source": report.lost}
    parts = [f"{number_of(count, 'frame')} {why}" for why, count in missing.items() if count]
    if parts:
        warn("; ".join(parts))
    return _answer(given.source, report, files, drops=drops)


def _source(given: LiveOptions, settings: Config) -> video.FrameSource:
    if given.is_camera:
        return video.CameraSource(int(given.source) if given.source.isdecimal() else given.source, settings.timing)
    if given.file is None:
        width, height = size_of(given.size or "", "WIDTHxHEIGHT in px such as 1024x768")
        # not sys.stdin.buffer: Python aborts at the exit if a thread still waits in it
        stream = os.fdopen(sys.stdin.fileno(), "rb", closefd=False)
        return video.PipeSource(stream, (height, width), given.pixel_format, settings.timing)
    scale = given.full_scale if given.full_scale is not None else settings.full_scale
    return video.FileSource(given.file, settings.timing, scale)


def _check_options(given: LiveOptions) -> None:
    """Refuse options that do not go with the source."""
    if given.source == "-" and given.size is None:
        raise ValueError("--size WIDTHxHEIGHT is required for raw frames on standard input")
    if given.source != "-" and given.size is not None:
        raise ValueError(f"--size goes with frames on standard input (-), not with {given.source}")
    if given.steady > 0 and given.file is not None:
        remedy = f"rsvib run FRAMES OUT --video --steady {given.steady:g}"
        raise ValueError(f"--steady of a file needs frames that come later; process a video with {remedy}")


def _outputs(given: LiveOptions, settings: Config, stream: BinaryIO | None) -> list[video.FrameOutput]:
    outputs: list[video.FrameOutput] = []
    if given.written is not None:
        outputs.append(video.VideoOutput(given.written, settings.timing.frame_rate, overwrite=given.overwrite))
    if stream is not None:
        outputs.append(video.PipeOutput(stream))
    return outputs


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
