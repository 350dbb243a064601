"""Arguments and options that several commands share, and their combination with the configuration file."""

import itertools
import os
import re
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rsvib_torch import io
from rsvib_torch.commands.flat_command import MadeBy, group_arguments
from rsvib_torch.commands.terminal import note
from rsvib_torch.config import Config, SensorSection, read_config
from rsvib_torch.core.outputs import check_outputs
from rsvib_torch.options import RestorationOptions, method_options

if TYPE_CHECKING:
    import torch

    from rsvib_torch.io import StackInfo

DeviceName = Literal["auto", "cpu", "cuda"]
_TIMES = {"row_time": "--row-time", "exposure_time": "--exposure", "frame_rate": "--frame-rate"}  # required keys

_TIME_UNITS = {"": 1, "s": 1, "ms": 10**3, "us": 10**6, "µs": 10**6, "μs": 10**6, "ns": 10**9}  # per second
_LENGTH_UNITS = {"m": 1, "cm": 10**2, "mm": 10**3, "um": 10**6, "µm": 10**6, "μm": 10**6, "nm": 10**9}  # per metre


def _with_unit(text: str, units: Mapping[str, int], expected: str) -> float:
    """A number or a fraction with one of the units, which state how many of them are 1."""
    unit = text.strip().lstrip("0123456789./eE+-")
    try:
        return float(Fraction(text.strip().removesuffix(unit)) / units[unit])
    except (ValueError, ArithmeticError, KeyError) as error:
        raise typer.BadParameter(f"expected {expected}, got {text!r}") from error


def seconds(text: str) -> float:
    """A time in seconds: a number or a fraction, with or without a unit.

    Example:
        >>> seconds("14.5us"), seconds("1/500"), seconds("2e-5")
        (1.45e-05, 0.002, 2e-05)
    """
    return _with_unit(text, _TIME_UNITS, "a time such as 14.5us, 1/500 or 2e-5 (in s)")


def metres(text: str) -> float:
    """A length in metres: a number with a unit.

    Example:
        >>> metres("12.5um"), metres("0.3 mm")
        (1.25e-05, 0.0003)
    """
    return _with_unit(text.replace(" ", ""), _LENGTH_UNITS, "a length with its unit such as 12.5um or 0.3mm")


def rate(text: str) -> float:
    """Frames per second: a number or a fraction.

    Example:
        >>> round(rate("30000/1001"), 6)
        29.97003
    """
    try:
        return float(Fraction(text))
    except (ValueError, ArithmeticError) as error:
        raise typer.BadParameter(f"expected a number such as 29.97 or 30000/1001, got {text!r}") from error


def _range_of_frames(text: str) -> str:
    """START:END, as it was given."""
    if re.fullmatch(r"\d*:\d*", text) is None:
        raise typer.BadParameter(f"expected START:END such as 100:200, 100: or :200, got {text!r}")
    return text


RangeOption = Annotated[
    str | None,
    typer.Option(
        "--frames",
        parser=_range_of_frames,
        metavar="START:END",
        help="Use only the frames START to END - 1, counted from 0; times count from the first of them.",
        show_default="all frames",
    ),
]


def some_frames(
    frames: Annotated[
        Path,
        typer.Argument(
            help="Stack of frames: TIFF, .npy, HDF5, Zarr, raw, video, or a folder of PNG, TIFF or JPEG files."
        ),
    ],
    *,
    frame_range: RangeOption = None,
) -> Path:
    """The path of a stack, or of the frames that are used of it, ``NAME[START:END]``."""
    return frames if frame_range is None else frames.with_name(f"{frames.name}[{frame_range}]")


def _some_of_each(
    frames: Annotated[list[Path], typer.Argument(help="One or more stacks of frames: TIFF, PNG, video ...")],
    *,
    frame_range: RangeOption = None,
) -> list[Path]:
    """The paths of several stacks, as ``some_frames``."""
    return [some_frames(path, frame_range=frame_range) for path in frames]


