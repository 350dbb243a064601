"""Commands that detect and remove vibration: ``simulate``, ``detect``, ``restore``, ``run`` and ``report``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import rsvib_torch
from rsvib_torch import detection, imaging, io, stacks
from rsvib_torch import report as reports
from rsvib_torch.commands.answers import (
    command_text,
    detection_data,
    in_metres,
    page_step,
    restoration_data,
    restoration_lines,
    step_parts,
    step_with_force,
    steps_after_detection,
)
from rsvib_torch.commands.flat_command import MadeBy, group_arguments
from rsvib_torch.commands.shared_options import (
    CameraSettings,
    DeviceName,
    DeviceOption,
    ForceOption,
    FramesArgument,
    MemoryOption,
    OverwriteOption,
    PixelSizeOption,
    RestorationArguments,
    RestoredArgument,
    ScaleOption,
    WorkersOption,
    check_new,
    full_scale_of,
    planned_restoration,
    restored_shape,
    torch_device,
)
from rsvib_torch.commands.terminal import Answer, counting, error_line, note, running_command, working
from rsvib_torch.commands.video_command import check_followed, is_followed, run_followed
from rsvib_torch.commands.written_results import (
    OF_DETECTION,
    OF_WINDOWS,
    check_folder,
    draw_safely,
    note_lost,
    remove_old,
    write_detection,
    write_windows,
)
from rsvib_torch.config import Config
from rsvib_torch.core.atomic import check_writable, whole_folder
from rsvib_torch.core.reading import check_regular
from rsvib_torch.core.text import number_of, printable
from rsvib_torch.options import BorderName, WindowOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch import Tensor

    from rsvib_torch.detection import DetectionResult
    from rsvib_torch.io import StackInfo
    from rsvib_torch.motion.detected_vibration import DetectedVibration
    from rsvib_torch.motion.motion import Motion
    from rsvib_torch.motion.timing import SensorTiming
    from rsvib_torch.report import Box
    from rsvib_torch.stacks import RestoredFrames, StackReport, WindowResult


@dataclass(frozen=True)
class Stack:
    """Frames in memory."""

    frames: Tensor  # (T, H, W) or (T, C, H, W), full scale 1
    info: StackInfo  # data type and metadata of the file, with exposure times for frame times
    full_scale: float | None  # count that corresponds to full scale; None for floating point
    timing: SensorTiming  # the sensor, with the frame times of the file


def load(
    path: Path,
    config: Config,
    full_scale: float | None,
    device: DeviceName,
    restoration: dict[str, Any] | None = None,
) -> Stack:
    """Read a stack that is processed as a whole, if the memory suffices for it and for the restoration that follows."""
    from rsvib_torch.stacks.memory import check_stack_fits  # noqa: PLC0415

    target = torch_device(device)
    info = io.read_stack_info(path)
    scale = full_scale_of(path, info, config, full_scale)
    check_stack_fits(info, restoration, on_gpu=target.type != "cpu")
    with working(f"reading {path}"):
        frames = io.read_stack(path, full_scale=scale)
    timing = io.timing_from_first_frame(config.timing, info)
    print_notes(info, config)
    times = io.exposure_times(info, config.timing)
    info = replace(info, frame_times=times, time_error=0.0, frame_rate=info.frame_rate or config.timing.frame_rate)
    return Stack(frames.to(target), info, scale, timing)


def print_notes(info: StackInfo, config: Config) -> None:
    """Print what the file states about orientation, dropped frames and unequal intervals."""
    for sentence in io.describe_stack(info, config.timing):
        note(sentence)


def _save(path: Path, frames: Tensor, stack: Stack) -> tuple[str, ...]:
    """Write frames with the data type, full scale and metadata of a stack; print and return what is not kept."""
    with working(f"writing {path.name}"):
        io.write_stack(path, frames, dtype=stack.info.dtype, full_scale=stack.full_scale, like=stack.info)
    names = io.metadata_not_kept(stack.info, path, tuple(frames.shape))
    note_lost(path, names)
    return names


def _detect(stack: Stack, config: Config) -> DetectionResult:
    with working("detecting the vibration"):
        result: DetectionResult = detection.detect_vibration(stack.frames, stack.timing, **config.detection)
    return result


def _restore(
    stack: Stack, motion: Motion | DetectedVibration, options: dict[str, Any], force: bool, output: str = "frames"
) -> RestoredFrames:
    """Restore frames, and judge the result on eight pairs of frames; ``output`` names what will be written."""
    with working("restoring and judging"):
        result = stacks.restore_trusted(stack.frames, stack.timing, motion, options, force=force, most_pairs=8)
    _warn_of_restoration(result, output)
    return result


def restore_and_save(
    path: Path,
    stack: Stack,
    motion: Motion | DetectedVibration,
    options: dict[str, Any],
    force: bool,
    report: Path | None = None,
) -> RestoredFrames:
    """Restore frames, and write them; the input unchanged if it is no worse, unless ``force``."""
    result = _restore(stack, motion, options, force)
    keeps = stack.info.nodata is not None
    not_kept = _save(path, stacks.without_data(result.frames, stack.frames) if keeps else result.frames, stack)
    if report is not None:
        reports.write_restoration(report, result, options, not_kept)
    return result


def _warn_of_restoration(result: RestoredFrames, output: str = "frames") -> None:
    """Print a warning if there is nothing to restore, or if restoration does not help or helps in part only."""
    kept = "the frames are written unchanged" if output == "frames" else "the page has the input frames only"
    forced = "writes" if output == "frames" else "shows"
    if not result.moves:
        error_line(f"no vibration to remove: {kept}", "warning")
    elif result.verdict is not None and result.verdict.overall in ("partly", "worse"):
        unchanged = "" if result.restored else f"; {kept}, --force {forced} the restored ones"
        error_line(result.verdict.sentence + unchanged, "warning")


def simulate(
    scene: Annotated[Path, typer.Argument(help="Image of the scene at rest, larger than the frames.")],
    frames: Annotated[Path, typer.Argument(help="Stack to write.")],
    *,
    settings: CameraSettings,
    device: DeviceOption = "auto",
    full_scale: Annotated[
        float | None, typer.Option(help="Count of the scene's file that corresponds to full scale.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the noise.", min=0, show_default="from the configuration")
    ] = None,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Simulate frames of a vibrating camera.

    The camera, its vibration and its noise are described in the configuration file.
    """
    import torch  # noqa: PLC0415

    check_new(io.stack_files(frames), overwrite, [*io.stack_files(scene), settings.path])
    if settings.simulation is None:
        raise ValueError(
            f"{settings.source}: simulation: missing key; expected a table with vibration, num_frames, ..."
        )
    simulation, target = settings.simulation, torch_device(device)
    vibration = simulation.vibration.to_vibration()
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
            vibration,
            simulation.num_frames,
            frame_size=simulation.frame_size,
            noise=simulation.noise,
            generator=torch.Generator(target).manual_seed(simulation.seed if seed is None else seed),
        )
    with working(f"writing {frames}"):
        stated = io.StackInfo(tuple(simulated.shape), dtype, scale, frame_rate=settings.timing.frame_rate)
        io.write_stack(frames, simulated, dtype=dtype, full_scale=scale, like=stated)
    line = f"{len(simulated)} frames of {simulated.shape[-2]} x {simulated.shape[-1]} px, {dtype}"
    run_it = command_text("run", frames, frames.with_name("results"), *settings.arguments)
    return Answer(
        {"Simulated frames": [line, f"vibration:\n{vibration}"]},
        {"shape": list(simulated.shape), "dtype": dtype, "vibration": vibration.to_dict()},
        [frames],
        [f"detect the vibration and restore the frames:\n  {run_it}"],
    )


