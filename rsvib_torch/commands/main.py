"""The ``rsvib`` command: simulate, detect, restore, all of it in one run, and a page about it."""

import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import typer

import rsvib_torch
from rsvib_torch.commands.calibrate_command import calibrate
from rsvib_torch.commands.motion_commands import known, motion
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
    WorkersOption,
)
from rsvib_torch.commands.stack_commands import detect_windows, restore_windows, run, window_of
from rsvib_torch.commands.terminal import error_line, say, show_result, warnings_in_one_line, working
from rsvib_torch.commands.workflow import (
    DeviceName,
    Stack,
    Wishes,
    chosen_device,
    detect_frames,
    load,
    restore_and_judge,
    save,
    write_detection,
)
from rsvib_torch.config import Config, read_config
from rsvib_torch.detection import DetectionResult
from rsvib_torch.imaging import simulate_frames
from rsvib_torch.io import (
    check_stack_target,
    check_writable,
    read_stack,
    read_stack_info,
    timing_from_first_frame,
    whole_folder,
    write_stack,
)
from rsvib_torch.report.html import Box, Report, write_report_page
from rsvib_torch.report.results import read_vibration
from rsvib_torch.stacks import read_manifest

__all__ = ["main", "run_command"]

app = typer.Typer(
    name="rsvib",
    help="See and undo the vibration of a rolling-shutter camera.",
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="Image of a still scene, larger than the frames.")],
    frames: Annotated[Path, typer.Argument(help="Stack to write.")],
    *,
    config: ConfigOption,
    device: DeviceOption = "auto",
    full_scale: Annotated[float | None, typer.Option(help="Count that means full scale in the scene.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the noise, instead of the config's.", min=0)] = None,
) -> None:
    """Simulate the frames that the camera of the config takes of a scene while it vibrates."""
    settings = read_config(config)
    if settings.simulation is None:
        raise ValueError(f"{config}: simulation: missing key; expected a table with vibration, num_frames, ...")
    simulation, place = settings.simulation, chosen_device(device)
    image = read_stack(scene, full_scale=full_scale)
    if len(image) != 1:
        raise ValueError(f"{scene}: a scene is one image, this file has {len(image)} frames")
    scale = settings.full_scale
    dtype = "float32" if scale is None else "uint8" if scale <= 255 else "uint16"
    shape = (simulation.num_frames, *image.shape[1:])
    check_stack_target(frames, shape, dtype=dtype, full_scale=scale)
    generator = torch.Generator(place).manual_seed(simulation.seed if seed is None else seed)
    with working("simulating the frames"):
        taken = simulate_frames(
            image[0].to(place),
            settings.timing,
            simulation.vibration,
            simulation.num_frames,
            frame_size=simulation.frame_size,
            noise=simulation.noise,
            generator=generator,
        )
    with working(f"writing {frames}"):
        write_stack(frames, taken, dtype=dtype, full_scale=scale)
    say(f"{frames}: {len(taken)} frames of {taken.shape[-2]} x {taken.shape[-1]} px, {dtype}")


def _detected(
    frames: Path, config: Path, out: Path, device: DeviceName, full_scale: float | None
) -> tuple[Config, Stack, DetectionResult]:
    """Read a stack and detect its vibration, after a look at whether ``out`` can be written."""
    settings = read_config(config)
    check_writable(out, folder=True)
    stack = load(frames, settings, full_scale, chosen_device(device))
    return settings, stack, detect_frames(stack, settings)


