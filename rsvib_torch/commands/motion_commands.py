"""Commands for other motion and for the camera: ``motion``, ``known`` and ``calibrate``."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import rsvib_torch
from rsvib_torch import calibration, detection, io
from rsvib_torch.commands.answers import command_text, restoration_data, restoration_lines
from rsvib_torch.commands.init import sensor_toml
from rsvib_torch.commands.shared_options import (
    READOUT_HELP,
    CameraSettings,
    DeviceOption,
    FrameRateOption,
    FramesArgument,
    OverwriteOption,
    RestoredArgument,
    ScaleOption,
    StacksArgument,
    check_new,
    planned_restoration,
    restored_shape,
    seconds,
)
from rsvib_torch.commands.stack_commands import load, restore_and_save
from rsvib_torch.commands.terminal import Answer, error_line, note, working
from rsvib_torch.core.atomic import check_writable, whole_file
from rsvib_torch.core.text import measured_text
from rsvib_torch.options import FreeMotionOptions, MotionUnit, TimeUnit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    from rsvib_torch.calibration import RowTimeCalibration
    from rsvib_torch.core.presentation import Result
    from rsvib_torch.detection import MotionCheck, MotionDetection, SweptTone
    from rsvib_torch.motion.gyroscope_rates import AngularRates
    from rsvib_torch.motion.spline import FreeMotion
    from rsvib_torch.motion.timing import SensorTiming

    Array = NDArray[np.float64]


def motion(
    frames: FramesArgument,
    *,
    settings: CameraSettings,
    out: Annotated[
        Path,
        typer.Option(help="CSV file to write: time in s, x and y in px, and their standard deviations (model free)."),
    ],
    model: Annotated[
        Literal["free", "swept"],
        typer.Option(
            help="free: a smooth curve of any shape; swept: one sinusoid per axis whose amplitude decays or grows and "
            "whose frequency changes linearly."
        ),
    ] = "free",
    knot_rows: Annotated[
        int, typer.Option(help="Distance of the knots of a free motion, in rows.")
    ] = FreeMotionOptions.knot_rows,
    search: Annotated[
        int, typer.Option(help="Search range for the offset of a row, in px around the offset of its whole frame.")
    ] = FreeMotionOptions.search,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Detect motion that is not a steady vibration.

    To restore frames with the CSV file: rsvib known --motion FILE --unit px --offset 0.
    """
    check_new([out], overwrite, [*io.stack_files(frames), settings.path])
    check_writable(out)
    stack = load(frames, settings, full_scale, device)
    result: MotionDetection | SweptTone
    with working("detecting the motion"):
        if model == "free":
            result, names, table = _detect_free_motion(stack.frames, stack.timing, knot_rows, search)
        else:
            result, names, table = _detect_swept_tone(stack.frames, stack.timing, search)
    with whole_file(out) as file, file.open("w", newline="", encoding="utf-8") as text:
        writer = csv.writer(text)
        writer.writerow(names)
        writer.writerows([f"{time:.9f}", *(f"{value:.5f}" for value in row)] for time, *row in table)
    target = frames.with_name("restored.tif")
    restore_it = command_text(
        "known", frames, target, *settings.arguments, "--motion", out, "--unit", "px", "--offset", "0"
    )
    return Answer(
        {f"Motion in {frames.name}": [result.summary()]},
        {"motion": _without_curve(result), "columns": list(names)},
        [out],
        [f"restore the frames:\n  {restore_it}"] * bool(result.reliable.any()),
    )


def _detect_free_motion(
    frames: Tensor, timing: SensorTiming, knot_rows: int, search: int
) -> tuple[MotionDetection, tuple[str, ...], Array]:
    """Detect a free motion, and sample it twice per knot."""
    import numpy as np  # noqa: PLC0415

    result = detection.detect_motion(frames, timing, knot_rows=knot_rows, search=search)
    times, values = _sampled(result.motion, float(result.times.max()) + timing.exposure_time, 0.5)
    measured, stds = result.times.flatten().cpu().numpy(), result.std.flatten(0, 1).cpu().numpy()
    interpolated = [np.interp(times, measured, stds[:, axis]) for axis in range(2)]
    return result, ("time", "x", "y", "std_x", "std_y"), np.column_stack([times, values, *interpolated])