def detect(
    frames: FramesArgument,
    *,
    settings: CameraSettings,
    out: Annotated[
        Path, typer.Option(help="Folder for vibration.json, tables (tones, offsets, spectrum) and figures.")
    ],
    window: Annotated[
        int | None,
        typer.Option(
            help="Detect separately in windows of at most this number of frames; writes manifest.json and tones.csv.",
            show_default="from the configuration, or all frames together",
        ),
    ] = None,
    pixel_size: PixelSizeOption = None,
    memory: MemoryOption = None,
    workers: WorkersOption = None,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Detect the vibration in a stack of frames.

    The vibration is modelled as sinusoids of constant amplitude and frequency. For other motion see rsvib motion.
    """
    check_folder(out, (*OF_DETECTION, *OF_WINDOWS), overwrite, [*io.stack_files(frames), settings.path])
    window = settings.stack.get("window") if window is None else window
    if window is None:
        stack = load(frames, settings, full_scale, device)
        result = _detect(stack, settings)
        with whole_folder(out) as folder:
            names = write_detection(folder, result, stack.timing, pixel_size)
        remove_old(out, (*OF_DETECTION, *OF_WINDOWS), names)
        return Answer(
            {f"Vibration in {frames.name}": [result.summary()], **in_metres(result, pixel_size)},
            {"detection": detection_data(result)},
            [out / name for name in names],
            steps_after_detection(result, frames, settings, out / "vibration.json"),
        )
    info = io.read_stack_info(frames)
    print_notes(info, settings)
    scale = full_scale_of(frames, info, settings, full_scale)
    with whole_folder(out) as folder:
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
        names = [*write_windows(folder, folder / "manifest.json", pixel_size), "manifest.json"]
    remove_old(out, OF_DETECTION, names)
    manifest = stacks.read_manifest(out / "manifest.json")
    _warn_of_failures(sum(record.error is not None for record in manifest.windows))
    return Answer(
        {f"Vibration in {len(manifest.windows)} windows of {frames.name}": manifest.lines(pixel_size)[0]},
        {"windows": manifest.totals()},
        [out / name for name in names],
        steps_after_detection(None, frames, settings, out / "manifest.json"),
    )


def _warn_of_failures(windows: int) -> None:
    if windows:
        error_line(f"detection failed in {number_of(windows, 'window')}: see manifest.json", "warning")


def restore_frames(
    frames: FramesArgument,
    restored: RestoredArgument,
    *,
    settings: CameraSettings,
    vibration: Annotated[
        Path, typer.Option(help="The vibration.json, or manifest.json of windows, written by detect or run.")
    ],
    restoration: RestorationArguments,
    force: ForceOption = False,
    report: Annotated[
        Path | None, typer.Option(help="JSON file to write: whether restoration helped, with the measured values.")
    ] = None,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Restore a stack of frames with a detected vibration, and judge the result.

    If the restored frames are judged no better than the input, the input is written unchanged, unless --force is given.
    """
    outputs, inputs = io.stack_files(restored), [*io.stack_files(frames), settings.path, vibration]
    check_new([*outputs, *([] if report is None else [report])], overwrite, inputs)
    check_regular(vibration)
    with vibration.open("rb") as file:
        is_manifest = b'"rsvib stack"' in file.read(200)  # bytes; the format is the first key of either file
    if is_manifest:
        if report is not None:
            raise ValueError("--report needs a vibration.json; the verdict on each window is in its manifest.json")
        check_new([*outputs, restored.with_name(f"{restored.name}.manifest.json")], overwrite, inputs)
        return _restore_windows(frames, restored, settings, vibration, restoration, force, device, full_scale)
    info, scale, options = planned_restoration(frames, settings, full_scale, restoration)
    detected = reports.read_vibration(vibration, io.timing_from_first_frame(settings.timing, info))
    io.check_stack_target(restored, restored_shape(info, options), dtype=info.dtype, full_scale=scale, like=info)
    if report is not None:
        check_writable(report)
    stack = load(frames, settings, full_scale, device, options)
    result = restore_and_save(restored, stack, detected, options, force, report)
    return Answer(
        {"Vibration": [detected.summary()], "Restoration": restoration_lines(result, len(stack.frames))},
        {"detection": detected.to_dict(), "restoration": restoration_data(result)},
        [restored, *([] if report is None else [report])],
        [page_step(frames, frames.with_name("report"), settings)] * result.restored,
    )


def _restore_windows(
    frames: Path,
    restored: Path,
    config: Config,
    vibration: Path,
    given: Mapping[str, Any],
    force: bool,
    device: DeviceName,
    full_scale: float | None,
) -> Answer:
    """Restore a stack with the detections of its windows."""
    from rsvib_torch.core.result_files import decode  # noqa: PLC0415
    from rsvib_torch.motion.timing import SensorTiming  # noqa: PLC0415
    from rsvib_torch.report.results import check_same_timing  # noqa: PLC0415

    manifest = stacks.read_manifest(vibration)
    stored = decode(SensorTiming, manifest.settings.get("sensor"), f"{vibration}: settings.sensor")
    timing = config.timing
    if timing.frame_start_times is None:  # frame times of the file were stored with the detection
        timing = replace(timing, frame_start_times=stored.frame_start_times)
    check_same_timing(str(vibration), stored, timing)
    window = manifest.settings.get("window")
    if "video" in manifest.settings:
        raise ValueError(
            f"{vibration}: it describes a video that was followed frame by frame, and its parts are not windows; "
            "detect the windows (rsvib detect --window 8), or repeat rsvib run --video"
        )
    if not isinstance(window, int):
        raise ValueError(f"{vibration}: settings.window: missing key; expected a whole number")
    info, scale, options = planned_restoration(frames, config, full_scale, given)
    print_notes(info, config)
    with counting(f"restoring {frames.name}") as progress:
        result = stacks.process_stack(
            frames,
            restored,
            config.timing,
            window=window,
            given=manifest.detections(),
            restoration=options,
            full_scale=scale,
            force=force,
            device=str(torch_device(device)),
            progress=progress,
        )
    note_lost(restored, result.not_kept)
    manifest = stacks.read_manifest(result.manifest)
    vibration_lines, lines = manifest.lines()
    return Answer(
        {"Vibration": vibration_lines, "Restoration": [result.summary(), *lines[1:]]},
        {"windows": manifest.totals()},
        [restored, result.manifest],
    )


def run(
    frames: FramesArgument,
    out: Annotated[Path, typer.Argument(help="Folder for the restored frames, the vibration and the figures.")],
    *,
    settings: CameraSettings,
    output: Annotated[
        str,
        typer.Option(
            help="Name of the restored stack in that folder; its extension selects the format, e.g. "
            ".mp4 or .mkv for a video with the time stamps and the sound of the input."
        ),
    ] = "restored.tif",
    video: Annotated[
        bool,
        typer.Option(
            "--video",
            help="Write a video: restored.mp4 (H.264) from .mp4, restored.mov from .mov, else restored.mkv (FFV1, "
            "without loss). Videos are followed frame by frame instead of in windows.",
        ),
    ] = False,
    border: Annotated[
        BorderName | None,
        typer.Option(
            help="With --video, pixels that the sensor did not record: mirror, extrapolated; hold, as in the frame "
            "before; crop, cut off by constant margins.",
            show_default="mirror",
        ),
    ] = None,
    steady: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="With --video, move the image to a smooth path: shaking of this period or shorter is removed.",
            show_default="the image stays where it is",
        ),
    ] = None,
    crop_limit: Annotated[
        float | None,
        typer.Option(
            help="With --steady, the largest shift of a corner, in parts of the width or height.", show_default="0.1"
        ),
    ] = None,
    compression: Annotated[str | None, typer.Option(help="Compression of a TIFF stack: zlib or lzma.")] = None,
    restoration: RestorationArguments,
    force: ForceOption = False,
    windows: Annotated[dict[str, Any], MadeBy(group_arguments(WindowOptions))],
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
    pixel_size: PixelSizeOption = None,
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
    overwrite: OverwriteOption = False,
) -> Answer:
    """Detect the vibration, restore the frames, judge the result and draw figures.

    Stacks of any length are processed in windows. If the restored frames are judged no better than the input, the
    input is written unchanged, unless --force is given. Ctrl-C stops after the current windows; --resume continues.
    With --video, the vibration of a video is followed frame by frame: --steady 1 --border crop makes a shaky video
    steady.
    """
    moved = {"border": border, "steady": steady, "crop_limit": crop_limit}
    moved = {name: value for name, value in moved.items() if value is not None}
    if moved and not video:
        raise ValueError(f"--{next(iter(moved)).replace('_', '-')} goes with --video")
    output = _video_name(frames, output) if video else output
    if Path(output).name != output or output in ("", ".", ".."):
        raise ValueError(f"--output must be a file name without a folder, got {output!r}")
    results = (*OF_DETECTION, *OF_WINDOWS, "restoration.json", "before_after.png")
    check_folder(out, results, overwrite or resume, [*io.stack_files(frames), settings.path], out / output)
    info, scale, options = planned_restoration(frames, settings, full_scale, restoration)
    print_notes(info, settings)
    chosen = WindowOptions(**{**settings.stack, **windows})
    frames_at_once = chosen.window
    if video and is_followed(frames, info.shape[0], frames_at_once, requested=bool(moved)):
        windows_only = {"--window": windows.get("window"), "--bad-frames skip": windows.get("bad_frames") == "skip"}
        check_followed(windows_only | {"--scheduler": scheduler, "--compression": compression}, options)
        if {**settings.restoration, **restoration}.get("saturation") is None:
            options.pop("saturation", None)  # that of integer formats
        answer = run_followed(
            frames,
            out,
            output,
            settings,
            options,
            **moved,
            pixel_size=pixel_size,
            full_scale=scale,
            resume=resume,
            memory=memory,
            workers=workers,
            device=str(torch_device(device)),
        )
        remove_old(out, results if overwrite else (), [path.name for path in answer.files])
        return answer
    common: dict[str, Any] = {
        "window": frames_at_once,
        "detection": settings.detection,
        "restoration": options,
        "full_scale": scale,
        "force": force,
        "memory": memory,
        "workers": workers,
        "device": str(torch_device(device)),
    }
    one_window = info.shape[0] <= common["window"]
    description = f"restoring {frames.name}"
    with working(description) if one_window else counting(description) as progress:
        result = stacks.process_stack(
            frames,
            out / output,
            settings.timing,
            **common,
            bad_frames=chosen.bad_frames,
            scheduler=scheduler,
            compression=compression,
            resume=resume,
            manifest=out / "manifest.json",
            progress=progress,
        )
    first = result.first
    if first is None:  # the run was complete before, or its first window was
        first = next(iter(stacks.iterate_stack(frames, settings.timing, **common)))
    names: list[str] = []
    with whole_folder(out) as folder:
        if len(first.frames):
            with working("drawing the frames"):
                names += draw_safely(
                    folder / "before_after.png", lambda: _comparison(frames, scale, first, options.get("mosaic"))
                )
        names += [output, "manifest.json"]
        if result.windows == 1:
            assert isinstance(first.detection, detection.DetectionResult)
            assert first.restoration is not None
            reports.write_restoration(folder / "restoration.json", first.restoration, options, result.not_kept)
            timing = io.timing_from_first_frame(settings.timing, info)
            names += [*write_detection(folder, first.detection, timing, pixel_size), "restoration.json"]
        else:
            names += write_windows(folder, out / "manifest.json", pixel_size)
    if overwrite:
        remove_old(out, results, names)
    return _answer_of_windows(frames, info.shape[0], out, output, settings, result, first, names, pixel_size)


