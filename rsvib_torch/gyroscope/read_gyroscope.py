"""Angular rates from files of gyroscopes: gyroflow, GoPro, CSV.

Format of gyroflow: https://docs.gyroflow.xyz/app/technical-details/gcsv-format. A header of lines ``key,value`` ends
with the names of the columns, ``t,gx,gy,gz,...``; rates are numbers times ``gscale`` in rad/s.
"""

import csv
import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_choice, check_number
from rsvib_torch.files.number_table import rows_of_numbers, text_lines
from rsvib_torch.files.reading import check_regular
from rsvib_torch.gyroscope.gpmf_track import is_mp4, read_gpmf
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates, angular_rates
from rsvib_torch.motion.recorded import SECONDS, check_times
from rsvib_torch.options import TimeUnit
from rsvib_torch.text import one_line, quoted

RateUnit = Literal["rad/s", "deg/s"]
_RADIANS = {"rad/s": 1.0, "deg/s": math.pi / 180}
_TIME_NAME = re.compile(r"(?:t|time|timestamp)(?:[ _]?[(\[]?(?P<unit>s|ms|us|ns)[)\]]?)?")
_RATE_NAME = re.compile(
    r"(?:gyro(?:scope)?[ _]?|angular_velocity[ _]?|rate[ _]?|omega[ _]?|[grw])?(?P<axis>[xyz])"
    r"(?:[ _]?[(\[]?(?P<unit>rad/s|rad_s|rads|deg/s|deg_s|dps)[)\]]?)?"
)


def _read_table(path: Path, unit: str | None, time_unit: str | None) -> AngularRates:
    """Angular rates of a CSV file, see ``read_gyroscope``."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = text_lines(path, file)
        names = [name.strip().lower() for name in next(csv.reader(lines), [])]
        columns, time_unit, unit = _columns(path, names, time_unit, unit)
        table = rows_of_numbers(path, lines, names, columns, 2)
    return angular_rates(path, table[:, 0] * SECONDS[time_unit], table[:, 1:] * _RADIANS[unit], f"{path.name}, CSV")


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
                of_rate = "rad/s" if match["unit"].startswith("rad") else "deg/s"
                units[kind].add(match["unit"] if kind == "time" else of_rate)
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


def _is_gcsv(head: bytes) -> bool:
    """Whether a file begins as a gyroflow log."""
    return head.removeprefix(b"\xef\xbb\xbf").startswith(_MARKS)


def _read_gcsv(path: Path) -> AngularRates:
    """Angular rates of a gyroflow log."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = text_lines(path, file)
        header, names, count = _header(path, lines)
        columns = next((list(rates) for rates in _RATES if set(rates) <= set(names)), None)
        if columns is None:
            shown = one_line(",".join(names), 100)
            raise ValueError(f"{path}: columns t, gx, gy and gz expected, the log has {shown}")
        wanted = ["t", *columns]
        table = rows_of_numbers(path, lines, names, [names.index(name) for name in wanted], count + 1)
    orientation = header.get("orientation", "XYZ")
    times, rates = table[:, 0] * _scale(path, header, "tscale"), table[:, 1:] * _scale(path, header, "gscale")
    source = f"{path.name}, gyroflow log, orientation {orientation}"
    return angular_rates(path, times, rates, source, orientation)


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


@dataclass(frozen=True)
class _GyroscopeFormat:
    """A format of gyroscope files, whose ``read`` refuses damaged files with a one-line ``ValueError``."""

    name: str  # in messages
    matches: Callable[[bytes], bool]  # whether the first 64 bytes of a file are those of this format
    read: Callable[[Path, RateUnit | None, TimeUnit | None], AngularRates]  # times in s and rates in rad/s
    has_units: bool = True  # whether the format states its units


# A new format is one module and one line. The first that matches is used: CSV has no mark and comes last.
_FORMATS = (
    _GyroscopeFormat("gyroflow log (.gcsv)", _is_gcsv, lambda path, *_: _read_gcsv(path)),
    _GyroscopeFormat("GoPro video with a GPMF track (.mp4)", is_mp4, lambda path, *_: read_gpmf(path)),
    _GyroscopeFormat("CSV file", lambda _: True, _read_table, has_units=False),
)


@checks_arguments
def read_gyroscope(
    path: str | os.PathLike[str], *, unit: RateUnit | None = None, time_unit: TimeUnit | None = None
) -> AngularRates:
    """Read the angular rates of a gyroscope; the format is recognised by the content of the file.

    * gyroflow ``.gcsv``: rates times ``gscale`` in rad/s about the axes of the line ``orientation`` (``YxZ``: the rates
      about y, minus x and z of the sensor; a small letter is a negative axis), times times ``tscale`` in s.
    * GoPro ``.mp4`` with a track of GPMF data (``gpmd``): the entries ``GYRO`` divided by ``SCAL``, about the axes of
      ``ORIN`` if there is one, otherwise in the order of the file. Times are those of the video: of the stamps of the
      camera, or of the ends of the packets with samples at equal distances.
    * CSV: a first line with the names of the columns: a time (``t``, ``time``, ``timestamp``) and three rates (``x``,
      ``gx``, ``gyro_x``, ``wx`` ...). The unit of the rates must be part of the names (``gx_rad_s``, ``x (deg/s)``) or
      be given; that of the time is s unless it is part of the name (``time_ms``) or given.

    ``align_motion`` determines which axis of the gyroscope is which axis of the camera.

    Args:
        path: The file.
        unit: Unit of the rates of a CSV file whose names do not state it.
        time_unit: Unit of its times.

    Returns:
        Times and rates on the clock of the gyroscope.

    Raises:
        ValueError: If it is damaged, has no angular rates or no unit, or its times do not increase.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import rsvib_torch as rsv
        >>> path = Path(tempfile.mkdtemp()) / "clip.csv"
        >>> rows = [f"{2.5 * i},{0.1 * i},0,{-0.2 * i}" for i in range(5)]
        >>> _ = path.write_text(chr(10).join(["time_ms,gx,gy,gz", *rows]))
        >>> rates = rsv.read_gyroscope(path, unit="deg/s")
        >>> round(rates.sample_rate), rates.rates[4].rad2deg().tolist()
        (400, [0.4, 0.0, -0.8])
    """
    path = Path(path)
    check_regular(path)
    if unit is not None:
        check_choice("unit", unit, get_args(RateUnit))
    if time_unit is not None:
        check_choice("time_unit", time_unit, get_args(TimeUnit))
    with path.open("rb") as file:
        head = file.read(64)
    found = next(one for one in _FORMATS if one.matches(head))
    if found.has_units and (unit is not None or time_unit is not None):
        raise ValueError(f"{path}: a {found.name} states its units; omit unit and time_unit")
    try:
        rates = found.read(path, unit, time_unit)
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: not a {found.name}: {error}") from error
    check_times(path, rates.times.numpy(), time_unit or "s", longest_gap=float("inf"))
    return rates