def _detect_swept_tone(frames: Tensor, timing: SensorTiming, search: int) -> tuple[SweptTone, tuple[str, ...], Array]:
    """Detect a swept tone per axis, and sample its motion once per knot."""
    import numpy as np  # noqa: PLC0415

    result = detection.detect_swept_tone(frames, timing, search=search)
    times, samples = _sampled(result.motion, result.motion.end, 1.0)
    return result, ("time", "x", "y"), np.column_stack([times, samples])


def _without_curve(result: Result) -> dict[str, Any]:
    """The values of a result without its curves, which have a value for every row or knot."""
    curve = {"motion", "times", "displacement", "offsets", "residual", "light", "fitted_light"}
    curve |= {"measured", "predicted"}
    curve |= {"std"} if isinstance(result, detection.MotionDetection) else set()
    return {name: value for name, value in result.to_dict().items() if name not in curve}


def _sampled(motion: FreeMotion, last: float, knots: float) -> tuple[Array, Array]:
    """Displacement (N, 2) of a motion at equidistant times (N,) up to ``last``, at most ``knots`` knots apart."""
    import numpy as np  # noqa: PLC0415
    import torch  # noqa: PLC0415

    end = max(motion.end, last)
    times = np.linspace(motion.start, end, math.ceil((end - motion.start) / (knots * motion.spacing)) + 1)
    return times, motion.displacement(torch.from_numpy(times).to(motion.device)).cpu().numpy()


