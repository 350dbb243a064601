"""``rsvib calibrate``: what a camera does not say of itself, from frames of flickering light."""

import math
from pathlib import Path
from typing import Annotated, Literal

import torch
import typer
from torch import Tensor

from rsvib_torch.calibration import RowTimeCalibration, calibrate_row_time, calibrate_row_time_by_exposure
from rsvib_torch.commands.terminal import say, working
from rsvib_torch.io import check_writable, read_stack, whole_file

__all__ = ["calibrate", "calibration_lines", "sensor_toml"]


def calibrate(
    frames: Annotated[list[Path], typer.Argument(help="Stack of frames, or several of them: TIFF, PNG, video ...")],
    *,
    frequency: Annotated[
        float | None, typer.Option(help="Flicker frequency in Hz; mains light has twice the mains'.")
    ] = None,
    exposure: Annotated[
        list[float] | None,
        typer.Option(help="Exposure in seconds, once a frame: for a strobe of unknown frequency, instead of it."),
    ] = None,
    frame_rate: Annotated[float | None, typer.Option(help="Frames per second, for consecutive frames.")] = None,
    on_fraction: Annotated[
        float | None, typer.Option(help="Fraction of time that an on-off light is on: tells the exposure.")
    ] = None,
    light_contrast: Annotated[
        float | None, typer.Option(help="Amplitude over mean of a light like a sine: tells the exposure.")
    ] = None,
    scan_axis: Annotated[Literal["y", "x"], typer.Option(help="Axis along which rows follow each other.")] = "y",
    gamma: Annotated[float, typer.Option(help="Power that makes pixels proportional to light.")] = 1.0,
    full_scale: Annotated[float | None, typer.Option(help="Count that means full scale.")] = None,
    out: Annotated[Path | None, typer.Option(help="Config file to write: its [sensor], as far as known.")] = None,
) -> None:
    """Row time, readout direction and exposure of a camera from frames of flickering light."""
    if (frequency is None) == (not exposure):
        raise ValueError(
            "give --frequency of the flicker, or --exposure once a frame for a strobe of unknown frequency"
        )
    if out is not None:
        check_writable(out)
    stack = _read(frames, full_scale)
    axis: Literal[-2, -1] = -1 if scan_axis == "x" else -2
    with working("looking for bands"):
        if frequency is None:
            found = calibrate_row_time_by_exposure(stack, exposure or [], scan_axis=axis, gamma=gamma)
        else:
            found = calibrate_row_time(
                stack,
                frequency,
                frame_rate=frame_rate,
                on_fraction=on_fraction,
                light_contrast=light_contrast,
                scan_axis=axis,
                gamma=gamma,
            )
    for line in calibration_lines(found, stack.shape[axis]):
        say(line)
    if out is not None:
        with whole_file(out) as file:
            file.write_text(sensor_toml(found, scan_axis), encoding="utf-8")
        say(f"{out}: [sensor]")


def _read(paths: list[Path], full_scale: float | None) -> Tensor:
    """All files as one stack."""
    with working("reading the frames"):
        stacks = [read_stack(path, full_scale=full_scale) for path in paths]
    for path, stack in zip(paths, stacks, strict=True):
        if stack.shape[1:] != stacks[0].shape[1:]:
            raise ValueError(
                f"{path}: frames of shape {tuple(stack.shape[1:])} do not fit those of {paths[0]}, "
                f"{tuple(stacks[0].shape[1:])}"
            )
    return torch.cat(stacks)


def _with_error(value: float, std: float, unit: float) -> str:
    digits = min(9, max(0, 1 - math.floor(math.log10(std / unit)))) if std > 0 else 3
    return f"{value / unit:.{digits}f} ± {std / unit:.{digits}f}"


def calibration_lines(found: RowTimeCalibration, num_rows: int) -> list[str]:
    """A calibration in words, one line a fact."""
    row_time, std = found.row_time, found.row_time_std
    readout = _with_error(row_time * num_rows, std * num_rows, 1e-3)
    lines = [
        f"row time {_with_error(row_time, std, 1e-6)} us ({num_rows} rows take {readout} ms)",
        f"flicker {found.flicker_frequency:.6g} Hz",
        f"bands of {found.period_rows:.3f} rows, contrast {found.contrast:.3g}",
    ]
    if found.frame_rows is not None:
        lines.append(f"frame rows {found.frame_rows:.2f}")
    if found.readout_direction is not None:
        lines.append(f"readout direction {found.readout_direction}")
    if found.exposure_time is not None and found.exposure_time_std:
        exposure = _with_error(found.exposure_time, found.exposure_time_std, 1e-6)
        lines.append(f"exposure {exposure} us, {found.exposure_time / row_time:.2f} rows")
    return [*lines, *found.notes]


def sensor_toml(found: RowTimeCalibration, scan_axis: str) -> str:
    """The ``[sensor]`` of a config file; what is not known is a comment to fill in."""
    known = {
        "row_time": f"{found.row_time:.9g}",
        "exposure_rows": None if found.exposure_time is None else f"{found.exposure_time / found.row_time:.6g}",
        "frame_rows": None if found.frame_rows is None else f"{found.frame_rows:.8g}",
        "scan_axis": f'"{scan_axis}"',
        "readout_direction": None if found.readout_direction is None else f'"{found.readout_direction}"',
    }
    lines = ["[sensor]"]
    lines += [f"# {name} = ?  not known yet" if text is None else f"{name} = {text}" for name, text in known.items()]
    return "\n".join([*lines, *(f"# {note}" for note in found.notes)]) + "\n"
