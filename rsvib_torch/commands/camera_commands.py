"""The commands ``init``, ``calibrate`` and ``cameras``: the configuration file of a camera, and its row time."""

import math
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rsvib_torch import gyroscope, io, row_time
from rsvib_torch.checks.values import MistakesError, fields_of, options
from rsvib_torch.commands import answers
from rsvib_torch.commands import shared_options as shared
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.terminal import Answer, note, warn, working
from rsvib_torch.config import read_config
from rsvib_torch.files.atomic import whole
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.cameras import camera_mode, find_cameras
from rsvib_torch.motion.timing import SensorSection, SensorTiming
from rsvib_torch.text import measured_text, number_of, one_line, printable, text_table

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
        Table, Given(SensorSection, forms={**shared.SENSOR_FORMS, "full_scale": {"show_default": "from the file"}})
    ]
    camera: str | None = None
    """Model of the camera, for its measured row time (rsvib cameras lists them)."""
    overwrite: bool = False
    """Replace an existing configuration file."""


def init(command: InitOptions) -> Answer:
    """Write a configuration file for the camera of a stack of frames.

    What the file does not state is taken from the options; an error explains where to find what is missing.
    """
    frames, out = command.frames, command.out
    if command.camera is not None and "row_time" in command.sensor:
        raise ValueError("--camera and --row-time both state the row time; give one of them")
    shared.check_file(out, command.overwrite, io.stack_files(frames))
    text = _describe_camera(frames, command.sensor, command.camera)
    with whole(out) as file:
        file.write_text(text, encoding="utf-8")
    return Answer({}, {}, [out], [answers.run_step(frames, Path("results"), ["--config", str(out)])])


@options
class CamerasOptions:
    """Options of ``cameras``."""

    search: list[str] | None = argument(default=None)
    """Words of its name, e.g. iphone 12."""


def cameras(command: CamerasOptions) -> Answer:
    """List camera models with known row times.

    A line for each mode whose readout time is known: median and spread of calibrations by users of Gyroflow (CC0
    1.0). rsvib init --camera NAME takes the row time.
    """
    modes = find_cameras(" ".join(command.search or ()))
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
    sensor = {"row_time": mode.row_time, "row_time_std": mode.row_time_std}
    return sensor, f"row time {time} us, from gyroflow/lens_profiles: {mode}"


def _describe_camera(path: Path, sensor: Table, camera: str | None) -> str:
    """Text of the configuration file: values of the command line and of the file of the frames."""
    with working(f"reading {path}"):
        info = io.read_stack_info(path)
    # three or four images of a stack may be stored as the colours of one frame
    of = f"{info.shape[1]} channels of " if info.shape[0] == 1 and len(info.shape) > 3 else ""
    frames = f"{number_of(info.shape[0], 'frame')} of {of}{info.shape[-2]} x {info.shape[-1]} px"
    size = f"{frames} (height x width), {info.dtype}"
    note(f"{path}: {size}")
    values, rows = dict(sensor), info.shape[-1 if sensor.get("scan_axis") == "x" else -2]
    rate_of_file = io.stated_rate(info)
    if rate_of_file is not None and "frame_rate" not in sensor:
        values["frame_rate"] = rate_of_file
        note(f"frame rate {rate_of_file:.6g} per second, from the times in the file")
    elif rate_of_file is not None and not math.isclose(rate_of_file, sensor["frame_rate"], rel_tol=0.01):
        warn(f"--frame-rate is {sensor['frame_rate']:g}, the times in the file give {rate_of_file:.6g}")
    source, proposal = None, ""
    if camera is not None:
        row_time, source = _row_time_of(camera, info, values)
        values |= row_time
        note(source)
    elif info.camera is not None and "row_time" not in sensor:
        try:
            _, proposed = _row_time_of(info.camera, info, values)
            proposal = f' The file names its camera: --camera "{info.camera}" takes {proposed}.'
        except ValueError as error:
            proposal = f" The file names its camera, {info.camera}: {error}."
    if info.dtype != "uint8" and info.full_scale is not None:
        values.setdefault("full_scale", info.full_scale)
    track = gyroscope.read_camera_track(path)
    if track is not None and "exposure_time" not in values and (exposure := shared.stated_exposure(path)) is not None:
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
        raise MistakesError("\n".join(one_line(mistake, 1000) for mistake in mistakes))


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


# Frames that are measured. With a flickering light, 30 of 1080 rows take 25 s. With --by-motion, 10 of 640 x 360 px
# that vibrate with two tones have four possible row times, and 24 have one, with a relative standard deviation of 2e-4,
# in 40 s of a processor.
_CALIBRATED_FRAMES = 32


