"""Commands ``init``, a configuration file for the camera of a stack, and ``cameras``, the known camera models."""

import math
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rsvib_torch import gyroscope, io
from rsvib_torch.checks.validation import MistakesError, fields_of, options
from rsvib_torch.commands.answers import run_step
from rsvib_torch.commands.flat_command import Given, argument
from rsvib_torch.commands.shared_options import SENSOR_FORMS, check_file, stated_exposure
from rsvib_torch.commands.terminal import Answer, note, warn, working
from rsvib_torch.config import read_config
from rsvib_torch.files.atomic import whole_file
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.cameras import camera_mode, find_cameras
from rsvib_torch.motion.timing import SensorSection, SensorTiming
from rsvib_torch.text import measured_text, printable, text_table

if TYPE_CHECKING:
    from rsvib_torch.io.stack_info import StackInfo

# How to find each value of [sensor]: comments of the file, and the text of errors.
_HINTS: dict[str, str] = {name: field.description for name, field in fields_of(SensorSection).items()}


@options
class InitOptions:
    """Options of ``init``."""

    frames: Path = argument()
    """Stack of frames of the camera; its size, frame rate and times are read."""
    out: Path = Path("camera.toml")
    """Configuration file to write."""
    sensor: Annotated[
        Table, Given(SensorSection, forms={**SENSOR_FORMS, "full_scale": {"show_default": "from the file"}})
    ]
    camera: str | None = None
    """Model of the camera, for its measured row time (rsvib cameras lists them)."""
    overwrite: bool = False
    """Replace an existing configuration file."""


def init(given: InitOptions) -> Answer:
    """Write a configuration file for the camera of a stack of frames.

    What the file does not state is taken from the options; an error explains where to find what is missing.
    """
    frames, out = given.frames, given.out
    if given.camera is not None and "row_time" in given.sensor:
        raise ValueError("--camera and --row-time both state the row time; give one of them")
    check_file(out, given.overwrite, io.stack_files(frames))
    text = _describe_camera(frames, given.sensor, given.camera)
    with whole_file(out) as file:
        file.write_text(text, encoding="utf-8")
    return Answer({}, {}, [out], [run_step(frames, Path("results"), ["--config", str(out)])])


@options
class CamerasOptions:
    """Options of ``cameras``."""

    search: list[str] | None = argument(default=None)
    """Words of its name, e.g. iphone 12."""


def cameras(given: CamerasOptions) -> Answer:
    """List camera models with known row times.

    A line for each mode whose readout time is known: median and spread of calibrations by users of Gyroflow (CC0
    1.0). rsvib init --camera NAME takes the row time.
    """
    modes = find_cameras(" ".join(given.search or ()))
    head = ("brand", "model", "view", "width x height", "fps", "readout (ms)", "row time (us)", "entries")
    rows = []
    for mode in modes:
        readout = measured_text(1e3 * mode.readout_time, 1e3 * mode.readout_time_std)
        times = (readout, measured_text(1e6 * mode.row_time, 1e6 * mode.row_time_std))
        size = (f"{mode.width} x {mode.height}", f"{mode.frame_rate:g}")
        rows.append((mode.brand, mode.model, mode.lens, *size, *times, str(mode.calibrations)))
    data = [asdict(mode) | {"row_time": mode.row_time, "row_time_std": mode.row_time_std} for mode in modes]
    return Answer({"Cameras": [text_table(head, rows, most=len(rows))]}, {"cameras": data})


def _row_time_of(camera: str, info: "StackInfo", values: Table) -> tuple[dict[str, float], str]:
    """Row time in s of a camera model in the mode of the frames, with its std, and where it comes from."""
    if "frame_rate" not in values:
        raise ValueError(f"the mode of {camera} depends on the frame rate: give --frame-rate")
    rows, columns = info.shape[-2:] if values.get("scan_axis") != "x" else info.shape[:-3:-1]
    mode = camera_mode(camera, width=columns, height=rows, frame_rate=values["frame_rate"])
    time = measured_text(1e6 * mode.row_time, 1e6 * mode.row_time_std)
    found = {"row_time": mode.row_time, "row_time_std": mode.row_time_std}
    return found, f"row time {time} us, from gyroflow/lens_profiles: {mode}"