def _some_of_source(
    source: Annotated[
        str,
        typer.Argument(help="Number or URL of a camera, - for raw frames on standard input, or a file with frames."),
    ],
    *,
    frame_range: RangeOption = None,
) -> str:
    """A source of frames, or the frames that are used of a file."""
    if frame_range is None:
        return source
    file = file_of_source(source)
    if file is None:
        raise ValueError(f"--frames goes with a file, not with {source}; --num-frames ends a session")
    return str(some_frames(file, frame_range=frame_range))


FramesArgument = Annotated[Path, MadeBy(some_frames)]
StacksArgument = Annotated[list[Path], MadeBy(_some_of_each)]
SourceArgument = Annotated[str, MadeBy(_some_of_source)]
RestoredArgument = Annotated[
    Path,
    typer.Argument(
        help="Stack to write, with the data type and full scale of the input. The extension selects the format; .mp4 "
        "and .mkv are videos with the time stamps and the sound of the input.",
    ),
]
_ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="TOML file that describes the camera; rsvib init writes one. Or give --row-time, --exposure and "
        "--frame-rate.",
    ),
]
FrameRateOption = Annotated[
    float | None,
    typer.Option(
        parser=rate,
        metavar="NUMBER",
        help="Frames per second of the sensor, e.g. 29.97 or 30000/1001.",
        show_default="from the file, or the configuration",
    ),
]
READOUT_HELP = "forward: the top row (or left column) is read first; reverse: the last one is."


def sensor_forms(default: str) -> dict[str, Any]:
    """Annotations for typer of the keys of ``[sensor]`` that are options; ``default`` precedes that of choices."""
    return {
        "row_time": Annotated[
            float | None,
            typer.Option(
                parser=seconds,
                metavar="TIME",
                help="Time between the exposure starts of adjacent rows, e.g. 14.6us or 1.46e-5.",
            ),
        ],
        "exposure_time": Annotated[
            float | None,
            typer.Option("--exposure", parser=seconds, metavar="TIME", help="Exposure time, e.g. 1/500 or 2ms."),
        ],
        "frame_rate": FrameRateOption,
        "scan_axis": Annotated[
            Literal["y", "x"] | None,
            typer.Option(
                help="y: image rows are exposed one after another; x: image columns.", show_default=f"{default}y"
            ),
        ],
        "readout_direction": Annotated[
            Literal["forward", "reverse"] | None, typer.Option(help=READOUT_HELP, show_default=f"{default}forward")
        ],
    }


DeviceOption = Annotated[DeviceName, typer.Option(help="Device for the computation; auto uses a GPU if there is one.")]
ScaleOption = Annotated[
    float | None,
    typer.Option(
        help="Count of an integer format that corresponds to full scale, e.g. 4095 for 12 bits.",
        show_default="from the file, or the configuration",
    ),
]
_JointOption = Annotated[
    str | None,
    typer.Option(
        help="Number of neighbouring frames that are restored jointly, or 'all' for one image of all frames (of each "
        "window).",
    ),
]
_OpticsOption = Annotated[
    float | None,
    typer.Option(
        "--optics-sigma",
        help="Standard deviation of the Gaussian blur of the lens in px, before pixels without gaps: restored frames "
        "are sharpened to half a point of their grid. Section [restoration.optics] describes other optics.",
    ),
]
PixelSizeOption = Annotated[
    float | None,
    typer.Option(
        parser=metres,
        metavar="LENGTH",
        help="Size of a pixel on the sensor or on the object, e.g. 12.5um: the motion is also stated in µm, µm/s and "
        "m/s².",
    ),
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Write the restored frames even if they are judged no better than the input.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace results that exist already.")]
MemoryOption = Annotated[
    str | None,
    typer.Option(help="Memory limit of the process, e.g. 2GB.", show_default="three quarters of the free memory"),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        help="Number of windows that are processed at the same time, within the memory limit.",
        show_default="number of processors",
    ),
]