def known(
    frames: FramesArgument,
    restored: RestoredArgument,
    *,
    settings: CameraSettings,
    motion: Annotated[
        Path,
        typer.Option(
            help="CSV file with the columns time, x and y; or, without --unit, the angular rates of a gyroscope: a "
            "gyroflow log (.gcsv), a GoPro video (.mp4), or CSV with three rates whose names state the unit."
        ),
    ],
    unit: Annotated[
        MotionUnit | None,
        typer.Option(
            help="Unit of x and y: px, an angle, or an angular rate.", show_default="the rates of a gyroscope"
        ),
    ] = None,
    focal_length: Annotated[
        float | None,
        typer.Option(
            help="Focal length in px; required for angles and angular rates.",
            show_default="for a gyroscope, estimated from the frames",
        ),
    ] = None,
    time_unit: Annotated[TimeUnit, typer.Option(help="Unit of the times.")] = "s",
    flip_x: Annotated[bool, typer.Option("--flip-x", help="Positive x moves the image towards smaller x.")] = False,
    flip_y: Annotated[bool, typer.Option("--flip-y", help="Positive y moves the image towards smaller y.")] = False,
    offset: Annotated[
        float | None,
        typer.Option(
            help="Time of the recording, in s, at the exposure start of the first row of frame 0.",
            show_default="estimated from the frames",
        ),
    ] = None,
    offsets: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="LOW HIGH",
            help="Smallest and largest time of the recording, in s, at the exposure start of the first row of frame 0, "
            "between which it is estimated.",
            show_default="all for which the recording covers the frames",
        ),
    ] = None,
    fit_gain: Annotated[
        bool, typer.Option("--fit-gain", help="Estimate the focal length from the frames as well.")
    ] = False,
    fit_row_time: Annotated[
        bool,
        typer.Option("--fit-row-time", help="With a gyroscope: estimate the row time from the frames as well."),
    ] = False,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Restore even if the recording does not explain the motion of the frames, or the restored frames are "
            "judged no better than the input.",
        ),
    ] = False,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Restore frames with a motion that was recorded by a gyroscope or attitude sensor.

    The recording is compared with the offsets of rows between the frames, and refused if it does not explain them. If
    the restored frames are judged no better than the input, the input is written unchanged, unless --force is given.
    """
    check_new(io.stack_files(restored), overwrite, [*io.stack_files(frames), settings.path, motion])
    if offset is not None and offsets is not None:
        raise ValueError("--offset states the clock and --offsets limits its estimate: give one of them")
    if unit is not None and fit_row_time:
        raise ValueError("--fit-row-time is for a gyroscope, without --unit")
    from rsvib_torch.motion.spline import FreeMotion  # noqa: PLC0415

    recorded: FreeMotion | AngularRates
    camera = None
    if unit is None:
        if flip_x or flip_y or offset is not None or time_unit != "s":
            raise ValueError(
                "--flip-x, --flip-y, --offset and --time-unit are for a CSV file with the columns time, x and y, and "
                "need --unit; axes and clock of a gyroscope are estimated from the frames"
            )
        recorded = rsvib_torch.read_gyroscope(motion)
        camera = None if focal_length is None else rsvib_torch.Camera(focal_length)
    else:
        recorded = rsvib_torch.read_motion(
            motion,
            unit=unit,
            focal_length=focal_length,
            time_unit=time_unit,
            signs=(-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0),
        )
    info, scale, options = planned_restoration(frames, settings, full_scale)
    io.check_stack_target(restored, restored_shape(info, options), dtype=info.dtype, full_scale=scale, like=info)
    results: dict[str, list[str]] = {}
    data: dict[str, Any] = {"alignment": None, "check": None}
    stack = load(frames, settings, full_scale, device, options)
    if offset is None or not isinstance(recorded, FreeMotion):
        with working("aligning the recording"):
            found = detection.align_motion(
                stack.frames,
                stack.timing,
                recorded,
                camera=camera,
                offsets=offsets,
                fit_gain=fit_gain,
                fit_row_time=fit_row_time,
            )
        results["Recording on the clock of the frames"] = [found.summary()]
        data["alignment"] = _without_curve(found)
        _refuse(motion, found.reasons, force)
        placed = found.motion
        if fit_row_time and isinstance(found, detection.RotationAlignment):
            stack = replace(stack, timing=_with_row_time(stack.timing, found.row_time))
    else:
        placed = recorded.retimed(offset)
        starts = stack.timing.row_starts(len(stack.frames), stack.frames.shape[int(stack.timing.scan_axis)])
        first, last = float(starts.min()), float(starts.max()) + stack.timing.exposure_time
        if placed.start > first + 1e-9 or placed.end < last - 1e-9:  # s; rounding of the offset
            raise ValueError(
                f"{motion}: covers {recorded.start:.6g} to {recorded.end:.6g} s, the frames need "
                f"{offset + first:.6g} to {offset + last:.6g} s"
            )
    check = None
    if isinstance(recorded, FreeMotion):  # rates were compared by the alignment
        check = _check_motion(motion, stack.frames, stack.timing, placed, force, required=offset is None)
    if check is not None:
        results["Motion of the frames"] = [check.summary()]
        data["check"] = _without_curve(check)
    result = restore_and_save(restored, stack, placed, options, force)
    results["Restoration"] = restoration_lines(result, len(stack.frames))
    data["restoration"] = restoration_data(result)
    return Answer(results, data, [restored])


def _with_row_time(timing: SensorTiming, row_time: float) -> SensorTiming:
    """The timing with another row time, and the same exposure and frame period in seconds."""
    rows = timing.row_time / row_time
    return replace(
        timing, row_time=row_time, exposure_rows=rows * timing.exposure_rows, frame_rows=rows * timing.frame_rows
    )


def _refuse(path: Path, reasons: tuple[str, ...], force: bool) -> None:
    """Raise an error with the reasons against a recording, or print them as warnings with ``--force``."""
    if reasons and not force:
        raise ValueError(f"{path}: {'; '.join(reasons)}; --force restores with it nevertheless")
    for reason in reasons:
        error_line(reason, "warning")


def _check_motion(
    path: Path, frames: Tensor, timing: SensorTiming, motion: FreeMotion, force: bool, *, required: bool
) -> MotionCheck | None:
    """Compare the offsets of rows before and after correction with a motion, and refuse a motion that enlarges them.

    With ``required``, an error of the comparison is an error of the command, otherwise a warning.
    """
    if len(frames) < 2:
        error_line("cannot determine whether the motion fits: the comparison needs two frames", "warning")
        return None
    try:
        with working("comparing the motion"):
            check = detection.check_motion(frames, timing, motion)
    except ValueError as error:
        if required:
            raise
        error_line(f"cannot determine whether the motion fits: {error}", "warning")
        return None
    if check.helps:
        for reason in check.reasons:
            error_line(reason, "warning")
    else:
        _refuse(path, check.reasons, force)
    return check


def calibrate(
    frames: StacksArgument,
    *,
    frequency: Annotated[
        float | None,
        typer.Option(help="Flicker frequency in Hz; a mains-powered light flickers at twice the mains frequency."),
    ] = None,
    exposure: Annotated[
        list[float] | None,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help="Exposure time, e.g. 1/1000, given once per frame, for a strobe of unknown frequency; with "
            "--by-motion once, if known.",
        ),
    ] = None,
    by_motion: Annotated[
        bool,
        typer.Option("--by-motion", help="Use the motion of the camera instead of a light; needs --frame-rate."),
    ] = False,
    row_time: Annotated[
        list[float] | None,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help="With --by-motion: given twice, the shortest and the longest possible row time, e.g. 10us.",
            show_default="a readout within a tenth to the whole of the frame period",
        ),
    ] = None,
    readout_direction: Annotated[
        Literal["forward", "reverse"] | None,
        typer.Option(help=f"With --by-motion, if known. {READOUT_HELP}", show_default="determined from the frames"),
    ] = None,
    frame_rate: FrameRateOption = None,
    on_fraction: Annotated[
        float | None,
        typer.Option(help="Duty cycle of a light that is switched on and off; determines the exposure time."),
    ] = None,
    light_contrast: Annotated[
        float | None,
        typer.Option(help="Amplitude over mean of a sinusoidal light; determines the exposure time."),
    ] = None,
    scan_axis: Annotated[
        Literal["y", "x"], typer.Option(help="Image axis along which the rows follow each other.")
    ] = "y",
    gamma: Annotated[float, typer.Option(help="Exponent that makes pixel values proportional to light.")] = 1.0,
    full_scale: Annotated[float | None, typer.Option(help="Count that corresponds to full scale.")] = None,
    out: Annotated[Path | None, typer.Option(help="Configuration file to write, with the table [sensor].")] = None,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Measure row time, readout direction and exposure of a camera from a flickering light or from its motion.

    With --by-motion, a row time that is not certain is refused with the reason.
    """
    import torch  # noqa: PLC0415

    limits = row_time or []
    if by_motion:
        _check_by_motion(frequency, exposure, limits, frame_rate, on_fraction, light_contrast)
    else:
        _check_by_light(frequency, exposure, limits, readout_direction)
    if out is not None:
        check_new([out], overwrite, [file for path in frames for file in io.stack_files(path)])
        check_writable(out)
    infos = [io.read_stack_info(path) for path in frames]
    for path, info in zip(frames, infos, strict=True):
        for sentence in io.describe_stack(info, None):
            note(sentence)
        if info.shape[1:] != infos[0].shape[1:]:
            raise ValueError(
                f"{path}: frames of shape {info.shape[1:]}, expected {infos[0].shape[1:]} as in {frames[0]}"
            )
    with working("reading the frames"):
        stack = torch.cat([io.read_stack(path, full_scale=full_scale) for path in frames])
    axis: Literal[-2, -1] = -1 if scan_axis == "x" else -2
    with working("measuring the motion" if by_motion else "measuring the flicker"):
        if by_motion:
            result = detection.calibrate_row_time_by_motion(
                stack,
                frame_rate=frame_rate or 0.0,
                row_time=(limits[0], limits[1]) if limits else None,
                exposure_time=exposure[0] if exposure else None,
                scan_axis=axis,
                readout_direction=readout_direction,
            )
        elif frequency is None:
            result = calibration.calibrate_row_time_by_exposure(stack, exposure or [], scan_axis=axis, gamma=gamma)
        else:
            result = calibration.calibrate_row_time(
                stack,
                frequency,
                frame_rate=frame_rate,
                on_fraction=on_fraction,
                light_contrast=light_contrast,
                scan_axis=axis,
                gamma=gamma,
            )
    if result.row_time is None or result.row_time_std is None or not result.reliable:
        raise ValueError(f"the row time is not certain: {'; '.join(result.reasons)}")
    table = _calibrated_toml(result, scan_axis)
    rows = stack.shape[axis]
    readout = measured_text(1e3 * result.row_time * rows, 1e3 * result.row_time_std * rows)
    steps = ["enter the values that are left open"] * (" = \n" in table)
    if out is None:
        steps = ["write these values into a configuration file with --out, or copy them", *steps]
    else:
        with whole_file(out) as file:
            file.write_text(table, encoding="utf-8")
        steps.append(f"detect a vibration:\n  {command_text('detect', 'FRAMES', '--config', out, '--out', 'FOLDER')}")
    return Answer(
        {"Camera": [result.summary(), f"{rows} rows are read in {readout} ms"], "Configuration": [table]},
        {"calibration": _without_curve(result)},
        [] if out is None else [out],
        steps,
    )