@options
class CalibrateOptions:
    """Options of ``calibrate``."""

    frames: list[Path] = argument()
    """One or more stacks of frames: TIFF, PNG, video ...; of NAME[100:200] frames 100 to 199."""
    by_motion: bool = False
    """Use the motion of the camera instead of a light."""
    flicker_frequency: float | None = option(None, "--frequency")
    """Flicker frequency in Hz; a mains-powered light flickers at twice the mains frequency."""
    row_time: list[float] | None = option(
        None, show_default="a readout within a tenth to the whole of the frame period", **shared.TIME
    )
    """With --by-motion: given twice, the shortest and the longest possible row time, e.g. 10us."""
    exposure_time: float | None = option(None, "--exposure", show_default="left open in the file", **shared.TIME)
    """Exposure time, e.g. 1/1000: the setting of the camera."""
    readout_direction: Literal["forward", "reverse"] | None = option(None, show_default="determined from the frames")
    """With --by-motion, if known: forward if the top row (or left column) is read first, reverse if the last one is."""
    frame_rate: float | None = option(None, **shared.SENSOR_FORMS["frame_rate"])
    scan_axis: Literal["y", "x"] = "y"
    """Image axis along which the rows follow each other."""
    full_scale: float | None = None
    """Count that corresponds to full scale."""
    out: Path | None = None
    """Configuration file to write, with the table [sensor]."""
    overwrite: bool = False
    """Replace results that exist already."""


def calibrate(command: CalibrateOptions) -> Answer:
    """Measure the row time with a flickering light, or row time and readout direction with motion.

    With --by-motion, a row time that is not certain is refused with the reason.
    """
    # 1. The frames, and what is known of them.
    paths, out = command.frames, command.out
    if out is not None:
        shared.check_file(out, command.overwrite, [file for path in paths for file in io.stack_files(path)])
    infos = [io.read_stack_info(path) for path in paths]
    if io.split_range(paths[0])[1] is None and infos[0].shape[0] > _CALIBRATED_FRAMES:
        note(f"the first {_CALIBRATED_FRAMES} of {infos[0].shape[0]} frames are used; NAME[START:END] are others")
        paths = [paths[0].with_name(f"{paths[0].name}[0:{_CALIBRATED_FRAMES}]")]
        infos = [io.read_stack_info(paths[0])]
    for sentence in (sentence for info in infos for sentence in io.describe_stack(info, None)):
        note(sentence)
    known = _known_of(command, paths[0])
    # 2. The row time.
    with working("reading the frames"):
        stack = io.read_stack(paths, full_scale=command.full_scale)
    measure = row_time.calibrate_row_time_by_motion if command.by_motion else row_time.calibrate_row_time
    with working("measuring the motion" if command.by_motion else "measuring the flicker"):
        result = measure(stack, **known)
    if result.row_time is None or result.row_time_std is None or not result.reliable:
        raise ValueError(f"the row time is not certain: {'; '.join(result.reasons)}")
    # 3. The configuration file, in which unknown values are comments.
    values: Table = {"row_time": result.row_time, "row_time_std": result.row_time_std}
    values["exposure_time"] = command.exposure_time
    values |= {"frame_rate": None} if result.frame_rows is None else {"frame_rows": result.frame_rows}
    values["scan_axis"] = command.scan_axis
    values |= {"readout_direction": result.readout_direction} if command.by_motion else {}
    table = sensor_toml(values, ["Written by rsvib calibrate.", *result.notes])
    steps = ["enter the values that are left open"] * (" = \n" in table)
    if out is None:
        steps.insert(0, "write these values into a configuration file with --out, or copy them")
    else:
        with whole(out) as file:
            file.write_text(table, encoding="utf-8")
        steps.append(answers.next_step("detect a vibration", "detect", "FRAMES", "--config", out, "--out", "FOLDER"))
    rows = stack.shape[known["scan_axis"]]
    readout = measured_text(1e3 * result.row_time * rows, 1e3 * result.row_time_std * rows)
    return Answer(
        {"Camera": [result.summary(), f"{rows} rows are read in {readout} ms"], "Configuration": [table]},
        {"calibration": answers.without_curves(result)},
        [] if out is None else [out],
        steps,
    )


def _known_of(command: CalibrateOptions, path: Path) -> Table:
    """Arguments of the function that measures the row time."""
    known: Table = {"frame_rate": command.frame_rate, "scan_axis": -1 if command.scan_axis == "x" else -2}
    if not command.by_motion:
        if command.row_time is not None or command.readout_direction is not None:
            raise ValueError("--row-time and --readout-direction are for --by-motion; leave them out")
        if command.flicker_frequency is None:
            raise ValueError("give --frequency of the flicker, or --by-motion for frames of a vibrating camera")
        return known | {"flicker_frequency": command.flicker_frequency}
    if command.flicker_frequency is not None:
        raise ValueError("--frequency is for a flickering light, not for --by-motion; leave it out")
    if command.row_time is not None and len(command.row_time) != 2:
        raise ValueError("give --row-time twice: the shortest and the longest possible row time")
    if command.frame_rate is None:
        known["frame_rate"] = shared.rate_of_file(path)
    if known["frame_rate"] is None:
        raise ValueError("--by-motion needs --frame-rate of the sensor: the row time is found relative to it")
    limits = None if command.row_time is None else tuple(command.row_time)
    known |= {} if limits is None else {"row_time": limits}
    return known | {"readout_direction": command.readout_direction, "exposure_time": command.exposure_time}
