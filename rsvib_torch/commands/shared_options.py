"""Arguments and options that several commands share, and their combination with the configuration file."""

import os
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from rsvib_torch import gyroscope, io, stacks, video
from rsvib_torch.checks.values import options
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.terminal import note, working
from rsvib_torch.config import Config, read_config
from rsvib_torch.files.atomic import check_outputs, check_writable
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.timing import SensorSection, SensorTiming
from rsvib_torch.options import ProcessStackOptions, RestorationOptions, WindowOptions, method_options
from rsvib_torch.text import AXES

if TYPE_CHECKING:
    from rsvib_torch.io import StackInfo

_TIMES = {"row_time": "--row-time", "exposure_time": "--exposure", "frame_rate": "--frame-rate"}  # required keys

_TIME_UNITS = {"": 1, "s": 1, "ms": 10**3, "us": 10**6, "µs": 10**6, "μs": 10**6, "ns": 10**9}  # per second
_LENGTH_UNITS = {"m": 1, "cm": 10**2, "mm": 10**3, "um": 10**6, "µm": 10**6, "μm": 10**6, "nm": 10**9}  # per metre


def _with_unit(units: Mapping[str, int], expected: str, text: object) -> float:
    """A number or a fraction with one of the units, which state how many of them are 1."""
    stated = str(text).replace(" ", "")  # a default is a number
    unit = stated.lstrip("0123456789./eE+-")
    try:
        return float(Fraction(stated.removesuffix(unit)) / units[unit])
    except (ValueError, ArithmeticError, KeyError) as error:
        raise typer.BadParameter(f"expected {expected}, got {text!r}") from error


# Values with a unit: a time in s, a length in m, and frames per second.
seconds = partial(_with_unit, _TIME_UNITS, "a time such as 14.5us, 1/500 or 2e-5 (in s)")
metres = partial(_with_unit, _LENGTH_UNITS, "a length with its unit such as 12.5um or 0.3mm")
rate = partial(_with_unit, {"": 1}, "a number such as 29.97 or 30000/1001")


def _axes(text: str) -> str:
    """Names of axes with commas between them."""
    if not set(text.split(",")) <= set(AXES):
        raise typer.BadParameter(f"expected axes such as x,y or x,y,roll,zoom, got {text!r}")
    return text


TIME: Table = {"parser": seconds, "metavar": "TIME"}  # form of an option
# Forms of the keys of [sensor] that are options.
SENSOR_FORMS: dict[str, Table] = {
    "row_time": {
        "help": "Time from one row to the next, e.g. 14.6us, or 15/1080ms of a readout of 1080 rows.",
        **TIME,
    },
    "exposure_time": {"names": ["--exposure"], "help": "Exposure time, e.g. 1/500 or 2ms.", **TIME},
    "frame_rate": {
        "help": "Frames per second of the sensor, e.g. 29.97 or 30000/1001.",
        "parser": rate,
        "metavar": "NUMBER",
        "show_default": "from the file, or the configuration",
    },
    "scan_axis": {},
    "readout_direction": {},
}


@options
class CameraOptions:
    """The camera, and what all commands have that use one."""

    config: Path | None = None
    """TOML file that describes the camera; rsvib init writes one. Or give --row-time, --exposure and --frame-rate."""
    sensor: Annotated[Table, Given(SensorSection, default="from the configuration", forms=SENSOR_FORMS)]
    full_scale: float | None = option(None, show_default="from the file, or the configuration")
    """Count of an integer format that corresponds to full scale, e.g. 4095 for 12 bits."""
    overwrite: bool = False
    """Replace results that exist already."""

    def settings_for(self, frames: Path | None) -> Config:
        """Configuration file and the options that replace its keys, or these alone and what the frames state."""
        sensor = self.sensor
        if self.config is None and frames is not None and "row_time" in sensor:
            for name, stated_by_file in (("exposure_time", stated_exposure), ("frame_rate", rate_of_file)):
                value = None if name in sensor else stated_by_file(frames)
                sensor = sensor if value is None else sensor | {name: value}
        missing = [option for name, option in _TIMES.items() if name not in sensor]
        if self.config is None and missing:
            raise ValueError(
                f"the camera is not described: give {', '.join(missing)}, or --config FILE (rsvib init FRAMES writes "
                "such a file and explains its values)"
            )
        settings = read_config(self.config, sensor=sensor)
        starts, used = settings.timing.frame_start_times, None if frames is None else io.split_range(frames)[1]
        if starts is not None and used is not None:  # those of the configuration count from frame 0 of the file
            part = starts[slice(*used)] or starts
            relative = tuple(float(start - part[0]) for start in part)
            settings = replace(settings, timing=replace(settings.timing, frame_start_times=relative))
        elif starts is None and frames is not None and "frame_rate" in self.sensor:
            settings = replace(settings, timing=_evenly_timed(settings.timing, io.read_stack_info(frames)))
        arguments = [] if self.config is None else ["--config", str(self.config)]
        for name, value in sensor.items():
            arguments += [_TIMES.get(name, f"--{name.replace('_', '-')}")]
            arguments += [f"{value:.10g}" if isinstance(value, float) else value]
        if self.full_scale is not None:
            arguments += ["--full-scale", f"{self.full_scale:.10g}"]
        return replace(settings, arguments=tuple(arguments))


