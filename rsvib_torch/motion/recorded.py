"""Recorded motion from files: angles, rates or pixels over time, as gyroscopes and attitude sensors log them."""

import csv
import math
import os
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from rsvib_torch.core.checks import check_choice, check_number
from rsvib_torch.motion.spline import FreeMotion

__all__ = ["MotionUnit", "TimeUnit", "read_motion"]

MotionUnit = Literal["px", "rad", "mrad", "urad", "deg", "arcsec", "rad/s", "deg/s"]
TimeUnit = Literal["s", "ms", "us", "ns"]

_RADIANS = {
    "rad": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "deg": math.pi / 180,
    "arcsec": math.pi / 180 / 3600,
    "rad/s": 1.0,
    "deg/s": math.pi / 180,
}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_GAP = 4.0  # median steps
_LARGEST_ANGLE = math.pi  # rad, within one record
_FINEST_STEP, _COARSEST_STEP = 1e-6, 0.5  # s between samples
_LEAST_SAMPLES = 4
_COLUMNS = ("time", "x", "y")

Array = NDArray[np.float64]


def read_motion(
    path: str | os.PathLike[str],
    *,
    unit: MotionUnit,
    focal_length: float | None = None,
    time_unit: TimeUnit = "s",
    signs: tuple[float, float] = (1.0, 1.0),
) -> FreeMotion:
    """Read a recorded motion from a CSV file with the columns ``time``, ``x`` and ``y`` (others are passed over).

    Angles move the image by ``focal_length tan(angle)``, rates are summed up to angles first (trapezoids). ``x`` is
    what moves the image along x: for a camera, the angle about its y axis.

    Args:
        path: The CSV file, its first line names the columns.
        unit: Of x and y.
        focal_length: In px, for angles and rates; not for px.
        time_unit: Of the times, on whatever clock.
        signs: 1 or -1 for each axis (x, y), where a positive angle moves the image back.

    Returns:
        The motion on the clock of the file, less its mean; its times as they are in the file, in seconds.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If a column is missing, a value is no number, times are not increasing or have gaps, or values or
            steps are of a size that tells of another unit: one line with the line of the file.
    """
    path = Path(path)
    check_choice("unit", unit, get_args(MotionUnit))
    check_choice("time_unit", time_unit, get_args(TimeUnit))
    if unit == "px" and focal_length is not None:
        raise ValueError("focal_length goes with angles and rates; a motion in px needs none")
    if unit != "px":
        if focal_length is None:
            raise ValueError(f"unit={unit!r} needs a focal_length in px")
        check_number("focal_length", focal_length, above=0.0)
    if any(abs(check_number("signs", sign)) != 1 for sign in signs):
        raise ValueError(f"signs must be 1 or -1 for x and y, got {signs}")
    times, values = _table(path)
    times = times * _SECONDS[time_unit]
    _check_times(path, times, time_unit)
    displacement = values if focal_length is None else _displacement(path, times, values, unit, focal_length)
    displacement = (displacement - displacement.mean(0)) * np.asarray(signs)
    spacing = float(np.median(np.diff(times)))
    return FreeMotion.from_samples(torch.from_numpy(times), torch.from_numpy(displacement), spacing=spacing)


def _table(path: Path) -> tuple[Array, Array]:
    """Times (N,) and values (N, 2) of a file."""
    rows: list[list[float]] = []
    with path.open(newline="", encoding="utf-8-sig") as file:
        try:
            reader = csv.DictReader(file, skipinitialspace=True)
            names = [name.strip().lower() for name in reader.fieldnames or []]
            missing = [name for name in _COLUMNS if name not in names]
            if missing:
                has = ", ".join(names) or "nothing"
                raise ValueError(f"{path}: column {missing[0]!r} is missing; the first line has {has}")
            reader.fieldnames = names
            rows.extend([_number(path, reader.line_num, name, row[name]) for name in _COLUMNS] for row in reader)
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{path}: not a CSV file: {error}") from error
    if len(rows) < _LEAST_SAMPLES:
        raise ValueError(f"{path}: {len(rows)} samples; at least {_LEAST_SAMPLES} are needed")
    table = np.asarray(rows)
    return table[:, 0], table[:, 1:]


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{path}, line {line}: {name} must be a number, got {text!r}")
    return value


def _check_times(path: Path, times: Array, unit: str) -> None:
    """Refuse times that run back, have gaps, or are of another unit."""
    steps = np.diff(times)
    if (steps <= 0).any():
        place = int(np.argmax(steps <= 0))
        raise ValueError(
            f"{path}: times must increase, but sample {place + 2} at {times[place + 1]:.9g} s comes after "
            f"{times[place]:.9g} s"
        )
    typical = float(np.median(steps))
    if not _FINEST_STEP <= typical <= _COARSEST_STEP:
        raise ValueError(f"{path}: samples are {typical:.3g} s apart; are the times really in {unit}?")
    if steps.max() > _GAP * typical:
        place = int(np.argmax(steps))
        raise ValueError(
            f"{path}: gap of {steps[place]:.4g} s after {times[place]:.9g} s, samples are {typical:.4g} s apart"
        )


def _displacement(path: Path, times: Array, values: Array, unit: str, focal_length: float) -> Array:
    """Displacement (N, 2) in px of angles or rates."""
    angles = values * _RADIANS[unit]
    if unit.endswith("/s"):
        mean = 0.5 * (angles[1:] + angles[:-1]) * np.diff(times)[:, None]
        angles = np.concatenate([np.zeros((1, 2)), np.cumsum(mean, axis=0)])
    angles = angles - angles.mean(0)
    if np.abs(angles).max() > 0.5 * _LARGEST_ANGLE:
        largest = np.degrees(np.abs(angles).max())
        raise ValueError(
            f"{path}: angles reach {largest:.4g} degrees from their mean; are the values really in {unit}?"
        )
    return np.asarray(focal_length * np.tan(angles))
