"""Angular rates from files of gyroscopes: gyroflow, GoPro, CSV."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_choice
from rsvib_torch.files.reading import check_regular
from rsvib_torch.gyroscope.gpmf_track import is_mp4, read_gpmf
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates
from rsvib_torch.gyroscope.text_logs import is_gcsv, read_gcsv, read_rates_table
from rsvib_torch.motion.recorded import check_times
from rsvib_torch.options import TimeUnit

RateUnit = Literal["rad/s", "deg/s"]


@dataclass(frozen=True)
class _GyroscopeFormat:
    """A format of gyroscope files, whose ``read`` refuses damaged files with a one-line ``ValueError``."""

    name: str  # in messages
    matches: Callable[[bytes], bool]  # whether the first 64 bytes of a file are those of this format
    read: Callable[[Path, RateUnit | None, TimeUnit | None], AngularRates]  # times in s and rates in rad/s
    has_units: bool = True  # whether the format states its units


# A new format is one module and one line. The first that matches is used: CSV has no mark and comes last.
_FORMATS = (
    _GyroscopeFormat("gyroflow log (.gcsv)", is_gcsv, lambda path, *_: read_gcsv(path)),
    _GyroscopeFormat("GoPro video with a GPMF track (.mp4)", is_mp4, lambda path, *_: read_gpmf(path)),
    _GyroscopeFormat("CSV", lambda _: True, read_rates_table, has_units=False),
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
    rates = found.read(path, unit, time_unit)
    check_times(path, rates.times.numpy(), time_unit or "s", longest_gap=float("inf"))
    return rates
