"""Angular rates from text: CSV files, and logs of gyroflow (.gcsv).

Format of gyroflow: https://docs.gyroflow.xyz/app/technical-details/gcsv-format. A header of lines ``key,value`` ends
with the names of the columns, ``t,gx,gy,gz,...``; rates are numbers times ``gscale`` in rad/s.
"""

import csv
import math
import re
from collections.abc import Iterator
from pathlib import Path

import torch

from rsvib_torch.checks.values import check_number
from rsvib_torch.files.number_table import rows_of_numbers, text_lines
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates, orientation_matrix
from rsvib_torch.motion.recorded import SECONDS
from rsvib_torch.numerics.tables import Array
from rsvib_torch.text import one_line, quoted

RADIANS = {"rad/s": 1.0, "deg/s": math.pi / 180}
_UNIT = {"rad/s": "rad/s", "rad_s": "rad/s", "rads": "rad/s", "deg/s": "deg/s", "deg_s": "deg/s", "dps": "deg/s"}
_TIME_NAME = re.compile(r"(?:t|time|timestamp)(?:[ _]?[(\[]?(?P<unit>s|ms|us|ns)[)\]]?)?")
_RATE_NAME = re.compile(
    r"(?:gyro(?:scope)?[ _]?|angular_velocity[ _]?|rate[ _]?|omega[ _]?|[grw])?(?P<axis>[xyz])"
    r"(?:[ _]?[(\[]?(?P<unit>rad/s|rad_s|rads|deg/s|deg_s|dps)[)\]]?)?"
)


def angular_rates(path: Path, times: Array, rates: Array, source: str) -> AngularRates:
    """The result of a reader; errors of its values name the file."""
    try:
        return AngularRates(torch.from_numpy(times.copy()), torch.from_numpy(rates.copy()), source)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_rates_table(path: Path, unit: str | None, time_unit: str | None) -> AngularRates:
    """Angular rates of a CSV file, see ``read_gyroscope``."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        try:
            lines = text_lines(path, file)
            names = [name.strip().lower() for name in next(csv.reader(lines), [])]
            columns, time_unit, unit = _columns(path, names, time_unit, unit)
            table = rows_of_numbers(path, lines, names, columns, 2)
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{path}: not a CSV file: {error}") from error
    return angular_rates(path, table[:, 0] * SECONDS[time_unit], table[:, 1:] * RADIANS[unit], f"{path.name}, CSV")


def _columns(path: Path, names: list[str], time_unit: str | None, unit: str | None) -> tuple[list[int], str, str]:
    """Columns of the time and of the rates about x, y and z, and their units."""
    found: dict[str, int] = {}
    units: dict[str, set[str]] = {"time": set(), "rate": set()}
    for column, name in enumerate(names):
        for kind, match in (("time", _TIME_NAME.fullmatch(name)), ("rate", _RATE_NAME.fullmatch(name))):
            if match is None:
                continue
            quantity = "time" if kind == "time" else match["axis"]
            if quantity in found:
                raise ValueError(
                    f"{path}: columns {quoted(names[found[quantity]])} and {quoted(name)} "
                    f"could both be {quantity}; rename one of them"
                )
            found[quantity] = column
            if match["unit"]:
                units[kind].add(match["unit"] if kind == "time" else _UNIT[match["unit"]])
    missing = [quantity for quantity in ("time", "x", "y", "z") if quantity not in found]
    if missing:
        what = "time" if missing[0] == "time" else f"rate about {missing[0]}"
        present = one_line(", ".join(names) or "nothing", 200)
        raise ValueError(
            f"{path}: no column of the {what}; expected names such as time, gx, gy, gz in the first line, which has "
            f"{present}"
        )
    for name, given, stated in (("time_unit", time_unit, units["time"]), ("unit", unit, units["rate"])):
        if len(stated | ({given} - {None})) > 1:
            kinds = ", ".join(sorted(stated))
            raise ValueError(f"{path}: the first line states {kinds}" + (f", {name} is {given!r}" if given else ""))
    rate_unit = unit or next(iter(units["rate"]), None)
    if rate_unit is None:
        raise ValueError(f"{path}: the unit of the rates is not stated; pass unit='rad/s' or unit='deg/s'")
    order = [found[quantity] for quantity in ("time", "x", "y", "z")]
    return order, time_unit or next(iter(units["time"]), "s"), rate_unit


_MARKS = (b"GYROFLOW IMU LOG", b"CAMERA IMU LOG")
_MAX_HEADER = 1000  # lines
_RATES = (("gx", "gy", "gz"), ("rx", "ry", "rz"))  # of version 1.1 and later, and of earlier ones


def is_gcsv(head: bytes) -> bool:
    """Whether a file begins as a gyroflow log."""
    return head.removeprefix(b"\xef\xbb\xbf").startswith(_MARKS)


def check_orientation(text: str) -> str:
    """Return a name of three axes such as "YxZ" if every axis occurs once."""
    if sorted(text.lower()) != ["x", "y", "z"]:
        raise ValueError(
            f"orientation must have x, y and z once each, a small letter for a negative axis, got {quoted(text)}"
        )
    return text


def read_gcsv(path: Path) -> AngularRates:
    """Angular rates of a gyroflow log."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        try:
            lines = text_lines(path, file)
            header, names, count = _header(path, lines)
            columns = next((list(rates) for rates in _RATES if set(rates) <= set(names)), None)
            if columns is None:
                shown = one_line(",".join(names), 100)
                raise ValueError(f"{path}: columns t, gx, gy and gz expected, the log has {shown}")
            wanted = ["t", *columns]
            table = rows_of_numbers(path, lines, names, [names.index(name) for name in wanted], count + 1)
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{path}: not a gyroflow log: {error}") from error
    orientation = header.get("orientation", "XYZ")
    try:
        check_orientation(orientation)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    scales = [_scale(path, header, name) for name in ("tscale", "gscale")]
    source = f"{path.name}, gyroflow log, orientation {orientation}"
    rates = table[:, 1:] @ orientation_matrix(orientation).numpy().T * scales[1]
    return angular_rates(path, table[:, 0] * scales[0], rates, source)


def _header(path: Path, lines: Iterator[str]) -> tuple[dict[str, str], list[str], int]:
    """Entries of the header, the names of the columns, and the number of lines up to them."""
    header: dict[str, str] = {}
    for count, line in enumerate(lines, 1):
        cells = [cell.strip() for cell in line.rstrip("\r\n").split(",")]
        if cells[0] == "t" and len(cells) > 1:
            return header, cells, count
        if count > _MAX_HEADER:
            break
        if len(cells) > 1:
            header[cells[0]] = cells[1]
    raise ValueError(f"{path}: a gyroflow log without a line of column names, t,gx,gy,gz")


def _scale(path: Path, header: dict[str, str], name: str) -> float:
    try:
        return check_number(name, float(header[name]), above=0.0, at_most=1e6)
    except KeyError:
        raise ValueError(f"{path}: the header has no {name}") from None
    except ValueError:
        raise ValueError(f"{path}: {name} must be a positive number, got {quoted(header[name])}") from None
