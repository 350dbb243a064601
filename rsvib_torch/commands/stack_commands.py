"""Commands that detect and remove vibration: ``simulate``, ``detect``, ``restore``, ``run`` and ``report``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import rsvib_torch
from rsvib_torch import detection, imaging, io, stacks
from rsvib_torch import report as reports
from rsvib_torch.commands.options import (
    DeviceName,
    DeviceOption,
    ForceOption,
    FramesArgument,
    JointOption,
    MemoryOption,
    MethodOption,
    Overrides,
    PriorOption,
    RestoredArgument,
    SaturationOption,
    ScaleOption,
    WorkersOption,
    camera_options,
    full_scale_of,
    restoration_options,
    torch_device,
)
from rsvib_torch.commands.terminal import (
    counting,
    error_line,
    print_detection,
    print_line,
    print_restoration,
    working,
)
from rsvib_torch.config import Config
from rsvib_torch.core.option_types import DEFAULT_WINDOW, BadFrames
from rsvib_torch.core.validation import validate

if TYPE_CHECKING:
    from torch import Tensor

    from rsvib_torch.detection import DetectionResult
    from rsvib_torch.io import StackInfo
    from rsvib_torch.motion.timing import SensorTiming
    from rsvib_torch.report import Box
    from rsvib_torch.restoration.verdict.trust import Detected
    from rsvib_torch.stacks import RestoredFrames, WindowResult
    from rsvib_torch.stacks.job import RestoreOptions

__all__ = ["Stack", "detect", "load", "report", "restore_frames", "run", "save", "simulate"]


@dataclass(frozen=True)
class Stack:
    """Frames in memory.

    Attributes:
        frames: (T, H, W) or (T, C, H, W), full scale 1.
        info: Data type and metadata of the file, with exposure times for frame times.
        full_scale: Count that corresponds to full scale; None for floating point.
        timing: The sensor, with the frame times of the file.
    """

    frames: Tensor
    info: StackInfo
    full_scale: float | None
    timing: SensorTiming


def load(path: Path, config: Config, full_scale: float | None, device: DeviceName) -> Stack:
    """Read a stack; ``full_scale`` and ``device`` are options of the command line."""
    target = torch_device(device)
    info = io.read_stack_info(path)
    scale = full_scale_of(path, info, config, full_scale)
    with working(f"reading {path}"):
        frames = io.read_stack(path, full_scale=scale)
    timing = io.timing_from_first_frame(config.timing, info)
    info = replace(info, frame_times=io.exposure_times(info, config.timing), times_of_playback=False)
    return Stack(frames.to(target), info, scale, timing)


def save(path: Path, frames: Tensor, stack: Stack) -> None:
    """Write frames with the data type, full scale and metadata of a stack."""
    with working(f"writing {path.name}"):
        io.write_stack(path, frames, dtype=stack.info.dtype, full_scale=stack.full_scale, like=stack.info)


def _detect(stack: Stack, config: Config) -> DetectionResult:
    with working("detecting the vibration"):
        result: DetectionResult = detection.detect_vibration(stack.frames, stack.timing, **config.detection)
    return result


def _restore(stack: Stack, detected: Detected, options: dict[str, Any], force: bool) -> RestoredFrames:
    """Restore frames, judge the result on eight pairs of frames, and print the verdict."""
    with working("restoring the frames and judging the result"):
        result = stacks.restore_trusted(stack.frames, stack.timing, detected, options, force=force, most_pairs=8)
    print_restoration(result)
    return result


def _write_detection(folder: Path, result: DetectionResult, timing: SensorTiming) -> list[str]:
    """Write a detection as JSON, CSV and figure, and return the names of the files."""
    with working("drawing the offset curve"):
        reports.write_vibration(folder / "vibration.json", result, timing)
        reports.write_offsets(folder / "offsets.csv", result)
        reports.save_figure(reports.offset_figure(result), folder / "offsets.png")
    return ["vibration.json", "offsets.csv", "offsets.png"]


@camera_options
def simulate(
    scene: Annotated[Path, typer.Argument(help="Image of the scene at rest, larger than the frames.")],
    frames: Annotated[Path, typer.Argument(help="Stack to write.")],
    *,
    settings: Config,
    device: DeviceOption = "auto",
    full_scale: Annotated[
        float | None, typer.Option(help="Count of the scene's file that corresponds to full scale.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the noise.", min=0, show_default="from the configuration")
    ] = None,
) -> None:
    """Simulate frames of a vibrating camera.

    The camera, its vibration and its noise are described in the configuration file.
    """
    import torch  # noqa: PLC0415

    if settings.simulation is None:
        raise ValueError(
            f"{settings.source}: simulation: missing key; expected a table with vibration, num_frames, ..."
        )
    simulation, target = settings.simulation, torch_device(device)
    image = io.read_stack(scene, full_scale=full_scale)
    if len(image) != 1:
        raise ValueError(f"{scene}: the scene must be one image, this file has {len(image)} frames")
    scale = settings.full_scale
    dtype = "float32" if scale is None else "uint8" if scale <= 255 else "uint16"
    io.check_stack_target(frames, (simulation.num_frames, *image.shape[1:]), dtype=dtype, full_scale=scale)
    with working("simulating the frames"):
        simulated = imaging.simulate_frames(
            image[0].to(target),
            settings.timing,
            simulation.vibration,
            simulation.num_frames,
            frame_size=simulation.frame_size,
            noise=simulation.noise,
            generator=torch.Generator(target).manual_seed(simulation.seed if seed is None else seed),
        )
    with working(f"writing {frames}"):
        io.write_stack(frames, simulated, dtype=dtype, full_scale=scale)
    print_line(f"{frames}: {len(simulated)} frames of {simulated.shape[-2]} x {simulated.shape[-1]} px, {dtype}")


@camera_options
def detect(
    frames: FramesArgument,
    *,
    settings: Config,
    out: Annotated[Path, typer.Option(help="Folder for vibration.json, offsets.csv and offsets.png.")],
    window: Annotated[
        int | None,
        typer.Option(
            help="Detect separately in windows of at most this number of frames; writes manifest.json and windows.csv.",
            show_default="from the configuration, or all frames together",
        ),
    ] = None,
    memory: MemoryOption = None,
    workers: WorkersOption = None,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect the vibration in a stack of frames.

    The vibration is modelled as sinusoids of constant amplitude and frequency. For other motion see rsvib motion.
    """
    io.check_writable(out, folder=True)
    window = settings.stack.get("window") if window is None else window
    if window is None:
        stack = load(frames, settings, full_scale, device)
        result = _detect(stack, settings)
        with io.whole_folder(out) as folder:
            names = _write_detection(folder, result, stack.timing)
        print_detection(result)
        print_line(f"{out}: {', '.join(names)}")
        return
    scale = full_scale_of(frames, io.read_stack_info(frames), settings, full_scale)
    with io.whole_folder(out) as folder:
        with counting(f"detecting in {frames.name}") as progress:
            stacks.detect_stack(
                frames,
                folder / "manifest.json",
                settings.timing,
                window=window,
                detection=settings.detection,
                full_scale=scale,
                memory=memory,
                workers=workers,
                device=str(torch_device(device)),
                progress=progress,
            )
        manifest = stacks.read_manifest(folder / "manifest.json")
        reports.write_windows(folder / "windows.csv", manifest)
    _warn_of_failures(sum(record.error is not None for record in manifest.windows))
    print_line(f"{out}: manifest.json, windows.csv, {len(manifest.windows)} windows")


