"""The command ``live``: follow the vibration of a running camera."""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Literal

import typer

from rsvib_torch import io, live, tracking
from rsvib_torch.commands.answers import detection_data
from rsvib_torch.commands.shared_options import (
    CameraSettings,
    OverwriteOption,
    ScaleOption,
    SourceArgument,
    check_new,
    file_of_source,
)
from rsvib_torch.commands.terminal import Answer, error_line
from rsvib_torch.config import Config
from rsvib_torch.core.atomic import check_writable
from rsvib_torch.core.checks import check_number
from rsvib_torch.core.text import number_of
from rsvib_torch.options import METHOD_OPTIONS, BorderName, TrackerOptions, method_options

if TYPE_CHECKING:
    from rsvib_torch.live import FrameOutput, FrameSource, LiveReport
    from rsvib_torch.tracking import TrackedFrame, VibrationTracker

PixelFormatName = Literal["gray8", "gray16le", "rgb24", "bgr24"]


def live_session(
    source: SourceArgument,
    *,
    settings: CameraSettings,
    out: Annotated[
        Path | None, typer.Option(help="Video to write (.mp4, .mov, .m4v, .mkv), or - for raw frames to stdout.")
    ] = None,
    page: Annotated[
        int | None,
        typer.Option(metavar="PORT", help="Show the restored frames at http://127.0.0.1:PORT.", min=0, max=65535),
    ] = None,
    preview: Annotated[bool, typer.Option("--preview", help="Show the restored frames in a window.")] = False,
    spectrogram: Annotated[
        Path | None, typer.Option(metavar="NAME", help="Write the spectrogram of both axes: NAME.png and NAME.zarr.")
    ] = None,
    max_frequency: Annotated[float, typer.Option(metavar="HZ", help="Highest frequency of the spectrogram.")] = 250.0,
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Size of the frames on standard input, e.g. 1024x768.")
    ] = None,
    pixel_format: Annotated[PixelFormatName, typer.Option(help="Pixels of the frames on standard input.")] = "gray8",
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Read a file at its own rate, and drop frames like a camera.")
    ] = False,
    method: Annotated[
        str | None,
        typer.Option(
            help=f"Restoration method: {', '.join(METHOD_OPTIONS)}.", show_default="from the configuration, or dewarp"
        ),
    ] = None,
    columns: Annotated[
        int | None, typer.Option(help="Columns that are measured: those with the most detail.", min=64)
    ] = TrackerOptions.columns,
    window: Annotated[
        int, typer.Option(help="Frames from which the vibration is detected at first.", min=2)
    ] = TrackerOptions.window,
    steady: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            help="Stabilise the image to a straight line through the last part of its path (a camera; a file with "
            "--realtime).",
        ),
    ] = 0.0,
    border: Annotated[
        BorderName,
        typer.Option(
            help="Pixels that the sensor did not record: mirror, extrapolated; hold, as in the frame before; crop is "
            "available for videos (rsvib run --video)."
        ),
    ] = "mirror",
    waiting: Annotated[int, typer.Option(help="Frames that wait before the oldest ones are dropped.", min=1)] = 64,
    num_frames: Annotated[int | None, typer.Option(help="Stop after this number of frames.", min=2)] = None,
    full_scale: ScaleOption = None,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Follow the vibration of a running camera, and restore its frames.

    The source is never blocked: if frames come faster than they are processed, the oldest waiting ones are dropped and
    counted. Ctrl-C ends the session. The video can be played at any moment, also after a crash or on a full disk.
    """
    is_camera, is_file = source.isdecimal() or "://" in source, file_of_source(source) is not None
    check_number("steady", steady, at_least=0.0)
    _check_options(source, out, size, realtime, border, steady, is_file=is_file)
    pipe_out = out is not None and str(out) == "-"
    files = [] if out is None or pipe_out else [out]
    saved = []
    if spectrogram is not None:
        saved = [spectrogram.with_name(spectrogram.name + ending) for ending in (".png", ".zarr")]
    check_new([*files, *saved], overwrite, [*(io.stack_files(Path(source)) if is_file else []), settings.path])
    for path in [*files, *saved]:
        check_writable(path)
    options = dict(settings.restoration)
    name: Any = method or options.get("method", "dewarp")
    options = {key: value for key, value in options.items() if key in method_options(name) and key != "joint"}

    def opened() -> FrameSource:
        if is_camera:
            return live.CameraSource(int(source) if source.isdecimal() else source, settings.timing)
        if source == "-":
            # not sys.stdin.buffer: Python aborts at the exit if a thread still waits in it
            stream = os.fdopen(sys.stdin.fileno(), "rb", closefd=False)
            return live.PipeSource(stream, _size(size or ""), pixel_format, settings.timing)
        scale = full_scale if full_scale is not None else settings.full_scale
        return live.FileSource(Path(source), settings.timing, scale, realtime=realtime)

    drops = not is_file or realtime

    def tracker(scale: float | None) -> VibrationTracker:
        return tracking.VibrationTracker(
            settings.timing,
            window=window,
            columns=columns,
            method=name,
            steady=steady,
            wobble=steady > 0,
            full_scale=full_scale if full_scale is not None and not is_file else scale,
            channels="first",
            **options,
        )

    frames_of = opened()
    with _frames_on_standard_output(enabled=pipe_out) as stream:
        outputs = _outputs(settings, preview, page, stream, None if pipe_out else out, overwrite)
        shown = [output for output in outputs if isinstance(output, live.PageOutput)]
        collected = None if spectrogram is None else live.Spectrogram(settings.timing, max_frequency=max_frequency)

        def save() -> None:
            if collected is not None and spectrogram is not None:
                check_new(saved, overwrite, [])  # another program may have written them meanwhile
                live.save_spectrogram(spectrogram, collected)

        report = live.run_live(
            frames_of,
            tracker(frames_of.full_scale),
            outputs,
            border=tracking.VideoBorder(border),
            drops=drops,
            waiting=waiting,
            max_frames=num_frames,
            spectrogram=collected,
            progress=_StateText(shown[0]) if shown else None,
            save=save,
        )
    if report.frames == 0:
        raise ValueError(f"{source}: no frame was read")
    if report.dropped or report.lost:
        error_line(_missing(report), "warning")
    return _answer(source, report, [*files, *saved], drops=drops)


def _check_options(
    source: str, out: Path | None, size: str | None, realtime: bool, border: str, steady: float, *, is_file: bool
) -> None:
    """Refuse options that do not go with the source."""
    if source == "-" and size is None:
        raise ValueError("--size WIDTHxHEIGHT is required for raw frames on standard input")
    if source == "-" and size is not None:
        _size(size)
    if source != "-" and size is not None:
        raise ValueError(f"--size goes with frames on standard input (-), not with {source}")
    if realtime and not is_file:
        raise ValueError(f"--realtime goes with a file, not with {source}: a camera has its own rate")
    if border == "crop" or (steady > 0 and is_file and not realtime):
        option = "--border crop" if border == "crop" else "--steady of a file"
        remedy = f"rsvib run FRAMES OUT --video --steady {steady:g} --border {border}"
        raise ValueError(f"{option} needs frames that come later; process a video with {remedy}")


def _outputs(
    settings: Config, preview: bool, page: int | None, stream: BinaryIO | None, out: Path | None, overwrite: bool
) -> list[FrameOutput]:
    """The outputs that the options name."""
    outputs: list[FrameOutput] = []
    if out is not None:
        outputs.append(live.VideoOutput(out, settings.timing.frame_rate, overwrite=overwrite))
    if stream is not None:
        outputs.append(live.PipeOutput(stream))
    if preview:
        outputs.append(live.PreviewOutput())
    if page is not None:  # the last one, because it is the only one that is opened before the first frame
        served = live.PageOutput(page)
        outputs.append(served)
        error_line(f"the page is {served.url}", "note")
    return outputs


def _size(text: str) -> tuple[int, int]:
    """(height, width) from ``WIDTHxHEIGHT``."""
    match = re.fullmatch(r"([1-9]\d{0,5})x([1-9]\d{0,5})", text.strip().lower())
    if match is None:
        raise ValueError(f"--size must be WIDTHxHEIGHT in px such as 1024x768, got {text!r}")
    return int(match[2]), int(match[1])


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


class _StateText:
    """Text below the frames of the page, twice per second."""

    def __init__(self, page: live.PageOutput) -> None:
        self._page, self._next, self._lock = page, 0.0, threading.Lock()

    def __call__(self, tracked: TrackedFrame, report: LiveReport) -> None:
        now = time.perf_counter()
        if now < self._next:
            return
        self._next = now + 0.5  # s
        found = tracked.detection
        lines = [f"time {tracked.time:.2f} s, {tracked.state}, {report.frames} frames written"]
        self._page.show_state("\n".join([*lines, *([] if found is None else [found.summary()])]))


def _missing(report: LiveReport) -> str:
    parts = []
    if report.dropped:
        parts.append(f"{number_of(report.dropped, 'frame')} dropped, because processing was too slow (fewer --columns)")
    if report.lost:
        parts.append(f"{number_of(report.lost, 'frame')} not delivered by the source")
    return "; ".join(parts)


def _answer(source: str, report: LiveReport, files: list[Path], *, drops: bool) -> Answer:
    rate = report.frames / report.seconds
    lines = [
        f"{number_of(report.frames, 'frame')} in {report.seconds:.1f} s ({rate:.1f} per second), "
        f"{report.tracked} with known motion",
        f"dropped {report.dropped}, not delivered {report.lost}, unusable {report.unusable}; vibration detected "
        f"{number_of(report.detections, 'time')}",
    ]
    if report.predicted:
        lines.append(f"{number_of(report.predicted, 'late frame')} predicted instead of measured")
    if drops:
        lines.append(
            f"delay: {report.latency(0.5)} frame periods in the median, {report.latency(0.99)} in 99 % of the frames"
        )
    found = report.detection
    data = {
        "frames": report.frames,
        "tracked": report.tracked,
        "predicted": report.predicted,
        "unusable": report.unusable,
        "dropped": report.dropped,
        "lost": report.lost,
        "detections": report.detections,
        "seconds": report.seconds,
        "delay_median": report.latency(0.5) if drops else None,
        "delay_99": report.latency(0.99) if drops else None,
        "detection": None if found is None else detection_data(found),
    }
    results = {f"Live frames of {source}": lines}
    if found is not None:
        results["Vibration at the last frame"] = [found.summary()]
    return Answer(results, data, files)