def _describe_camera(path: Path, given: Table, camera: str | None) -> str:
    """Text of the configuration file: values of the command line and of the file of the frames."""
    with working(f"reading {path}"):
        info = io.read_stack_info(path)
    size = f"{info.shape[0]} frames of {info.shape[-2]} x {info.shape[-1]} px (height x width), {info.dtype}"
    note(f"{path}: {size}")
    values, rows = dict(given), info.shape[-1 if given.get("scan_axis") == "x" else -2]
    stated = io.stated_rate(info)
    if stated is not None and "frame_rate" not in given:
        values["frame_rate"] = stated
        note(f"frame rate {stated:.6g} per second, from the times in the file")
    elif stated is not None and not math.isclose(stated, given["frame_rate"], rel_tol=0.01):
        warn(f"--frame-rate is {given['frame_rate']:g}, the times in the file give {stated:.6g}")
    source, proposal = None, ""
    if camera is not None:
        known, source = _row_time_of(camera, info, values)
        values |= known
        note(source)
    elif info.camera is not None and "row_time" not in given:
        try:
            _, proposed = _row_time_of(info.camera, info, values)
            proposal = f' The file names its camera: --camera "{info.camera}" takes {proposed}.'
        except ValueError as error:
            proposal = f" The file names its camera, {info.camera}: {error}."
    if info.dtype != "uint8" and info.full_scale is not None:
        values.setdefault("full_scale", info.full_scale)
    track = gyroscope.read_camera_track(path)
    if track is not None and "exposure_time" not in values and (exposure := stated_exposure(path)) is not None:
        values["exposure_time"] = exposure
    if track is not None and track.stabilised:
        warn(
            f"the camera has stabilised the frames (IORI in the track of the video): it turned them by up to "
            f"{math.degrees(track.turned):.2g} degrees, and their rows no longer show its motion"
        )
    _check_complete(values, info, rows, proposal)
    _check_timing(read_config(None, sensor=values).timing, rows)
    head = [
        f"Camera of {printable(path.name)}: {size}. Written by rsvib init.",
        "Values hold for one mode of the camera: resolution, cropping, binning and frame rate change the row time.",
    ]
    if source is not None:
        head.append(f"{source[0].upper()}{source[1:]}. Users measured it: confirm it with rsvib calibrate.")
    if info.frame_times is not None and not info.time_error:
        head.append("The frames file states the time of every frame, which all commands use.")
    order = ("row_time", "row_time_std", "exposure_time", "frame_rate", "scan_axis", "readout_direction", "full_scale")
    values = {"scan_axis": "y", "readout_direction": "forward"} | values
    return sensor_toml({name: values[name] for name in order if name in values}, head)


def _check_complete(values: Table, info: "StackInfo", rows: int, proposal: str) -> None:
    """Raise an error that names the values that are missing, with what states each of them."""
    needed = {"frame_rate": "--frame-rate", "row_time": "--row-time", "exposure_time": "--exposure"}
    needed |= {"full_scale": "--full-scale"} if info.is_integer and info.full_scale is None else {}
    mistakes = []
    for name in (name for name in needed if name not in values):
        hint = f"{needed[name]} is missing. {_HINTS[name]}"
        if name == "row_time" and values.get("frame_rate"):
            hint += f" Here it is less than {1e6 / (values['frame_rate'] * rows):.4g} us.{proposal}"
        mistakes.append(hint)
    if mistakes:
        raise MistakesError(mistakes)


def _check_timing(timing: SensorTiming, rows: int) -> None:
    """Refuse a row time that is too long for the frame rate, and warn of values that are typical mistakes."""
    timing.check_rows(rows)
    used = rows / timing.frame_rows
    readout, period = 1e3 * rows * timing.row_time, 1e3 * timing.frame_period
    note(f"readout of {rows} rows takes {readout:.4g} ms of the frame period of {period:.4g} ms")
    if used > 0.995:  # of the frame period; sensors have at least some blanking rows, data sheets three digits
        warn(
            "the row time equals 1 / (frame rate x rows), which is rarely true, because sensors have blanking rows: "
            "take it from the data sheet, or measure it with rsvib calibrate"
        )
    elif used < 0.01:  # of the frame period: rarer than a value in a wrong unit
        warn(f"the readout takes only {100 * used:.2g} % of the frame period: check the unit of the row time")


def sensor_toml(values: Table, head: list[str]) -> str:
    """Text of a configuration file with the table ``[sensor]``; the key of an unknown value (None) is a comment."""

    def comment(text: str) -> list[str]:
        return textwrap.wrap(text, 76, initial_indent="# ", subsequent_indent="# ")

    lines = [*(line for text in head for line in comment(text)), "", "[sensor]"]
    for name, value in values.items():
        text = f'"{value}"' if isinstance(value, str) else f"{value:.10g}" if isinstance(value, float) else str(value)
        lines += ["", *comment(_HINTS[name]), f"# {name} = " if value is None else f"{name} = {text}"]
    return "\n".join(lines) + "\n"