@options
class StackCommand(CameraOptions):
    """A command that reads a stack of frames."""

    frames: Path = argument()
    """Stack of frames: TIFF, .npy, HDF5, video and others, or a folder of PNG, TIFF or JPEG files. NAME[100:200] are
    its frames 100 to 199, from the first of which times count."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device for the computation; auto uses a GPU if there is one."""

    @cached_property
    def settings(self) -> Config:
        """The camera and the options of the configuration."""
        return self.settings_for(self.frames)

    @cached_property
    def info(self) -> "StackInfo":
        """What the file of the frames states."""
        return io.read_stack_info(self.frames)

    @cached_property
    def scale(self) -> float | None:
        """Full scale of integer frames: of the option, else of the file (or its 8-bit type) or the configuration."""
        if self.full_scale is not None or not self.info.is_integer:
            return self.full_scale
        return self.settings.full_scale if self.info.full_scale is None else self.info.full_scale

    def print_notes(self) -> None:
        """Print what the file states about orientation, dropped frames and unequal intervals."""
        for sentence in io.describe_stack(self.info, self.settings.timing):
            note(sentence)

    @property
    def inputs(self) -> list[Path]:
        """Files that are read."""
        return [*io.stack_files(self.frames), *([] if self.config is None else [self.config])]


def _joint(text: str) -> bool | int:
    """Value of --joint."""
    if text != "all" and not text.isdecimal():
        raise typer.BadParameter(f"expected 'all' or a number of frames, got {text!r}")
    return text == "all" or int(text)


_JOINT: Table = {
    "help": "Number of neighbouring frames that are restored jointly, or 'all' for one image of all frames (of each "
    "window).",
    "parser": _joint,
    "metavar": "NUMBER|all",
}
_WINDOW: Table = {
    "help": "Largest number of frames that are processed together; of restore --vibration all.",
    "show_default": "from the configuration, or 8",
}


@options
class RestoringCommand(StackCommand):
    """A command that restores the frames with options of ``restore``."""

    restoration: Annotated[Table, Given(RestorationOptions, default="from the configuration", forms={"joint": _JOINT})]
    processing: Annotated[Table, Given(ProcessStackOptions, forms={"window": _WINDOW})]
    force: bool = False
    """Write the restored frames even if they are judged no better than the input."""

    @property
    def window(self) -> int:
        """Largest number of frames that are processed together."""
        return int((self.settings.stack | self.processing).get("window", WindowOptions().window))

    @property
    def replaces(self) -> bool:
        """Whether results that exist may be replaced."""
        return self.overwrite or "resume" in self.processing

    @cached_property
    def of_stack(self) -> Table:
        """Options of the functions for stacks: those given, full scale, device, and options of ``restore``."""
        return self.processing | {"full_scale": self.scale, "restoration": self._chosen(), "device": self.device}

    def process(self, restored: Path, of_run: Table, *, followed: bool = False) -> "stacks.StackReport":
        """Process the stack in windows, or frame by frame, with the options of the command and those of the run."""
        of_windows = Table() if followed else Table(window=self.window, force=self.force)
        of_run = of_windows | self.of_stack | of_run
        counts = followed or self.info.shape[0] > of_run["window"]
        run = video.process_video if followed else stacks.process_stack
        with working(f"restoring {self.frames.name}", counts=counts) as progress:
            of_run["progress"] = progress if counts else None
            report = run(self.frames, restored, self.settings.timing, **of_run)
        if report.not_kept:
            note(f"{restored}: not kept from the input: {', '.join(report.not_kept)}")
        return report

    def _chosen(self) -> Table:
        """Options of ``restore``: those of the configuration file, replaced by those of the command line."""
        options, given = dict(self.settings.restoration), dict(self.restoration)
        full_scale = self.scale if self.info.is_integer else None
        method: str = (options | given).get("method", "exact")
        if method != options.get("method", "exact"):  # other options belong to the configured method
            usable = ("saturation", *method_options(method))
            options = {name: value for name, value in options.items() if name in usable}
        options |= given
        RestorationOptions(**options)  # raises an error for wrong ones
        level = options.get("saturation")
        if full_scale is not None and isinstance(level, (float, int)):  # of frames whose full scale is 1
            options["saturation"] = level / full_scale
        return options