def _answer_of_windows(
    frames: Path,
    count: int,
    out: Path,
    output: str,
    settings: Config,
    result: StackReport,
    first: WindowResult,
    names: list[str],
    pixel_size: float | None,
) -> Answer:
    """What a run on a stack of ``count`` frames found and did, with its warnings."""
    if result.bad_frames:
        error_line(f"{number_of(result.bad_frames, 'frame')} could not be used: see manifest.json", "warning")
    note_lost(out / output, result.not_kept)
    windows = ["--manifest", str(out / "manifest.json")] if result.windows > 1 else []
    steps = [page_step(frames, out / "report", settings, *windows)] if result.restored else []
    files = [out / name for name in names]
    if result.windows == 1:
        assert isinstance(first.detection, detection.DetectionResult)
        assert first.restoration is not None
        _warn_of_restoration(first.restoration)
        return Answer(
            {
                f"Vibration in {frames.name}": [first.detection.summary()],
                **in_metres(first.detection, pixel_size),
                "Restoration": restoration_lines(first.restoration, count),
            },
            {"detection": detection_data(first.detection), "restoration": restoration_data(first.restoration)},
            files,
            steps + steps_after_detection(first.detection, frames, settings),
        )
    stored = stacks.read_manifest(out / "manifest.json")
    _warn_of_failures(result.failed)
    vibration_lines, lines = stored.lines(pixel_size)
    return Answer(
        {f"Vibration in {frames.name}": vibration_lines, "Restoration": [result.summary(), *lines[1:]]},
        {"windows": stored.totals()},
        files,
        steps,
    )


