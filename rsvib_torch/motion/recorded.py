"""Recorded motion from CSV files of gyroscopes and attitude sensors: angles, angular rates or pixels over time."""

import csv
import math
import os
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_number
from rsvib_torch.files.number_table import rows_of_numbers
from rsvib_torch.files.reading import check_regular
from rsvib_torch.motion.spline import FreeMotion, check_increasing
from rsvib_torch.options import MotionUnit
from rsvib_torch.text import one_line

_RADIANS = {
    "rad": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "deg": math.pi / 180,
    "arcsec": math.pi / 180 / 3600,
    "rad/s": 1.0,
    "deg/s": math.pi / 180,
}
_COLUMNS = ("time", "x", "y")
_LEAST_SAMPLES = 4  # of a cubic spline

Array = NDArray[np.float64]


@checks_arguments
def read_motion(path: str | os.PathLike[str], *, unit: MotionUnit, focal_length: float | None = None) -> FreeMotion:
    """Read a recorded motion from a CSV file with the columns ``time``, ``x`` and ``y``; other columns are ignored.

    Times are in s, on any clock. Of a file with other times, ``FreeMotion.from_samples`` makes the motion;
    ``motion.with_axes([0, 1], [1, -1])`` is that with another direction of y.

    Angles displace the image by ``focal_length tan(angle)``; rates are integrated to angles first (trapezoidal rule).
    ``x`` is the quantity that displaces the image along x: for a camera, the angle about its y axis.

    Args:
        path: The CSV file; its first line names the columns.
        unit: Unit of x and y.
        focal_length: Focal length in px, required for angles and rates and not accepted for px.

    Returns:
        The motion without its mean, with the times of the file in seconds.

    Raises:
        ValueError: If a column is missing, a value is not a number, times do not increase or have gaps, or values or
            time steps indicate another unit; the message names the line of the file.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import rsvib_torch as rsv
        >>> path = Path(tempfile.mkdtemp()) / "gyroscope.csv"
        >>> rows = [f"{0.001 * i},{0.1 * i},{-0.2 * i}" for i in range(50)]
        >>> _ = path.write_text(chr(10).join(["time,x,y", *rows]))
        >>> rsv.read_motion(path, unit="px").displacement(torch.tensor(0.01)).round(decimals=3).tolist()  # px
        [-1.45, 2.9]
    """
    path = Path(path)
    if unit == "px" and focal_length is not None:
        raise ValueError("focal_length is for angles and rates only; omit it for unit='px'")
    if unit != "px":
        if focal_length is None:
            raise ValueError(f"unit={unit!r} needs a focal_length in px")
        check_number("focal_length", focal_length, above=0.0)
    times, values = _table(path)
    try:
        check_times(times)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    displacement = values if focal_length is None else _displacement(path, times, values, unit, focal_length)
    displacement = displacement - displacement.mean(0)
    spacing = float(np.median(np.diff(times)))
    return FreeMotion.from_samples(torch.from_numpy(times), torch.from_numpy(displacement), spacing=spacing)


def _table(path: Path) -> tuple[Array, Array]:
    """Times (N,) and values (N, 2) of a file."""
    check_regular(path)
    with path.open(newline="", encoding="utf-8-sig") as file:
        try:
            head = next(csv.reader(file, skipinitialspace=True), [])
            names = [name.partition("(")[0].strip().lower() for name in head]  # without units
            missing = [name for name in _COLUMNS if name not in names]
            if missing:
                present = ", ".join(names) or "nothing"
                raise ValueError(f"{path}: column {missing[0]!r} is missing; the first line has {one_line(present)}")
            table = rows_of_numbers(path, file, names, [names.index(name) for name in _COLUMNS], 2)
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{path}: not a CSV file: {error}") from error
    if len(table) < _LEAST_SAMPLES:
        raise ValueError(f"{path}: {len(table)} samples; at least {_LEAST_SAMPLES} are required")
    return table[:, 0], table[:, 1:]


def check_times(times: Array, longest_gap: float = 4.0) -> None:
    """Raise a ValueError for times that do not increase, have gaps (in median steps), or are in another unit."""
    check_increasing(times)
    steps = np.diff(times)
    typical, place = float(np.median(steps)), int(np.argmax(steps))
    if not 1e-6 <= typical <= 0.5:  # s; motion sensors sample at 2 Hz to 1 MHz
        raise ValueError(f"samples are {typical:.3g} s apart; times must be in s")
    if steps[place] > longest_gap * typical:
        raise ValueError(f"gap of {steps[place]:.4g} s after {times[place]:.9g} s, samples are {typical:.4g} s apart")


def _displacement(path: Path, times: Array, values: Array, unit: str, focal_length: float) -> Array:
    """Displacement (N, 2) in px of angles or rates."""
    angles = values * _RADIANS[unit]
    if unit.endswith("/s"):
        mean = 0.5 * (angles[1:] + angles[:-1]) * np.diff(times)[:, None]
        angles = np.concatenate([np.zeros((1, 2)), np.cumsum(mean, axis=0)])
    angles = angles - angles.mean(0)
    largest = np.abs(angles).max()
    if largest > 0.5 * math.pi:  # the tangent is not defined
        raise ValueError(f"{path}: angles reach {np.degrees(largest):.4g} degrees from their mean; check unit={unit!r}")
    return np.asarray(focal_length * np.tan(angles))