@options
class PixelSizeOptions:
    """Units of length."""

    pixel_size: float | None = option(None, parser=metres, metavar="LENGTH")
    """Size of a pixel on the sensor or on the object, e.g. 12.5um: the motion is also stated in µm, µm/s and m/s²."""


@options
class VerdictOptions:
    """What a script requires of the result."""

    require_reliable: str | None = option(None, parser=_axes, metavar="AXES")
    """For scripts: exit code 3 if one of these axes is not reliable (in one of the windows), e.g. x,y. The results are
    written all the same."""


def rate_of_file(frames: Path) -> float | None:
    """``io.stated_rate`` of a file, with a note."""
    rate_of_frames = io.stated_rate(io.read_stack_info(frames))
    if rate_of_frames is not None:
        note(f"frame rate {rate_of_frames:.6g} per second, from the times in {frames}; --frame-rate replaces it")
    return rate_of_frames


def _evenly_timed(timing: SensorTiming, info: "StackInfo") -> SensorTiming:
    """The timing with equal intervals in place of irregular time stamps that are within a quarter of one of them."""
    stated = io.exposure_times(info, timing) if info.time_error else None
    even = io.exposure_times(replace(info, time_error=0.25 * timing.frame_period), timing)
    if stated is None or even is None or even == stated:
        return timing
    note(f"equal intervals by --frame-rate replace the {info.time_source} of {info.path}, which are irregular")
    return replace(timing, frame_start_times=tuple(time - even[0] for time in even))


def stated_exposure(path: Path) -> float | None:
    """Exposure in s that the track of a GoPro video states, the median over its frames."""
    track = gyroscope.read_camera_track(io.split_range(path)[0])
    if track is None or not len(track.exposures):
        return None
    exposures: list[float] = track.exposures.tolist()
    exposure = statistics.median(exposures)
    spread = f"{1e3 * min(exposures):.4g} to {1e3 * max(exposures):.4g} ms"
    note(f"exposure {1e3 * exposure:.4g} ms ({spread}), from the track of {path} (SHUT)")
    return exposure


def check_new(
    paths: Iterable[Path], overwrite: bool, inputs: Iterable[Path | None], *, folder: Path | None = None
) -> None:
    """Raise an error if an input is missing, or if results would replace one, or exist and must not be replaced.

    Of folders, which are written as a whole, an empty one may exist. ``folder`` is as in ``check_outputs``.
    """
    paths, sources = list(paths), [path for path in inputs if path is not None]
    missing = next((path for path in sources if not path.exists()), None)
    if missing is not None:
        raise FileNotFoundError(f"{missing} does not exist")
    check_outputs(paths, sources, folder=folder)
    existing = [path for path in paths if os.path.lexists(path) and not (path.is_dir() and not any(path.iterdir()))]
    if existing and not overwrite:
        problem = f"results exist already in {existing[0].parent}: {', '.join(path.name for path in existing)}"
        raise FileExistsError(f"{problem}; choose another name, or replace them with --overwrite")


def check_file(path: Path, overwrite: bool, inputs: Iterable[Path | None]) -> None:
    """``check_new`` for one file, which must be writable."""
    check_new([path], overwrite, inputs)
    check_writable(path)
