"""``rsvib run``, and ``rsvib detect`` and ``rsvib restore`` of stacks in windows."""

import csv
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from rsvib_torch.commands.options import (
    ConfigOption,
    DeviceOption,
    ForceOption,
    FramesArgument,
    JointOption,
    MemoryOption,
    MethodOption,
    PriorOption,
    SaturationOption,
    ScaleOption,
    WindowOption,
    WorkersOption,
)
from rsvib_torch.commands.terminal import counting, error_line, say, show_result, working
from rsvib_torch.commands.workflow import (
    DeviceName,
    Restored,
    Wishes,
    chosen_device,
    full_scale_of,
    restoration_options,
    tell_restoration,
    write_detection,
)
from rsvib_torch.config import Config, read_config
from rsvib_torch.core.checks import check_choice
from rsvib_torch.core.validation import validate
from rsvib_torch.detection import DetectionResult
from rsvib_torch.io import check_writable, open_stack, read_stack_info, timing_from_first_frame, whole_folder
from rsvib_torch.io.full_scale import counts_to_frames
from rsvib_torch.io.schema import TimingRecord, check_same_timing
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.report.plots import comparison_figure, save_figure
from rsvib_torch.stacks import (
    DEFAULT_WINDOW,
    StackManifest,
    StackReport,
    WindowResult,
    detect_stack,
    iterate_stack,
    process_stack,
    read_manifest,
)

__all__ = ["detect_windows", "restore_windows", "run", "window_of"]

_BAD_FRAMES = ("pass", "skip")


def window_of(config: Config, option: int | None) -> int:
    """Most frames of a window: the option first, then the config."""
    return int(config.stack.get("window", DEFAULT_WINDOW)) if option is None else option


def _bad_frames(config: Config, option: str | None) -> Any:
    chosen = config.stack.get("bad_frames", "pass") if option is None else option
    check_choice("--bad-frames", chosen, _BAD_FRAMES)
    return chosen


