"""Arguments and options that several commands of ``rsvib`` share."""

from pathlib import Path
from typing import Annotated

import typer

from rsvib_torch.commands.workflow import DeviceName
from rsvib_torch.restoration.restore import METHODS
from rsvib_torch.stacks import DEFAULT_WINDOW

__all__ = [
    "ConfigOption",
    "DeviceOption",
    "ForceOption",
    "FramesArgument",
    "JointOption",
    "MemoryOption",
    "MethodOption",
    "PriorOption",
    "SaturationOption",
    "ScaleOption",
    "WindowOption",
    "WorkersOption",
]

ConfigOption = Annotated[Path, typer.Option("--config", help="TOML file that describes the camera.")]
DeviceOption = Annotated[
    DeviceName, typer.Option("--device", help="Where to compute; auto takes a GPU if there is one.")
]
ScaleOption = Annotated[
    float | None,
    typer.Option("--full-scale", help="Count that means full scale, where neither file nor config says it right."),
]
MethodOption = Annotated[
    str | None, typer.Option("--method", help=f"How to restore: {', '.join(METHODS)}.", show_default="the config's")
]
JointOption = Annotated[
    str | None,
    typer.Option(
        "--joint", help="Frames restored together: 'all' for one image (of each window), or a number of neighbours."
    ),
]
PriorOption = Annotated[
    str | None, typer.Option("--prior", help="What scenes are expected to be like, for methods that have the option.")
]
SaturationOption = Annotated[
    float | None,
    typer.Option("--saturation", help="Level of the file from which pixels are saturated; full scale for integers."),
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Write restored frames even where they are judged no better than raw.")
]
FramesArgument = Annotated[
    Path,
    typer.Argument(help="Stack of frames: TIFF, .npy, HDF5, Zarr, raw, video, or a folder of PNG or TIFF files."),
]
WindowOption = Annotated[
    int | None,
    typer.Option(
        "--window",
        help="Most frames whose vibration is detected together; longer stacks are cut into windows.",
        show_default=f"the config's, or {DEFAULT_WINDOW}",
    ),
]
MemoryOption = Annotated[
    str | None,
    typer.Option(
        "--memory", help="Memory that the process may take, like 2GB.", show_default="four fifths of what is free"
    ),
]
WorkersOption = Annotated[
    int | None,
    typer.Option("--workers", help="Windows to work on at once, if there is memory.", show_default="one a processor"),
]
