"""Angular rates from files of gyroscopes: gyroflow, GoPro, CSV.

Format of gyroflow: https://docs.gyroflow.xyz/app/technical-details/gcsv-format. A header of lines ``key,value`` ends
with the names of the columns, ``t,gx,gy,gz,...``; rates are numbers times ``gscale`` in rad/s.
"""

import csv
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_number
from rsvib_torch.files.number_table import rows_of_numbers
from rsvib_torch.files.reading import check_regular
from rsvib_torch.gyroscope.gpmf_track import is_mp4, read_gpmf
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates, orientation_matrix
from rsvib_torch.motion.recorded import check_times
from rsvib_torch.numerics.tables import Array
from rsvib_torch.text import one_line, quoted

_COLUMN_NAME = re.compile(
    r"(?P<time>(?:t|time|timestamp)(?:[ _]?[(\[]?s[)\]]?)?)|"
    r"(?:gyro(?:scope)?[ _]?|angular_velocity[ _]?|rate[ _]?|omega[ _]?|[grw])?(?P<axis>[xyz])"
    r"(?:[ _]?[(\[]?(?P<unit>rad/s|rad_s|rads|deg/s|deg_s|dps)[)\]]?)?"
)
_MARKS = (b"GYROFLOW IMU LOG", b"CAMERA IMU LOG")  # at the begin of a gyroflow log
_MAX_HEADER = 1000  # lines


def _read_table(path: Path, is_log: bool) -> tuple[Array, Array, str, str]:
    """As ``read_gpmf``, of a CSV file with units, or of a gyroflow log, whose header states factors and axes."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        header, count = _header(path, file) if is_log else ({}, 0)
        names = [name.strip().lower() for name in (header["t"] if is_log else next(csv.reader(file), []))]
        columns, units = _columns(path, names)
        table = rows_of_numbers(path, file, names, columns, count + 2)
    times, rates = table[:, 0], table[:, 1:]
    if is_log:
        axes = header.get("orientation", ["", "XYZ"])[1]
        scales = (_scale(path, header, name) for name in ("tscale", "gscale"))
        return times * next(scales), rates * next(scales), f"gyroflow log, orientation {axes}", axes
    if units not in ({"rad"}, {"deg"}):
        raise ValueError(f"{path}: the first line states no unit of the rates, or two; write gx_rad_s or gx_deg_s")
    return times, np.radians(rates) if units == {"deg"} else rates, "CSV", "XYZ"


def _columns(path: Path, names: list[str]) -> tuple[list[int], set[str]]:
    """Columns of the time and of the rates about x, y and z, and the units of the rates: rad, deg or nothing."""
    matches = [(column, match) for column, name in enumerate(names) if (match := _COLUMN_NAME.fullmatch(name))]
    columns, units = list[int](), set[str]()
    for quantity in ("time", "x", "y", "z"):
        of_quantity = [one for one in matches if quantity == ("time" if one[1]["time"] else one[1]["axis"])]
        if len(of_quantity) != 1:
            what = "time" if quantity == "time" else f"rate about {quantity}"
            number = "no column" if not of_quantity else f"{len(of_quantity)} columns"
            present = one_line(", ".join(names) or "nothing", 200)
            motion = " (a motion along x and y goes with --unit)" if {"x", "y"} <= {*names} else ""
            raise ValueError(
                f"{path}: {number} of the {what}; expected one each, with names such as time, gx_rad_s, gy_rad_s, "
                f"gz_rad_s in the line of names, which has {present}{motion}"
            )
        columns.append(of_quantity[0][0])
        if quantity != "time":
            units.add((of_quantity[0][1]["unit"] or "").replace("dps", "deg")[:3])
    return columns, units


def _header(path: Path, lines: Iterator[str]) -> tuple[dict[str, list[str]], int]:
    """Lines of the header of a gyroflow log by their first cell, up to the names of the columns, and their number."""
    header: dict[str, list[str]] = {}
    for count, line in zip(range(_MAX_HEADER), lines, strict=False):
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) > 1:
            header[cells[0]] = cells
        if "t" in header:
            return header, count
    raise ValueError(f"{path}: a gyroflow log without a line of column names, t,gx,gy,gz")


def _scale(path: Path, header: dict[str, list[str]], name: str) -> float:
    text = header.get(name, ["", "nothing"])[1]
    try:
        return check_number(name, float(text), above=0.0, at_most=1e6)
    except ValueError:
        raise ValueError(f"{path}: {name} in the header must be a positive number, got {quoted(text)}") from None


@checks_arguments
def read_gyroscope(path: str | os.PathLike[str]) -> AngularRates:
    """Read the angular rates of a gyroscope; the format is recognised by the content of the file.

    * gyroflow ``.gcsv``: rates times ``gscale`` in rad/s about the axes of the line ``orientation`` (``YxZ``: the rates
      about y, minus x and z of the sensor; a small letter is a negative axis), times times ``tscale`` in s.
    * GoPro ``.mp4`` with a track of GPMF data (``gpmd``): the entries ``GYRO`` divided by ``SCAL``, about the axes of
      ``ORIN`` if there is one, otherwise in the order of the file. Times are those of the video, at equal distances.
    * CSV: a first line with the names of the columns: a time in s (``t``, ``time``, ``timestamp``) and three rates
      (``x``, ``gx``, ``gyro_x``, ``wx`` ...) with their unit (``gx_rad_s``, ``x (deg/s)``). Other files:
      ``AngularRates(times, rates)``.

    ``align_motion`` determines which axis of the gyroscope is which axis of the camera.

    Args:
        path: The file.

    Returns:
        Times and rates on the clock of the gyroscope.

    Raises:
        ValueError: If it is damaged, has no angular rates or no unit, or its times do not increase.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import rsvib_torch as rsv
        >>> path = Path(tempfile.mkdtemp()) / "clip.csv"
        >>> rows = [f"{0.0025 * i},{0.1 * i},0,{-0.2 * i}" for i in range(5)]
        >>> _ = path.write_text(chr(10).join(["time,gx_deg_s,gy_deg_s,gz_deg_s", *rows]))
        >>> rates = rsv.read_gyroscope(path)
        >>> round(rates.sample_rate), rates.rates[4].rad2deg().tolist()
        (400, [0.4, 0.0, -0.8])
    """
    path = Path(path)
    check_regular(path)
    with path.open("rb") as file:
        head = file.read(64)
    is_log = head.removeprefix(b"\xef\xbb\xbf").startswith(_MARKS)
    kind = "GoPro video with a GPMF track (.mp4)" if is_mp4(head) else "gyroflow log (.gcsv)" if is_log else "CSV file"
    try:
        found = read_gpmf(path) if is_mp4(head) else _read_table(path, is_log)
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: not a {kind}: {error}") from error
    times, rates, source, axes = found
    try:
        turned = torch.from_numpy(rates @ orientation_matrix(axes).numpy().T)
        result = AngularRates(torch.from_numpy(times.copy()), turned, f"{path.name}, {source}")
        check_times(times, longest_gap=float("inf"))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return result