def _check_by_motion(
    frequency: float | None,
    exposure: list[float] | None,
    row_time: list[float],
    frame_rate: float | None,
    on_fraction: float | None,
    light_contrast: float | None,
) -> None:
    """Raise an error for options of ``calibrate`` that do not fit ``--by-motion``."""
    of_light = {"--frequency": frequency, "--on-fraction": on_fraction, "--light-contrast": light_contrast}
    for name, value in of_light.items():
        if value is not None:
            raise ValueError(f"{name} describes a flickering light; leave it out with --by-motion")
    if frame_rate is None:
        raise ValueError("--by-motion needs --frame-rate of the sensor: the row time is found relative to it")
    if exposure and len(exposure) > 1:
        raise ValueError("--by-motion takes one --exposure, that of all frames")
    if row_time and len(row_time) != 2:
        raise ValueError("give --row-time twice: the shortest and the longest possible row time")


def _check_by_light(
    frequency: float | None, exposure: list[float] | None, row_time: list[float], readout_direction: str | None
) -> None:
    """Raise an error for options of ``calibrate`` that do not fit a flickering light."""
    if row_time or readout_direction is not None:
        raise ValueError("--row-time and --readout-direction of calibrate are limits for --by-motion")
    if (frequency is None) == (not exposure):
        raise ValueError(
            "give --frequency of the flicker, --exposure once per frame for a strobe of unknown frequency, or "
            "--by-motion and --frame-rate for frames of a vibrating camera"
        )


def _calibrated_toml(result: RowTimeCalibration, scan_axis: str) -> str:
    """The table ``[sensor]`` of a configuration file; unknown values are comments to be filled in."""
    period: dict[str, object] = {"frame_rate": None} if result.frame_rows is None else {"frame_rows": result.frame_rows}
    values = {
        "row_time": result.row_time,
        "exposure_time": result.exposure_time,
        **period,
        "scan_axis": scan_axis,
        "readout_direction": result.readout_direction,
    }
    return sensor_toml(values, ["Written by rsvib calibrate.", *result.notes])