def _warn_of_failures(windows: int) -> None:
    if windows:
        error_line(f"detection failed in {windows} windows: see manifest.json", "warning")


@camera_options
def restore_frames(
    frames: FramesArgument,
    restored: RestoredArgument,
    *,
    settings: Config,
    vibration: Annotated[
        Path, typer.Option(help="The vibration.json, or manifest.json of windows, written by detect or run.")
    ],
    method: MethodOption = None,
    joint: JointOption = None,
    prior: PriorOption = None,
    saturation: SaturationOption = None,
    force: ForceOption = False,
    report: Annotated[
        Path | None, typer.Option(help="JSON file to write: whether restoration helped, with the measured values.")
    ] = None,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Restore a stack of frames with a detected vibration, and judge the result.

    If the restored frames are judged no better than the input, the input is written unchanged, unless --force is given.
    """
    overrides = Overrides(method, joint, prior, saturation)
    with vibration.open("rb") as file:
        is_manifest = b'"rsvib stack"' in file.read(200)  # bytes; the format is the first key of either file
    if is_manifest:
        if report is not None:
            raise ValueError("--report needs a vibration.json; the verdict on each window is in its manifest.json")
        _restore_windows(frames, restored, settings, vibration, overrides, force, device, full_scale)
        return
    detected = reports.read_vibration(
        vibration, io.timing_from_first_frame(settings.timing, io.read_stack_info(frames))
    )
    stack = load(frames, settings, full_scale, device)
    shape = (1, *stack.info.shape[1:]) if joint == "all" else stack.info.shape
    io.check_stack_target(restored, shape, dtype=stack.info.dtype, full_scale=stack.full_scale)
    if report is not None:
        io.check_writable(report)
    options = restoration_options(stack.info, stack.full_scale, settings, overrides)
    result = _restore(stack, detected, options, force)
    save(restored, result.frames, stack)
    if report is not None:
        reports.write_restoration(report, result, options)
    state = "restored" if result.restored else "unchanged"
    print_line(f"{restored}: {len(result.frames)} frames {state}, {stack.info.dtype}")


def _restore_windows(
    frames: Path,
    restored: Path,
    config: Config,
    vibration: Path,
    overrides: Overrides,
    force: bool,
    device: DeviceName,
    full_scale: float | None,
) -> None:
    """Restore a stack with the detections of its windows."""
    from rsvib_torch.io.schema import TimingRecord, check_same_timing  # noqa: PLC0415

    manifest = stacks.read_manifest(vibration)
    stored = validate(TimingRecord, manifest.settings.get("sensor", {}), f"{vibration}: settings.sensor")
    timing = config.timing
    if timing.frame_start_times is None:  # frame times of the file were stored with the detection
        timing = replace(timing, frame_start_times=stored.frame_start_times)
    check_same_timing(str(vibration), stored, timing)
    window = manifest.settings.get("window")
    if not isinstance(window, int):
        raise ValueError(f"{vibration}: settings.window: missing key; expected a whole number")
    info = io.read_stack_info(frames)
    scale = full_scale_of(frames, info, config, full_scale)
    with counting(f"restoring {frames.name}") as progress:
        result = stacks.process_stack(
            frames,
            restored,
            config.timing,
            window=window,
            given=manifest.detections(),
            restoration=restoration_options(info, scale, config, overrides),
            full_scale=scale,
            force=force,
            device=str(torch_device(device)),
            progress=progress,
        )
    print_line(f"{restored}: {result.frames} frames in {result.windows} windows, {result.restored} windows restored")


@camera_options
def run(
    frames: FramesArgument,
    out: Annotated[Path, typer.Argument(help="Folder for the restored frames, the vibration and the figures.")],
    *,
    settings: Config,
    output: Annotated[
        str,
        typer.Option(help="Name of the restored stack in that folder; its extension selects the format."),
    ] = "restored.tif",
    compression: Annotated[str | None, typer.Option(help="Compression of a TIFF stack: zlib or lzma.")] = None,
    method: MethodOption = None,
    joint: JointOption = None,
    prior: PriorOption = None,
    saturation: SaturationOption = None,
    force: ForceOption = False,
    window: Annotated[
        int | None,
        typer.Option(
            help="Largest number of frames that are processed together; longer stacks are divided into windows.",
            show_default=f"from the configuration, or {DEFAULT_WINDOW}",
        ),
    ] = None,
    bad_frames: Annotated[
        BadFrames | None,
        typer.Option(
            help="Frames that cannot be read or used: 'pass' writes them unchanged, 'skip' leaves them out.",
            show_default="from the configuration, or pass",
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
    memory: MemoryOption = None,
    workers: WorkersOption = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Compute with Dask: address of a scheduler (tcp://HOST:PORT), or 'local' for processes on this "
            "machine.",
        ),
    ] = None,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect the vibration, restore the frames, judge the result and draw figures.

    Stacks of any length are processed in windows. If the restored frames are judged no better than the input, the
    input is written unchanged, unless --force is given. Ctrl-C stops after the current windows; --resume continues.
    """
    if Path(output).name != output or output in ("", ".", ".."):
        raise ValueError(f"--output must be a file name without a folder, got {output!r}")
    io.check_writable(out, folder=True)
    info = io.read_stack_info(frames)
    scale = full_scale_of(frames, info, settings, full_scale)
    options = restoration_options(info, scale, settings, Overrides(method, joint, prior, saturation))
    common: RestoreOptions = {
        "window": settings.stack.get("window", DEFAULT_WINDOW) if window is None else window,
        "detection": settings.detection,
        "restoration": options,
        "full_scale": scale,
        "force": force,
        "memory": memory,
        "workers": workers,
        "device": str(torch_device(device)),
    }
    with counting(f"restoring {frames.name}") as progress:
        result = stacks.process_stack(
            frames,
            out / output,
            settings.timing,
            **common,
            bad_frames=bad_frames or settings.stack.get("bad_frames", "pass"),
            scheduler=scheduler,
            compression=compression,
            resume=resume,
            manifest=out / "manifest.json",
            progress=progress,
        )
    first = result.first
    if first is None:  # the run was complete before, or its first window was
        first = next(iter(stacks.iterate_stack(frames, settings.timing, **common)))
    names = [output, "manifest.json"]
    with io.whole_folder(out) as folder:
        if result.windows == 1:
            assert isinstance(first.detection, detection.DetectionResult)
            assert first.restoration is not None
            reports.write_restoration(folder / "restoration.json", first.restoration, options)
            timing = io.timing_from_first_frame(settings.timing, info)
            names += ["restoration.json", *_write_detection(folder, first.detection, timing)]
        else:
            reports.write_windows(folder / "windows.csv", stacks.read_manifest(out / "manifest.json"))
            names.append("windows.csv")
        if len(first.frames):
            with working("drawing input and restored frame"):
                _draw_comparison(folder / "before_after.png", frames, scale, first)
            names.append("before_after.png")
    if result.windows == 1:
        if isinstance(first.detection, detection.DetectionResult):
            print_detection(first.detection)
        if first.restoration is not None:
            print_restoration(first.restoration)
    else:
        rate = f", {result.seconds / result.frames:.2f} s per frame" if result.frames and not result.resumed else ""
        print_line(f"{result.frames} frames in {result.windows} windows, {result.restored} windows restored{rate}")
        if result.resumed:
            print_line(f"{result.resumed} windows were complete before this run")
        _warn_of_failures(result.failed)
    if result.bad_frames:
        error_line(f"{result.bad_frames} frames could not be used: see manifest.json", "warning")
    print_line(f"{out}: {', '.join(names)}")


def _draw_comparison(path: Path, frames: Path, full_scale: float | None, first: WindowResult) -> None:
    """Draw the first restored frame of a stack beside the frame of the input."""
    from rsvib_torch.io.full_scale import counts_to_frames  # noqa: PLC0415

    index = first.indices[0] if first.indices else (first.window.first + first.window.last + 1) // 2
    reader = io.open_stack(frames)
    raw = counts_to_frames(reader.frame(index)[None], full_scale or reader.info.full_scale, str(frames))[0]
    reader.close()
    names = ("input", "restored" if first.restored else "unchanged")
    reports.save_figure(reports.comparison_figure(raw, first.frames[0].cpu(), names=names), path)


@camera_options
def report(
    frames: FramesArgument,
    out: Annotated[Path, typer.Argument(help="Folder for report.html and its figures.")],
    *,
    settings: Config,
    edge: Annotated[
        list[str] | None,
        typer.Option(
            help="Slanted edge to measure: TOP,LEFT,HEIGHT,WIDTH in px; may be given several times.",
            show_default="edges are searched for",
        ),
    ] = None,
    method: MethodOption = None,
    joint: JointOption = None,
    prior: PriorOption = None,
    saturation: SaturationOption = None,
    force: ForceOption = False,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect, restore and judge as rsvib run does, and write a report as an HTML page with figures.

    The page is one file that needs no network. The figures are also written as PNG files.
    """
    boxes = [_edge_box(text) for text in edge or []]
    io.check_writable(out, folder=True)
    stack = load(frames, settings, full_scale, device)
    options = restoration_options(stack.info, stack.full_scale, settings, Overrides(method, joint, prior, saturation))
    detection = _detect(stack, settings)
    print_detection(detection)
    result = _restore(stack, detection, options, force)
    content = reports.Report(
        title=f"Vibration in {frames.name}",
        subtitle=f"{frames}, camera of {settings.source}",
        frames=stack.frames,
        restored=result.frames,
        was_restored=result.restored,
        timing=stack.timing,
        detection=detection,
        verdict=result.verdict,
        left_alone=result.left_alone,
        options=options,
        version=rsvib_torch.__version__,
    )
    with io.whole_folder(out) as folder, working("writing the page"):
        files = reports.write_report_page(folder, content, boxes or None)
    print_line(f"{out}: {', '.join(files)}")


def _edge_box(text: str) -> Box:
    """Position of a slanted edge (top, left, height, width) in px."""
    numbers = [part.strip() for part in text.split(",")]
    if len(numbers) != 4 or not all(number.isdecimal() for number in numbers):
        raise ValueError(f"--edge must be TOP,LEFT,HEIGHT,WIDTH in px, got {text!r}")
    top, left, height, width = map(int, numbers)
    return top, left, height, width
