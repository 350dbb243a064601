"""The ``rsvib`` command: simulate, detect, restore, and all of it in one run."""

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import typer
from torch import Tensor

import rsvib_torch
from rsvib_torch.config import Config, read_config
from rsvib_torch.detection import DetectionResult, detect_vibration
from rsvib_torch.imaging import simulate_frames
from rsvib_torch.pictures import comparison_figure, offset_figure, save_figure
from rsvib_torch.report import read_vibration, reliable_part, write_offsets, write_vibration
from rsvib_torch.restoration import restore
from rsvib_torch.stacks import (
    StackInfo,
    check_stack_target,
    check_writable,
    read_stack,
    read_stack_info,
    whole_folder,
    write_stack,
)
from rsvib_torch.terminal import error_line, say, show_result, warnings_in_one_line, working
from rsvib_torch.vibration import Vibration

__all__ = ["main", "run_command"]

app = typer.Typer(
    name="rsvib",
    help="See and undo the vibration of a rolling-shutter camera.",
    add_completion=False,
    pretty_exceptions_enable=False,
)

DeviceName = Literal["auto", "cpu", "cuda"]
ConfigOption = Annotated[Path, typer.Option("--config", help="TOML file that describes the camera.")]
DeviceOption = Annotated[
    DeviceName, typer.Option("--device", help="Where to compute; auto takes a GPU if there is one.")
]
ScaleOption = Annotated[
    float | None,
    typer.Option("--full-scale", help="Count that means full scale, where neither file nor config says it right."),
]
FramesArgument = Annotated[Path, typer.Argument(help="Stack of frames: TIFF, .npy, video, or a folder of PNG files.")]


@dataclass(frozen=True)
class _Stack:
    """Frames in memory and how their file keeps them."""

    frames: Tensor
    info: StackInfo
    full_scale: float | None


def _device(name: DeviceName) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: there is no CUDA device here; use auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _full_scale(path: Path, info: StackInfo, config: Config, option: float | None) -> float | None:
    """Full scale of a stack: the option first, then what the file says or 8 bits mean, then the config."""
    if option is not None or not info.is_integer:
        return option
    if info.full_scale is None:
        return config.full_scale
    if info.dtype != "uint8" and config.full_scale not in (None, info.full_scale):
        raise ValueError(
            f"{path} states full_scale={info.full_scale:g}, the config {config.full_scale:g}; say which: --full-scale"
        )
    return info.full_scale


def _load(path: Path, config: Config, option: float | None, device: torch.device) -> _Stack:
    info = read_stack_info(path)
    scale = _full_scale(path, info, config, option)
    with working(f"reading {path}"):
        frames = read_stack(path, full_scale=scale)
    # A video only estimates its length beforehand.
    info = StackInfo(tuple(frames.shape), info.dtype, info.full_scale)
    return _Stack(frames.to(device), info, scale)


def _save(path: Path, frames: Tensor, stack: _Stack) -> None:
    with working(f"writing {path.name}"):
        write_stack(path, frames, dtype=stack.info.dtype, full_scale=stack.full_scale)


def _detect(stack: _Stack, config: Config) -> DetectionResult:
    with working("detecting the vibration"):
        return detect_vibration(stack.frames, config.timing, **config.detection)


def _restore(stack: _Stack, config: Config, vibration: Vibration, reliable: Any, reasons: Any) -> Tensor:
    """Restored frames; an axis that is not reliable is left alone."""
    for axis, name in enumerate("xy"):
        if not bool(reliable[axis]):
            say(f"{name} is left alone: its vibration is not reliable ({'; '.join(reasons[axis])})")
    with working("restoring the frames"):
        return restore(stack.frames, config.timing, reliable_part(vibration, reliable), **config.restoration)


def _write_detection(folder: Path, result: DetectionResult, config: Config) -> None:
    with working("drawing the offset curve"):
        write_vibration(folder / "vibration.json", result, config.timing)
        write_offsets(folder / "offsets.csv", result)
        save_figure(offset_figure(result), folder / "offsets.png")


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
    simulation, place = settings.simulation, _device(device)
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


@app.command()
def detect(
    frames: FramesArgument,
    *,
    config: ConfigOption,
    out: Annotated[Path, typer.Option(help="Folder for vibration.json, offsets.csv and offsets.png.")],
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect the vibration in a stack of frames."""
    settings = read_config(config)
    check_writable(out, folder=True)
    stack = _load(frames, settings, full_scale, _device(device))
    result = _detect(stack, settings)
    with whole_folder(out) as folder:
        _write_detection(folder, result, settings)
    show_result(result)
    say(f"{out}: vibration.json, offsets.csv, offsets.png")


@app.command(name="restore")
def restore_command(
    frames: FramesArgument,
    restored: Annotated[Path, typer.Argument(help="Stack to write, in the type and full scale of the frames.")],
    *,
    config: ConfigOption,
    vibration: Annotated[Path, typer.Option(help="The vibration.json that detect wrote.")],
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Restore a stack of frames with a detected vibration."""
    settings = read_config(config)
    detected = read_vibration(vibration, settings.timing)
    stack = _load(frames, settings, full_scale, _device(device))
    check_stack_target(restored, stack.info.shape, dtype=stack.info.dtype, full_scale=stack.full_scale)
    clear = _restore(stack, settings, detected.vibration, detected.reliable, detected.reasons)
    _save(restored, clear, stack)
    say(f"{restored}: {len(clear)} frames restored, {stack.info.dtype}")


@app.command()
def run(
    frames: FramesArgument,
    out: Annotated[Path, typer.Argument(help="Folder for the restored frames, the vibration and the pictures.")],
    *,
    config: ConfigOption,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect the vibration, restore the frames, and draw pictures of both."""
    settings = read_config(config)
    check_writable(out, folder=True)
    stack = _load(frames, settings, full_scale, _device(device))
    result = _detect(stack, settings)
    show_result(result)
    clear = _restore(stack, settings, result.vibration, result.reliable, result.reasons)
    with whole_folder(out) as folder:
        _write_detection(folder, result, settings)
        _save(folder / "restored.tif", clear, stack)
        with working("drawing before and after"):
            save_figure(comparison_figure(stack.frames[0], clear[0]), folder / "before_after.png")
    say(f"{out}: restored.tif, vibration.json, offsets.csv, offsets.png, before_after.png")


def _show_version(wanted: bool) -> None:
    if wanted:
        say(f"rsvib {rsvib_torch.__version__}")
        raise typer.Exit


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


def run_command(arguments: Sequence[str]) -> int:
    """Run ``rsvib`` with these arguments.

    Returns:
        Exit code: 0, or 2 after an error of the user's, which is one line on standard error.
    """
    logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what matters becomes an error of our own
    command = typer.main.get_command(app)
    try:
        with warnings_in_one_line():
            code = command.main(args=list(arguments) or ["--help"], prog_name="rsvib", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except (ValueError, TypeError, OSError) as error:
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