def _video_name(frames: Path, output: str) -> str:
    """Name of the restored video: H.264 for the endings that H.264 is written to, else FFV1."""
    if output != "restored.tif":
        raise ValueError(f"--video and --output {output} are two names for the restored stack; give one of them")
    ending = frames.suffix.lower().partition("[")[0]  # of frames[START:END]
    return f"restored{ending if ending in ('.mp4', '.mov', '.m4v') else '.mkv'}"


def _comparison(frames: Path, full_scale: float | None, first: WindowResult, pattern: str | None) -> Figure:
    """Draw the first restored frame of a stack beside the frame of the input, a mosaic of a pattern or None."""
    from rsvib_torch.frames.mosaic import colour_frames  # noqa: PLC0415
    from rsvib_torch.frames.pixels import enlarged  # noqa: PLC0415
    from rsvib_torch.io.full_scale import counts_to_frames  # noqa: PLC0415

    index = first.indices[0] if first.indices else (first.window.first + first.window.last + 1) // 2
    reader = io.open_stack(frames)
    scale, nodata = full_scale or reader.info.full_scale, reader.info.nodata
    raw = counts_to_frames(reader.frame(index)[None], scale, str(frames), nodata)[0].nan_to_num(0.0)
    reader.close()
    if pattern is not None:
        raw = colour_frames(raw[None], pattern)[0]
    raw = enlarged(raw, first.frames.shape[-1] // raw.shape[-1])
    names = ("input", "restored" if first.restored else "unchanged")
    return reports.comparison_figure(raw, first.frames[0].cpu().nan_to_num(0.0), names=names)


def report(
    frames: FramesArgument,
    out: Annotated[Path, typer.Argument(help="Folder for report.html and its figures.")],
    *,
    settings: CameraSettings,
    edge: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EDGE",
            help="Slanted edge to measure: TOP,LEFT,HEIGHT,WIDTH in px; may be given several times.",
            show_default="edges are searched for",
        ),
    ] = None,
    manifest: Annotated[
        Path | None,
        typer.Option(
            help="The manifest.json of rsvib run or detect with windows: draw amplitude and frequency over the windows."
        ),
    ] = None,
    restoration: RestorationArguments,
    force: Annotated[
        bool, typer.Option("--force", help="Show the restored frames even if they are judged no better than the input.")
    ] = False,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Detect, restore and judge as rsvib run does, and write a report as an HTML page with figures.

    The page is one file that needs no network. The figures are also written as PNG files.
    """
    boxes = [_edge_box(text) for text in edge or []]
    windows = None if manifest is None else stacks.read_manifest(manifest)
    inputs = [*io.stack_files(frames), settings.path, *([] if manifest is None else [manifest])]
    check_folder(out, ["report.html"], overwrite, inputs)
    _, _, options = planned_restoration(frames, settings, full_scale, restoration)
    stack = load(frames, settings, full_scale, device, options)
    detection = _detect(stack, settings)
    result = _restore(stack, detection, options, force, "page")
    pattern = options.get("mosaic")
    if result.restored:
        run_it = command_text("run", frames, out, *settings.arguments)
        steps = [f"write the restored frames:\n  {run_it}"]
    else:
        steps = step_with_force("report", result, frames, out.with_name(f"{out.name}_forced"), settings)
    steps += steps_after_detection(detection, frames, settings)
    from rsvib_torch.frames.mosaic import colour_frames  # noqa: PLC0415

    content = reports.Report(
        title=printable(f"Vibration in {frames.name}"),
        subtitle=printable(f"{frames}, camera of {settings.source}"),
        frames=stack.frames if pattern is None else colour_frames(stack.frames, pattern),
        restored=result.frames,
        was_restored=result.restored,
        timing=stack.timing,
        detection=detection,
        verdict=result.verdict,
        left_alone=result.left_alone,
        options=options,
        version=rsvib_torch.__version__,
        next_steps=tuple(step_parts(step) for step in steps),
        command=running_command(),
        windows=windows,
    )
    with whole_folder(out) as folder, working("writing the page"):
        files = reports.write_report_page(folder, content, boxes or None)
        check_new([out / name for name in files], overwrite=True, inputs=inputs)
    return Answer(
        {
            f"Vibration in {frames.name}": [detection.summary()],
            "Restoration": restoration_lines(result, len(stack.frames)),
        },
        {"detection": detection_data(detection), "restoration": restoration_data(result)},
        [out / name for name in files],
        steps,
    )


def _edge_box(text: str) -> Box:
    """Position of a slanted edge (top, left, height, width) in px."""
    numbers = [part.strip() for part in text.split(",")]
    if len(numbers) != 4 or not all(number.isdecimal() for number in numbers):
        raise ValueError(f"--edge must be TOP,LEFT,HEIGHT,WIDTH in px, got {text!r}")
    top, left, height, width = map(int, numbers)
    return top, left, height, width
