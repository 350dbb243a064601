"""Angular rates from logs of gyroflow (.gcsv).

Format: https://docs.gyroflow.xyz/app/technical-details/gcsv-format. A header of lines ``key,value`` ends with the names
of the columns, ``t,gx,gy,gz,...``; rates are numbers times ``gscale`` in rad/s.
"""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.checks import check_number
from rsvib_torch.core.number_table import rows_of_numbers, text_lines
from rsvib_torch.core.text import one_line, quoted
from rsvib_torch.io.gyroscope.rates_table import angular_rates
from rsvib_torch.motion.gyroscope_rates import AngularRates

_MARKS = (b"GYROFLOW IMU LOG", b"CAMERA IMU LOG")
_MAX_HEADER = 1000  # lines
_RATES = (("gx", "gy", "gz"), ("rx", "ry", "rz"))  # of version 1.1 and later, and of earlier ones


def is_gcsv(head: bytes) -> bool:
    """Whether a file begins as a gyroflow log."""
    return head.removeprefix(b"\xef\xbb\xbf").startswith(_MARKS)


def check_orientation(text: str) -> str:
    """Return a name of three axes such as "YxZ" if every axis occurs once.

    Example:
        >>> check_orientation("YxY")
        Traceback (most recent call last):
        ...
        ValueError: orientation must have x, y and z once each, a small letter for a negative axis, got 'YxY'
    """
    if sorted(text.lower()) != ["x", "y", "z"]:
        raise ValueError(
            f"orientation must have x, y and z once each, a small letter for a negative axis, got {quoted(text)}"
        )
    return text


def oriented(rates: NDArray[np.float64], orientation: str) -> NDArray[np.float64]:
    """Rates (N, 3) about the axes that an orientation names.

    Example:
        >>> oriented(np.array([[1.0, 2.0, 3.0]]), "YxZ").tolist()
        [[2.0, -1.0, 3.0]]
    """
    columns = ["xyz".index(letter.lower()) for letter in orientation]
    signs = np.array([1.0 if letter.isupper() else -1.0 for letter in orientation])
    return np.asarray(rates[:, columns] * signs)


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
    rates = oriented(table[:, 1:], orientation) * scales[1]
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
