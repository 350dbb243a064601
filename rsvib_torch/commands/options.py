"""Arguments and options that several commands share, and their combination with the configuration file."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import typer

from rsvib_torch.config import Config
from rsvib_torch.core.checks import check_number
from rsvib_torch.io import StackInfo
from rsvib_torch.restoration.exact.priors import PRIORS
from rsvib_torch.restoration.restore import METHODS, method_options

__all__ = [
    "ConfigOption",
    "DeviceName",
    "DeviceOption",
    "ForceOption",
    "FramesArgument",
    "JointOption",
    "JsonOption",
    "MemoryOption",
    "MethodOption",
    "Overrides",
    "OverwriteOption",
    "PriorOption",
    "QuietOption",
    "RestoredArgument",
    "SaturationOption",
    "ScaleOption",
    "WorkersOption",
    "check_new",
    "full_scale_of",
    "restoration_options",
    "torch_device",
]

DeviceName = Literal["auto", "cpu", "cuda"]

FramesArgument = Annotated[
    Path,
    typer.Argument(help="Stack of frames: TIFF, .npy, HDF5, Zarr, raw, video, or a folder of PNG, TIFF or JPEG files."),
]
RestoredArgument = Annotated[
    Path,
    typer.Argument(
        help="Stack to write, with the data type and full scale of the input. The extension selects the format; .mp4 "
        "and .mkv are videos with the time stamps and the sound of the input.",
    ),
]
ConfigOption = Annotated[Path, typer.Option(help="TOML configuration file that describes the camera.")]
DeviceOption = Annotated[DeviceName, typer.Option(help="Device for the computation; auto uses a GPU if there is one.")]
ScaleOption = Annotated[
    float | None,
    typer.Option(
        help="Count of an integer format that corresponds to full scale, e.g. 4095 for 12 bits.",
        show_default="from the file, or the configuration",
    ),
]
MethodOption = Annotated[
    str | None,
    typer.Option(help=f"Restoration method: {', '.join(METHODS)}.", show_default="from the configuration, or exact"),
]
JointOption = Annotated[
    str | None,
    typer.Option(
        help="Number of neighbouring frames that are restored jointly, or 'all' for one image of all frames (of each "
        "window).",
    ),
]
PriorOption = Annotated[
    str | None,
    typer.Option(help=f"Prior of the scene: {' or '.join(PRIORS)}, for methods that have this option."),
]
SaturationOption = Annotated[
    float | None,
    typer.Option(help="Saturation level in the unit of the file.", show_default="full scale for integer formats"),
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Write the restored frames even if they are judged no better than the input.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace results that exist already.")]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the answer as JSON on standard output, and nothing else there.")
]
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors, and no progress.")
]
MemoryOption = Annotated[
    str | None,
    typer.Option(help="Memory limit of the process, e.g. 2GB.", show_default="four fifths of the free memory"),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        help="Number of windows that are processed at the same time, within the memory limit.",
        show_default="number of processors",
    ),
]


@dataclass(frozen=True)
class Overrides:
    """Restoration options of the command line; None leaves a value to the configuration file.

    Attributes:
        method: Restoration method.
        joint: ``"all"``, or a number of frames.
        prior: Prior for the scene.
        saturation: Saturation level in the unit of the file.
    """

    method: str | None
    joint: str | None
    prior: str | None
    saturation: float | None


NO_OVERRIDES = Overrides(None, None, None, None)


def check_new(paths: Iterable[Path], overwrite: bool) -> None:
    """Raise a ``FileExistsError`` if results exist and must not be replaced; an empty folder does not count."""
    existing = [path for path in paths if path.exists() and not (path.is_dir() and not any(path.iterdir()))]
    if existing and not overwrite:
        names = ", ".join(path.name for path in existing)
        raise FileExistsError(
            f"results exist already in {existing[0].parent}: {names}; choose another name, or replace them with "
            "--overwrite"
        )


def torch_device(name: DeviceName) -> torch.device:
    """Device of that name.

    Raises:
        ValueError: If there is no CUDA device.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: no CUDA device is available; use auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def full_scale_of(path: Path, info: StackInfo, config: Config, option: float | None) -> float | None:
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


def restoration_options(
    info: StackInfo, full_scale: float | None, config: Config, overrides: Overrides = NO_OVERRIDES
) -> dict[str, Any]:
    """Options of ``restore``: those of the configuration file, overridden by those of the command line.

    Raises:
        ValueError: If the method is unknown, or a value is out of range.
    """
    options = dict(config.restoration)
    if overrides.method is not None and overrides.method != options.get("method", "exact"):
        shared = ("saturation", *method_options(overrides.method))  # other options belong to the configured method
        options = {name: value for name, value in options.items() if name in shared}
    for name in ("method", "prior", "saturation"):
        if getattr(overrides, name) is not None:
            options[name] = getattr(overrides, name)
    if overrides.joint is not None:
        if overrides.joint != "all" and not (overrides.joint.isdecimal() and int(overrides.joint) >= 1):
            raise ValueError(f"--joint must be 'all' or a number of frames, got {overrides.joint!r}")
        options["joint"] = overrides.joint == "all" or int(overrides.joint)
    if options.get("saturation") is not None:
        level = check_number("saturation", options["saturation"], above=0.0)
        options["saturation"] = level / full_scale if info.is_integer and full_scale is not None else level
    elif info.is_integer and full_scale is not None:
        options["saturation"] = 1.0
    return options