@app.command()
def detect(
    frames: FramesArgument,
    *,
    config: ConfigOption,
    out: Annotated[Path, typer.Option(help="Folder for vibration.json, offsets.csv and offsets.png.")],
    window: Annotated[
        int | None,
        typer.Option(
            help="Detect in windows of at most so many frames: writes manifest.json and windows.csv instead.",
            show_default="the config's, or one result from all frames",
        ),
    ] = None,
    memory: MemoryOption = None,
    workers: WorkersOption = None,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect the vibration in a stack of frames.

    It is one of steady tones; rsvib motion finds motion of any shape, and tones that fade or sweep.
    """
    settings = read_config(config)
    if window is not None or "window" in settings.stack:
        size = window_of(settings, window)
        detect_windows(
            frames, settings, out, size, device=device, full_scale=full_scale, memory=memory, workers=workers
        )
        return
    settings, stack, result = _detected(frames, config, out, device, full_scale)
    with whole_folder(out) as folder:
        write_detection(folder, result, stack.timing)
    show_result(result)
    say(f"{out}: vibration.json, offsets.csv, offsets.png")


def _is_manifest(path: Path) -> bool:
    """Whether a file is the manifest of a stack in windows, rather than one vibration."""
    with path.open("rb") as file:
        return b'"rsvib stack"' in file.read(200)


@app.command(name="restore")
def restore_command(
    frames: FramesArgument,
    restored: Annotated[Path, typer.Argument(help="Stack to write, in the type and full scale of the frames.")],
    *,
    config: ConfigOption,
    vibration: Annotated[
        Path, typer.Option(help="The vibration.json, or manifest.json of windows, that detect or run wrote.")
    ],
    method: MethodOption = None,
    joint: JointOption = None,
    prior: PriorOption = None,
    saturation: SaturationOption = None,
    force: ForceOption = False,
    report: Annotated[Path | None, typer.Option(help="JSON file to write: whether it helped, and why not.")] = None,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Restore a stack of frames with a detected vibration, and judge whether that helps.

    Where restored frames are no better than the raw ones, the raw ones are written, unless forced.
    """
    settings = read_config(config)
    wishes = Wishes(method, joint, prior, saturation, force)
    if _is_manifest(vibration):
        if report is not None:
            raise ValueError("--report is for vibration.json; a stack in windows is judged in its own manifest.json")
        manifest = read_manifest(vibration)
        restore_windows(frames, restored, settings, manifest, wishes, device=device, full_scale=full_scale)
        return
    detected = read_vibration(vibration, timing_from_first_frame(settings.timing, read_stack_info(frames)))
    stack = load(frames, settings, full_scale, chosen_device(device))
    shape = (1, *stack.info.shape[1:]) if joint == "all" else stack.info.shape
    check_stack_target(restored, shape, dtype=stack.info.dtype, full_scale=stack.full_scale)
    if report is not None:
        check_writable(report)
    result = restore_and_judge(stack, settings, detected, wishes)
    save(restored, result.frames, stack)
    if report is not None:
        result.write_report(report)
    say(f"{restored}: {len(result.frames)} frames {'restored' if result.restored else 'as taken'}, {stack.info.dtype}")


def _boxes(texts: list[str]) -> list[Box] | None:
    """Places of slanted edges; None where none is given."""
    boxes: list[Box] = []
    for text in texts:
        numbers = [part.strip() for part in text.split(",")]
        if len(numbers) != 4 or not all(number.isdecimal() for number in numbers):
            raise ValueError(f"--edge must be TOP,LEFT,HEIGHT,WIDTH in px, got {text!r}")
        top, left, height, width = map(int, numbers)
        boxes.append((top, left, height, width))
    return boxes or None


@app.command()
def report(
    frames: FramesArgument,
    out: Annotated[Path, typer.Argument(help="Folder for report.html and its figures.")],
    *,
    config: ConfigOption,
    edge: Annotated[
        list[str] | None,
        typer.Option(help="Slanted edge to measure, TOP,LEFT,HEIGHT,WIDTH; may be repeated. By default found."),
    ] = None,
    method: MethodOption = None,
    joint: JointOption = None,
    prior: PriorOption = None,
    saturation: SaturationOption = None,
    force: ForceOption = False,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect, restore and judge, and write a page about it that needs no network, and its figures as PNG files."""
    boxes = _boxes(edge or [])
    settings, stack, detection = _detected(frames, config, out, device, full_scale)
    show_result(detection)
    result = restore_and_judge(stack, settings, detection, Wishes(method, joint, prior, saturation, force))
    content = Report(
        title=f"Vibration in {frames.name}",
        subtitle=f"{frames}, camera of {config}",
        frames=stack.frames,
        restored=result.frames,
        was_restored=result.restored,
        timing=stack.timing,
        detection=detection,
        verdict=result.verdict,
        left_alone=result.left_alone,
        options=result.options,
        version=rsvib_torch.__version__,
    )
    with whole_folder(out) as folder, working("writing the page"):
        files = write_report_page(folder, content, boxes)
    say(f"{out}: {', '.join(files)}")


def _show_version(wanted: bool) -> None:
    if wanted:
        say(f"rsvib {rsvib_torch.__version__}")
        raise typer.Exit


app.command()(calibrate)
app.command()(motion)
app.command()(known)
app.command()(run)


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """See and undo the vibration of a rolling-shutter camera."""


def _one_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error) or type(error).__name__


_INTERRUPTED = 130  # what typer makes of Ctrl-C; older ones raise Abort


def run_command(arguments: Sequence[str]) -> int:
    """Run ``rsvib`` with these arguments.

    Returns:
        Exit code: 0, 2 after an error of the user's, which is one line on standard error, or 130 after Ctrl-C.
    """
    logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what matters becomes an error of our own
    command = typer.main.get_command(app)
    try:
        with warnings_in_one_line():
            try:
                code = command.main(args=list(arguments) or ["--help"], prog_name="rsvib", standalone_mode=False)
            except typer.Abort:
                code = _INTERRUPTED
        if code == _INTERRUPTED:
            error_line("stopped; what is done of a run is kept, --resume goes on with it")
        return code if isinstance(code, int) else 0
    except (ValueError, TypeError, OSError, ModuleNotFoundError) as error:
        error_line(_one_line(error))
    except Exception as error:
        if hasattr(error, "format_message"):  # a mistake in the arguments, whichever library typer parses them with
            error_line(error.format_message())
        elif isinstance(error, MemoryError) or "allocate" in str(error):
            error_line("not enough memory for a stack of this size; take fewer frames at a time")
        else:
            raise
    return 2


def main() -> None:
    """Entry point of the ``rsvib`` command."""
    sys.exit(run_command(sys.argv[1:]))
