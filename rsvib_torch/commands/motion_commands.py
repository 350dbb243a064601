"""Commands for other motion and for the camera: ``motion``, ``known`` and ``calibrate``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import rsvib_torch
from rsvib_torch import detection, gyroscope, io, row_time, stacks
from rsvib_torch import report as reports
from rsvib_torch.checks.validation import options
from rsvib_torch.commands import answers
from rsvib_torch.commands import shared_options as shared
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.init import sensor_toml
from rsvib_torch.commands.stack_commands import load, print_notes
from rsvib_torch.commands.terminal import Answer, note, warn, working
from rsvib_torch.files.atomic import whole_file
from rsvib_torch.files.reading import Table
from rsvib_torch.options import FreeMotionOptions, MotionUnit, ProcessStackOptions
from rsvib_torch.text import measured_text

if TYPE_CHECKING:
    import torch

    from rsvib_torch.io.stack_info import StackInfo
    from rsvib_torch.results.presentation import Result


@options
class MotionOptions(shared.StackCommand, shared.VerdictOptions):
    """Options of ``motion``."""

    out: Path = option(...)
    """CSV file to write: time in s, x and y in px, and their standard deviations (model free)."""
    model: Literal["free", "swept"] = "free"
    """free: a smooth curve of any shape; swept: one sinusoid per axis whose amplitude decays or grows and whose
    frequency changes linearly."""
    detection: Annotated[Table, Given(FreeMotionOptions, ("knot_rows", "search"))]


def motion(given: MotionOptions) -> Answer:
    """Detect motion that is not a steady vibration.

    To restore frames with the CSV file: rsvib known --motion FILE --unit px --offset 0.
    """
    out, frames = given.out, given.frames
    shared.check_file(out, given.overwrite, given.inputs)
    chosen = {name: value for name, value in given.detection.items() if given.model == "free" or name == "search"}
    pixels, timing = load(given)
    result: detection.MotionDetection | detection.SweptTone
    with working("detecting the motion"):
        if given.model == "free":
            result = detection.detect_motion(pixels, timing, **chosen)
        else:
            result = detection.detect_swept_tone(pixels, timing, **chosen)
    columns = reports.motion_columns(result, timing)
    reports.write_columns(out, columns)
    known_motion = ("--motion", out, "--unit", "px", "--offset", "0")
    restore = ("known", frames, frames.with_name("restored.tif"), *given.settings.arguments, *known_motion)
    return Answer(
        {f"Motion in {frames.name}": [result.summary()]},
        {"motion": _without_curves(result), "columns": list(columns)},
        [out],
        [answers.next_step("restore the frames", *restore)] * bool(result.reliable.any()),
        answers.verdicts([result]),
    )


_CURVES = {"motion", "times", "displacement", "offsets", "residual", "light", "fitted_light", "measured", "predicted"}


def _without_curves(result: Result) -> Table:
    """The values of a result without its curves, which have a value for every row or knot."""
    curves = _CURVES | ({"std"} if isinstance(result, detection.MotionDetection) else set())
    return {name: value for name, value in result.to_dict().items() if name not in curves}


@options
class KnownOptions(shared.RestoredStack):
    """Options of ``known``."""

    motion: Path = option(...)
    """CSV file with the columns time in s, x and y; or, without --unit, the angular rates of a gyroscope: a gyroflow
    log (.gcsv), a GoPro video (.mp4), or CSV with three rates whose names state the unit."""
    unit: MotionUnit | None = option(None, show_default="the rates of a gyroscope")
    """Unit of x and y: px, an angle, or an angular rate."""
    focal_length: float | None = option(None, show_default="for a gyroscope, estimated from the frames")
    """Focal length in px; required for angles and angular rates."""
    lens_profile: Path | None = option(None, show_default="a lens without distortion")
    """With a gyroscope: lens profile of Gyroflow (JSON)."""
    offset: float | None = option(None, show_default="estimated from the frames")
    """With --unit: time of the recording, in s, at the exposure start of the first row of frame 0."""
    ignore: list[str] | None = option(None, metavar="ROWS[,COLUMNS]", show_default="all rows count")
    """Rows of the frames, or a part of them, that do not count in the comparison with the recording, for example 400:
    for a dashboard below row 400, or :60,500: for a sign in a corner; may be given several times."""
    force: bool = False
    """Restore even if the recording does not explain the motion of the frames, or the restored frames are judged no
    better than the input."""
    processing: Annotated[
        Table,
        Given(
            ProcessStackOptions,
            ("memory", "workers", "resume"),
            forms={
                "window": {
                    "text": "Largest number of frames that are restored and judged together.",
                    "show_default": "from the configuration, or 8",
                }
            },
        ),
    ]


def known(given: KnownOptions) -> Answer:
    """Restore frames with the recording of a gyroscope.

    The recording, which may also be that of an attitude sensor, is compared with the offsets of rows between the
    frames, and refused if it does not explain them. If the restored frames are judged no better than the input, the
    input is written unchanged, unless --force is given.
    """
    replaces = given.overwrite or "resume" in given.processing
    outputs = [*io.stack_files(given.restored), given.manifest]
    shared.check_new(outputs, replaces, [*given.inputs, given.motion, given.lens_profile])
    recorded = _recorded(given)
    info, scale, options = given.planned_stack({})
    info, timing = replace(info, full_scale=scale), given.settings.timing
    ignore = stacks.mask_of_regions(given.ignore or (), (info.shape[-2], info.shape[-1]))
    print_notes(info, given.settings)
    results: dict[str, list[str]] = {}
    data: Table = {"alignment": None, "check": None}
    # 1. The motion on the clock of the frames, which is stated or estimated.
    if isinstance(recorded, rsvib_torch.FreeMotion) and given.offset is not None:
        placed = _placed(given, recorded, timing, given.offset)
    else:
        chosen = gyroscope.AlignOptions(camera=_camera(given), ignore=ignore)
        with working("aligning the recording"):
            found = stacks.align_stack(given.frames, info, timing, recorded, chosen)
        results["Recording on the clock of the frames"] = [found.summary()]
        data["alignment"] = _without_curves(found)
        _refuse(given, found.reasons)
        placed = found.motion
    # 2. Whether it explains the offsets of rows; rates were compared by the alignment.
    if isinstance(recorded, rsvib_torch.FreeMotion):
        check = _check_motion(given, info, timing, placed, ignore)
        if check is not None:
            results["Motion of the frames"], data["check"] = [check.summary()], _without_curves(check)
    # 3. Restoration in windows.
    of_run = given.of_stack(scale, options) | {"force": given.force, "motion": placed}
    of_run |= {name: value for name, value in given.settings.stack.items() if name == "window"} | given.processing
    counts = info.shape[0] > 8
    with working(f"restoring {given.frames.name}", counts=counts) as progress:
        of_run["progress"] = progress if counts else None
        run = stacks.process_stack(given.frames, given.restored, timing, **of_run)
    results["Restoration"], data["restoration"] = answers.restoration_of(run, given.restored)
    return Answer(results, data, [given.restored, given.manifest])


def _recorded(given: KnownOptions) -> rsvib_torch.FreeMotion | rsvib_torch.AngularRates:
    """The motion of a CSV file, or the rates of a gyroscope."""
    if given.unit is not None:
        if given.lens_profile is not None:
            raise ValueError("--lens-profile is for a gyroscope, without --unit")
        return rsvib_torch.read_motion(given.motion, unit=given.unit, focal_length=given.focal_length)
    if given.offset is not None:
        raise ValueError("--offset needs --unit; axes and clock of a gyroscope are estimated from the frames")
    if given.lens_profile is not None and given.focal_length is not None:
        raise ValueError("--lens-profile and --focal-length both state the focal length: give one of them")
    return rsvib_torch.read_gyroscope(given.motion)


def _camera(given: KnownOptions) -> rsvib_torch.Camera | None:
    """The stated lens of a gyroscope."""
    if given.lens_profile is not None:
        return rsvib_torch.Camera.from_gyroflow(given.lens_profile, given.info.shape[-1], given.info.shape[-2])
    return None if given.unit is not None or given.focal_length is None else rsvib_torch.Camera(given.focal_length)


def _placed(
    given: KnownOptions, recorded: rsvib_torch.FreeMotion, timing: rsvib_torch.SensorTiming, offset: float
) -> rsvib_torch.FreeMotion:
    """A recording whose clock is stated, if it covers the frames."""
    info, placed = given.info, recorded.retimed(offset)
    starts = io.timing_from_first_frame(timing, info).frame_starts(info.shape[0])
    readout = info.shape[int(timing.scan_axis)] * timing.row_time + timing.exposure_time
    last = float(starts[-1] - starts[0]) + readout
    if placed.start > 1e-9 or placed.end < last - 1e-9:  # s; rounding of the offset
        needed = f"the frames need {offset:.6g} to {offset + last:.6g} s"
        raise ValueError(f"{given.motion}: covers {recorded.start:.6g} to {recorded.end:.6g} s, {needed}")
    return placed


def _refuse(given: KnownOptions, reasons: tuple[str, ...]) -> None:
    """Raise an error with the reasons against a recording, or print them as warnings with ``--force``."""
    if reasons and not given.force:
        raise ValueError(f"{given.motion}: {'; '.join(reasons)}; --force restores with it nevertheless")
    for reason in reasons:
        warn(reason)


def _check_motion(
    given: KnownOptions,
    info: StackInfo,
    timing: rsvib_torch.SensorTiming,
    motion: rsvib_torch.FreeMotion,
    ignore: torch.Tensor | None,
) -> gyroscope.MotionCheck | None:
    """Compare the offsets of rows before and after correction with a motion, and refuse a motion that enlarges them.

    Of a long stack, frames in its middle are compared. If the clock is stated, an error is a warning.
    """
    try:
        with working("comparing the motion"):
            check = stacks.check_stack_motion(given.frames, info, timing, motion, ignore)
    except ValueError as error:
        if given.offset is None:
            raise
        warn(f"cannot determine whether the motion fits: {error}")
        return None
    if check.helps:
        for reason in check.reasons:
            warn(reason)
    else:
        _refuse(given, check.reasons)
    return check


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
    on_fraction: float | None = None
    """Duty cycle of a light that is switched on and off; determines the exposure time."""
    gamma: float | None = option(None, show_default="1")
    """With --frequency: exponent that makes pixel values proportional to light."""
    row_time: list[float] | None = option(
        None, show_default="a readout within a tenth to the whole of the frame period", **shared.TIME
    )
    """With --by-motion: given twice, the shortest and the longest possible row time, e.g. 10us."""
    exposure: float | None = option(None, **shared.TIME)
    """With --by-motion, if known: exposure time, e.g. 1/1000."""
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
    """Measure row time and exposure with a flickering light or motion.

    The readout direction is measured as well. With --by-motion, a row time that is not certain is refused with the
    reason.
    """
    light: Table = {
        "flicker_frequency": given.flicker_frequency,
        "on_fraction": given.on_fraction,
        "gamma": given.gamma,
    }
    limits = None if given.row_time is None else tuple(given.row_time)
    motion: Table = {"row_time": limits, "exposure_time": given.exposure}
    motion["readout_direction"] = given.readout_direction
    chosen, others = (motion, light) if given.by_motion else (light, motion)
    if any(value is not None for value in others.values()):
        listed = "--frequency, --on-fraction and --gamma are for a flickering light, not for --by-motion"
        listed = listed if given.by_motion else "--row-time, --exposure and --readout-direction are for --by-motion"
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
    values = {name: getattr(result, name) for name in ("row_time", "row_time_std", "exposure_time")} | period
    values |= {"scan_axis": given.scan_axis, "readout_direction": result.readout_direction}
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
        {"calibration": _without_curves(result)},
        [] if given.out is None else [given.out],
        steps,
    )