def _read_camera(
    *,
    config: _ConfigOption = None,
    sensor: Annotated[
        dict[str, Any], MadeBy(group_arguments(SensorSection, sensor_forms("from the configuration, or ")))
    ],
    readout_time: Annotated[
        float | None,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help="Time in which all rows of a frame are read, e.g. 15ms, in place of --row-time.",
        ),
    ] = None,
    frames: Path | None = None,
    frame_range: str | None = None,
    source: str | None = None,
    full_scale: float | None = None,
) -> Config:
    """Configuration file and the options that replace its keys, or the options alone.

    Without either the frame rate is the one that the file of the frames states. The full scale is an argument of the
    commands that follow.
    """
    frames = frames if source is None else file_of_source(source)
    if readout_time is not None:
        if config is not None or "row_time" in sensor or frames is None:
            raise ValueError("--readout-time replaces --row-time of frames in a file, and goes without --config")
        shape = io.read_stack_info(frames).shape
        sensor = sensor | {"row_time": readout_time / shape[-1 if sensor.get("scan_axis") == "x" else -2]}
    missing = [option for name, option in _TIMES.items() if name not in sensor]
    if config is None and missing == ["--frame-rate"] and frames is not None:
        frame_rate = stated_rate(io.read_stack_info(frames))
        if frame_rate is not None:
            note(f"frame rate {frame_rate:.6g} per second, from the times in {frames}; --frame-rate replaces it")
            sensor, missing = sensor | {"frame_rate": frame_rate}, []
    if config is None and missing:
        raise ValueError(
            f"the camera is not described: give {', '.join(missing)}, or --config FILE (rsvib init FRAMES writes such "
            "a file and explains its values)"
        )
    settings = read_config(config, sensor=sensor)
    starts = settings.timing.frame_start_times
    if frame_range is not None and starts is not None:  # those of the file are read with its frames
        first, _, end = frame_range.partition(":")
        used = list(starts)[int(first or 0) : int(end) if end else None]
        relative = tuple(float(start - used[0]) for start in used)
        settings = replace(settings, timing=replace(settings.timing, frame_start_times=relative or starts))
    arguments = [] if config is None else ["--config", str(config)]
    for name, value in sensor.items():
        option = _TIMES.get(name, f"--{name.replace('_', '-')}")
        arguments += [option, f"{value:.10g}" if isinstance(value, float) else value]
    if full_scale is not None:
        arguments += ["--full-scale", f"{full_scale:.10g}"]
    return replace(settings, arguments=tuple(arguments))


CameraSettings = Annotated[Config, MadeBy(_read_camera)]
RestorationArguments = Annotated[
    dict[str, Any],
    MadeBy(group_arguments(RestorationOptions, {"joint": _JointOption, "optics": _OpticsOption})),
]


def stated_rate(info: "StackInfo") -> float | None:
    """Frames per second from the frame times of a file, between which frames may be missing, or from its rate."""
    if info.frame_times is None or len(info.frame_times) < 2:
        return info.frame_rate
    intervals = [later - earlier for earlier, later in itertools.pairwise(info.frame_times)]
    period = statistics.median(intervals)
    return sum(max(round(interval / period), 1) for interval in intervals) / sum(intervals)


def file_of_source(source: str) -> Path | None:
    """The file that a source of live frames names; None for the number or URL of a camera, and for standard input.

    Raises:
        FileNotFoundError: If it does not exist.
    """
    if source == "-" or source.isdecimal() or "://" in source:
        return None
    if not io.stack_files(source)[0].exists():
        raise FileNotFoundError(f"{source}: no such file; a camera is a number or a URL")
    return Path(source)