def run(
    frames: FramesArgument,
    out: Annotated[Path, typer.Argument(help="Folder for the restored frames, the vibration and the pictures.")],
    *,
    config: ConfigOption,
    output: Annotated[
        str, typer.Option("--output", help="Name of the restored stack in that folder; its ending tells the format.")
    ] = "restored.tif",
    compression: Annotated[
        str | None, typer.Option("--compression", help="Compress a TIFF stack: zlib or lzma.")
    ] = None,
    method: MethodOption = None,
    joint: JointOption = None,
    prior: PriorOption = None,
    saturation: SaturationOption = None,
    force: ForceOption = False,
    window: WindowOption = None,
    bad_frames: Annotated[
        str | None,
        typer.Option(
            "--bad-frames",
            help="Frames that cannot be read or used: 'pass' them on as they are, or 'skip' them.",
            show_default="the config's, or pass",
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was broken off.")] = False,
    memory: MemoryOption = None,
    workers: WorkersOption = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler", help="Compute with Dask: tcp://HOST:PORT, or 'local' for processes on this machine."
        ),
    ] = None,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect the vibration, restore the frames, judge whether that helps, and draw pictures.

    Stacks may be of any length: they are gone through in windows. Where restored frames are no better than the raw
    ones, the raw ones are written, unless forced. Ctrl-C stops when the windows at work are done; --resume goes on.
    """
    settings = read_config(config)
    if Path(output).name != output or output in ("", ".", ".."):
        raise ValueError(f"--output must be a name without a folder, got {output!r}")
    check_writable(out, folder=True)
    info = read_stack_info(frames)
    scale = full_scale_of(frames, info, settings, full_scale)
    options = restoration_options(info, scale, settings, Wishes(method, joint, prior, saturation, force))
    common: dict[str, Any] = {
        "window": window_of(settings, window),
        "detection": settings.detection,
        "restoration": options,
        "full_scale": scale,
        "force": force,
        "memory": memory,
        "workers": workers,
        "device": str(chosen_device(device)),
    }
    with counting(f"restoring {frames.name}") as progress:
        report = process_stack(
            frames,
            out / output,
            settings.timing,
            **common,
            bad_frames=_bad_frames(settings, bad_frames),
            scheduler=scheduler,
            compression=compression,
            resume=resume,
            manifest=out / "manifest.json",
            progress=progress,
        )
    first = report.first
    if first is None:
        first = next(iter(iterate_stack(frames, settings.timing, **common)))
    names = [output, "manifest.json"]
    with whole_folder(out) as folder:
        if report.windows == 1:
            _write_single(folder, first, options, timing_from_first_frame(settings.timing, info))
            names += ["restoration.json", "vibration.json", "offsets.csv", "offsets.png"]
        else:
            _write_table(folder / "windows.csv", read_manifest(out / "manifest.json"))
            names.append("windows.csv")
        with working("drawing before and after"):
            if _draw(folder / "before_after.png", frames, scale, first):
                names.append("before_after.png")
    _tell(report, first)
    say(f"{out}: {', '.join(names)}")


def _write_single(folder: Path, result: WindowResult, options: dict[str, Any], timing: SensorTiming) -> None:
    """What is written of a stack that is one window."""
    restoration = result.restoration
    assert isinstance(result.detection, DetectionResult)
    assert restoration is not None
    write_detection(folder, result.detection, timing)
    told = Restored(result.frames, result.restored, options, restoration.left_alone, restoration.verdict)
    told.write_report(folder / "restoration.json")


def _tell(report: StackReport, first: WindowResult) -> None:
    """The result in words."""
    if report.windows == 1:
        if isinstance(first.detection, DetectionResult):
            show_result(first.detection)
        if first.restoration is not None:
            tell_restoration(first.restoration)
    else:
        rate = f", {report.seconds / report.frames:.2f} s a frame" if report.frames and not report.resumed else ""
        say(f"{report.frames} frames in {report.windows} windows, {report.restored} of them restored{rate}")
        if report.resumed:
            say(f"{report.resumed} windows were there already")
        if report.failed:
            error_line(f"in {report.failed} windows nothing could be detected: see manifest.json", "warning")
    if report.bad_frames:
        error_line(f"{report.bad_frames} frames could not be used: see manifest.json", "warning")


def _draw(path: Path, frames: Path, full_scale: float | None, first: WindowResult) -> bool:
    """Draw a frame before and after; False where there is none."""
    if not len(first.frames):
        return False
    shown = first.indices[0] if first.indices else (first.window.first + first.window.last + 1) // 2
    reader = open_stack(frames)
    raw = counts_to_frames(reader.frame(shown)[None], full_scale or reader.info.full_scale, str(frames))[0]
    reader.close()
    names = ("as taken", "restored" if first.restored else "left as taken")
    save_figure(comparison_figure(raw, first.frames[0].cpu(), names=names), path)
    return True


_COLUMNS = ("amplitude", "frequency", "phase")


def _table(manifest: StackManifest) -> Iterable[list[Any]]:
    """One line a window: the strongest tone of each axis, and what became of the window."""
    head: list[Any] = ["window", "first_frame", "last_frame", "start_s"]
    for letter in "xy":
        head += [f"{name}_{letter}{end}" for name in _COLUMNS for end in ("", "_std")]
        head += [f"image_motion_{letter}", f"reliable_{letter}"]
    yield [*head, "frames", "outcome", "bad_frames", "note"]
    for record in manifest.windows:
        line: list[Any] = [record.window, record.first, record.last, record.start_time]
        found = record.detection
        for axis in (0, 1):
            if found is None:
                line += [None] * (2 * len(_COLUMNS) + 2)
                continue
            for name in _COLUMNS:
                line.extend((getattr(found.vibration, name)[axis][0], getattr(found.std, name)[axis][0]))
            line.extend((found.vibration.image_motion[axis], found.reliable[axis]))
        note = record.error or "; ".join(record.left_alone)
        yield [*line, record.frames, record.outcome, len(record.bad_frames), note]


def _write_table(path: Path, manifest: StackManifest) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(_table(manifest))


def detect_windows(
    frames: Path,
    config: Config,
    out: Path,
    window: int,
    *,
    device: DeviceName,
    full_scale: float | None,
    memory: str | None,
    workers: int | None,
) -> None:
    """Detect the vibration in every window of a stack: ``manifest.json`` and ``windows.csv``."""
    check_writable(out, folder=True)
    info = read_stack_info(frames)
    scale = full_scale_of(frames, info, config, full_scale)
    with whole_folder(out) as folder:
        with counting(f"detecting in {frames.name}") as progress:
            detect_stack(
                frames,
                folder / "manifest.json",
                config.timing,
                window=window,
                detection=config.detection,
                full_scale=scale,
                memory=memory,
                workers=workers,
                device=str(chosen_device(device)),
                progress=progress,
            )
        manifest = read_manifest(folder / "manifest.json")
        _write_table(folder / "windows.csv", manifest)
    failed = sum(record.error is not None for record in manifest.windows)
    if failed:
        error_line(f"in {failed} windows nothing could be detected: see manifest.json", "warning")
    say(f"{out}: manifest.json, windows.csv, {len(manifest.windows)} windows")


def restore_windows(
    frames: Path,
    restored: Path,
    config: Config,
    manifest: StackManifest,
    wishes: Wishes,
    *,
    device: DeviceName,
    full_scale: float | None,
) -> StackReport:
    """Restore a stack with what was detected in its windows.

    Raises:
        ValueError: If the windows are those of another camera.
    """
    stored = validate(TimingRecord, manifest.settings.get("sensor", {}), "manifest.json: settings.sensor")
    if config.timing.frame_start_times is None:  # the frames' file may hold their times
        check_same_timing("manifest.json", stored, replace(config.timing, frame_start_times=stored.frame_start_times))
    else:
        check_same_timing("manifest.json", stored, config.timing)
    window = manifest.settings.get("window")
    if not isinstance(window, int):
        raise ValueError("manifest.json: settings.window: missing key; expected a whole number")
    info = read_stack_info(frames)
    scale = full_scale_of(frames, info, config, full_scale)
    with counting(f"restoring {frames.name}") as progress:
        report = process_stack(
            frames,
            restored,
            replace(config.timing),
            window=window,
            given=manifest.detections(),
            restoration=restoration_options(info, scale, config, wishes),
            full_scale=scale,
            force=wishes.force,
            device=str(chosen_device(device)),
            progress=progress,
        )
    say(f"{restored}: {report.frames} frames in {report.windows} windows, {report.restored} of them restored")
    return report
