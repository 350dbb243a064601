"""The command ``calibrate``: row time from frames."""

from pathlib import Path
from typing import Literal

from rsvib_torch import io, row_time
from rsvib_torch.checks.validation import options
from rsvib_torch.commands import answers
from rsvib_torch.commands import shared_options as shared
from rsvib_torch.commands.flat_command import argument, option
from rsvib_torch.commands.init import sensor_toml
from rsvib_torch.commands.terminal import Answer, note, working
from rsvib_torch.files.atomic import whole_file
from rsvib_torch.files.reading import Table
from rsvib_torch.text import measured_text

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


def calibrate(given: CalibrateOptions) -> Answer:
    """Measure the row time with a flickering light, or row time and readout direction with motion.

    With --by-motion, a row time that is not certain is refused with the
    reason.
    """
    light: Table = {"flicker_frequency": given.flicker_frequency}
    limits = None if given.row_time is None else tuple(given.row_time)
    if limits is not None and len(limits) != 2:
        raise ValueError("give --row-time twice: the shortest and the longest possible row time")
    motion: Table = {"row_time": limits, "readout_direction": given.readout_direction}
    chosen, others = (motion, light) if given.by_motion else (light, motion)
    if any(value is not None for value in others.values()):
        listed = "--frequency is for a flickering light, not for --by-motion"
        listed = listed if given.by_motion else "--row-time and --readout-direction are for --by-motion"
        raise ValueError(f"{listed}; leave them out")
    if not given.by_motion and given.flicker_frequency is None:
        raise ValueError("give --frequency of the flicker, or --by-motion for frames of a vibrating camera")
    paths = given.frames
    if given.out is not None:
        shared.check_file(given.out, given.overwrite, [file for path in paths for file in io.stack_files(path)])
    infos = [io.read_stack_info(path) for path in paths]
    if io.split_range(paths[0])[1] is None and infos[0].shape[0] > _CALIBRATED_FRAMES:
        note(f"the first {_CALIBRATED_FRAMES} of {infos[0].shape[0]} frames are used; NAME[START:END] are others")
        paths = [paths[0].with_name(f"{paths[0].name}[0:{_CALIBRATED_FRAMES}]")]
        infos = [io.read_stack_info(paths[0])]
    for sentence in (sentence for info in infos for sentence in io.describe_stack(info, None)):
        note(sentence)
    of_both: Table = {name: value for name, value in chosen.items() if value is not None}
    if given.by_motion and given.exposure_time is not None:
        of_both["exposure_time"] = given.exposure_time
    of_both |= {"frame_rate": given.frame_rate, "scan_axis": -1 if given.scan_axis == "x" else -2}
    if given.by_motion and given.frame_rate is None:
        of_both["frame_rate"] = shared.rate_of_file(paths[0])
        if of_both["frame_rate"] is None:
            raise ValueError("--by-motion needs --frame-rate of the sensor: the row time is found relative to it")
    with working("reading the frames"):
        stack = io.read_stack(paths, full_scale=given.full_scale)
    measure = row_time.calibrate_row_time_by_motion if given.by_motion else row_time.calibrate_row_time
    with working("measuring the motion" if given.by_motion else "measuring the flicker"):
        result = measure(stack, **of_both)
    if result.row_time is None or result.row_time_std is None or not result.reliable:
        raise ValueError(f"the row time is not certain: {'; '.join(result.reasons)}")
    period: Table = {"frame_rate": None} if result.frame_rows is None else {"frame_rows": result.frame_rows}
    direction = {"readout_direction": result.readout_direction} if given.by_motion else {}
    values: Table = {name: getattr(result, name) for name in ("row_time", "row_time_std")}
    values |= {"exposure_time": given.exposure_time} | period | {"scan_axis": given.scan_axis} | direction
    table = sensor_toml(values, ["Written by rsvib calibrate.", *result.notes])  # unknown values are comments
    rows = stack.shape[of_both["scan_axis"]]
    readout = measured_text(1e3 * result.row_time * rows, 1e3 * result.row_time_std * rows)
    steps = ["enter the values that are left open"] * (" = \n" in table)
    if given.out is None:
        steps = ["write these values into a configuration file with --out, or copy them", *steps]
    else:
        with whole_file(given.out) as file:
            file.write_text(table, encoding="utf-8")
        command = ("detect", "FRAMES", "--config", given.out, "--out", "FOLDER")
        steps.append(answers.next_step("detect a vibration", *command))
    return Answer(
        {"Camera": [result.summary(), f"{rows} rows are read in {readout} ms"], "Configuration": [table]},
        {"calibration": answers.without_curves(result)},
        [] if given.out is None else [given.out],
        steps,
    )