def check_new(
    paths: Iterable[Path], overwrite: bool, inputs: Iterable[Path | None], *, folder: Path | None = None
) -> None:
    """Raise an error if results would replace an input, or exist and must not be replaced.

    Args:
        paths: Files to write, and folders that are written as a whole. An empty folder may exist.
        overwrite: Whether existing results are replaced.
        inputs: Files and folders that are read; None for those that were not given.
        folder: Folder of the results, as in ``check_outputs``.
    """
    paths = list(paths)
    check_outputs(paths, [path for path in inputs if path is not None], folder=folder)
    existing = [path for path in paths if os.path.lexists(path) and not (path.is_dir() and not any(path.iterdir()))]
    if existing and not overwrite:
        names = ", ".join(path.name for path in existing)
        raise FileExistsError(
            f"results exist already in {existing[0].parent}: {names}; choose another name, or replace them with "
            "--overwrite"
        )


def torch_device(name: DeviceName) -> "torch.device":
    """Device of that name.

    Raises:
        ValueError: If there is no CUDA device.
    """
    import torch  # noqa: PLC0415

    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: no CUDA device is available; use auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def full_scale_of(path: Path, info: "StackInfo", config: Config, option: float | None) -> float | None:
    """Full scale of a stack: from the option, else from the file (or its 8-bit type), else from the configuration.

    Raises:
        ValueError: If file and configuration differ and there is no option.
    """
    if option is not None or not info.is_integer:
        return option
    if info.full_scale is None:
        return config.full_scale
    if info.dtype != "uint8" and config.full_scale not in (None, info.full_scale):
        raise ValueError(
            f"{path}: the full scale is {info.full_scale:g} in the file and {config.full_scale:g} in the "
            "configuration; choose one with --full-scale"
        )
    return info.full_scale


def _restoration_options(
    info: "StackInfo", full_scale: float | None, config: Config, given: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Options of ``restore``: those of the configuration file, replaced by those ``given`` on the command line.

    Raises:
        ValueError: If a value is out of range.
    """
    options, given = dict(config.restoration), dict(given or {})
    method = given.get("method", options.get("method", "exact"))
    if method != options.get("method", "exact"):  # other options belong to the configured method
        options = {name: value for name, value in options.items() if name in ("saturation", *method_options(method))}
    if "optics" in given:
        given["optics"] = {"pixel": 1.0, **options.get("optics", {}), "sigma": given["optics"]}
    if "joint" in given:
        if given["joint"] != "all" and not (given["joint"].isdecimal() and int(given["joint"]) >= 1):
            raise ValueError(f"--joint must be 'all' or a number of frames, got {given['joint']!r}")
        given["joint"] = given["joint"] == "all" or int(given["joint"])
    options |= given
    RestorationOptions(**options)
    if options.get("saturation", "auto") == "auto":
        options.pop("saturation", None)
    if options.get("saturation") is not None:
        if info.is_integer and full_scale is not None:
            options["saturation"] /= full_scale
    elif info.is_integer and full_scale is not None:
        options["saturation"] = 1.0
    if options.get("mosaic") is not None:
        from rsvib_torch.frames.mosaic import check_mosaic  # noqa: PLC0415

        check_mosaic(options["mosaic"], info.shape)
    if options.get("optics") is not None:
        from rsvib_torch.restoration.restore import check_optics  # noqa: PLC0415

        check_optics(RestorationOptions(**options).optics)
    return options


def planned_restoration(
    frames: Path, config: Config, full_scale: float | None, given: Mapping[str, Any] | None = None
) -> "tuple[StackInfo, float | None, dict[str, Any]]":
    """What the file of a stack states, its full scale, and the options of its restoration."""
    info = io.read_stack_info(frames)
    scale = full_scale_of(frames, info, config, full_scale)
    return info, scale, _restoration_options(info, scale, config, given)


def restored_shape(info: "StackInfo", options: Mapping[str, Any]) -> tuple[int, ...]:
    """Shape of the restored frames of a stack, with options as from ``_restoration_options``."""
    shape = info.restored_as(options.get("scale", 1), options.get("mosaic")).shape
    return (1, *shape[1:]) if options.get("joint") is True else shape
