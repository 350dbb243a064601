"""Measured readout times of camera models, from the lens profiles of Gyroflow (CC0 1.0)."""

import csv
import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib.resources import files

from pydantic import TypeAdapter

from rsvib_torch.checks.values import check_number, check_whole_number, described, options
from rsvib_torch.text import measured_text, number_of, quoted

# of the rate; 24 and 25 per second, which differ by 4 %, are different modes: of 151 pairs of modes of one size with
# different rates, 99 have the same readout within 10 %
_SAME_RATE = 0.03
_SAME_SIZE = 0.01  # of width and height; 2160 and 2176 rows of 3840 px are one mode


@options
class CameraMode:
    """Readout time of a camera model in one mode, measured by users (https://github.com/gyroflow/lens_profiles).

    About 3 in 4 are within 3 % of others of the same mode, 4 in 5 within 10 %: confirm a time of a single calibration
    with ``calibrate_row_time`` or ``calibrate_row_time_by_motion``.

    Attributes:
        brand: Manufacturer.
        model: Name of the model.
        lens: Field of view, if modes of one size differ in it; otherwise empty.
        width: Columns of a frame.
        height: Rows of a frame.
        frame_rate: Frames per second, 24 for 23.976.
        readout_time: Time in s in which the rows of a frame are read: the median over calibrations.
        readout_time_std: Its standard deviation in s: that of the calibrations from their median absolute deviation,
            and at least 3 %.
        calibrations: Number of calibrations.
        readout_direction: ``"forward"`` if a calibration states it, otherwise empty.
    """

    brand: str
    model: str
    lens: str
    width: int
    height: int
    frame_rate: float
    readout_time: float
    readout_time_std: float
    calibrations: int
    readout_direction: str

    @property
    def name(self) -> str:
        """Brand, model and field of view."""
        return " ".join(filter(None, (self.brand, self.model, self.lens)))

    @property
    def row_time(self) -> float:
        """Readout time / height in s."""
        return self.readout_time / self.height

    @property
    def row_time_std(self) -> float:
        """Standard deviation of ``row_time`` in s."""
        return self.readout_time_std / self.height

    @property
    def size(self) -> str:
        """Width, height and frame rate, for messages."""
        return f"{self.width} x {self.height} px at {self.frame_rate:.4g}/s"

    def __str__(self) -> str:
        readout = measured_text(1e3 * self.readout_time, 1e3 * self.readout_time_std)
        return f"{self.name}, {self.size}: readout {readout} ms, {number_of(self.calibrations, 'calibration')}"


@cache
def _modes() -> tuple[CameraMode, ...]:
    """All modes of the table, in the order of brand, model, and size."""
    text = (files("rsvib_torch") / "motion" / "readout_times.csv").read_text(encoding="utf-8")
    lines = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    mode = TypeAdapter(CameraMode)
    return tuple(mode.validate_strings(line) for line in lines)


def _letters(text: str) -> str:
    """A name without case, spaces and signs, which are written in many ways."""
    return re.sub(r"[\W_]", "", text.casefold())


def find_cameras(search: str = "") -> tuple[CameraMode, ...]:
    """Modes of the camera models whose names contain every word of a text, sorted by name and size.

    Args:
        search: Words of brand, model or field of view; case and signs such as hyphens are ignored. Empty for all modes.

    Raises:
        ValueError: If there is no such model; the text names similar ones.

    Example:
        >>> import rsvib_torch as rsv
        >>> for mode in rsv.find_cameras("fuji x-t4"):
        ...     print(mode)
        Fujifilm X-T4, 3840 x 2160 px at 24/s: readout 18.20 ± 0.55 ms, 1 calibration
        Fujifilm X-T4, 4096 x 2160 px at 25/s: readout 8.00 ± 0.24 ms, 1 calibration
    """
    if not isinstance(search, str):
        raise TypeError(f"search must be a text, got {described(search)}")
    words = [_letters(word) for word in search.split()]
    modes = tuple(mode for mode in _modes() if all(word in _letters(mode.name) for word in words))
    if not modes:
        raise _unknown(search, ())
    return modes


def _unknown(name: str, modes: Sequence[CameraMode]) -> ValueError:
    """The error of a name that no model has, with the models of some modes or else of similar names."""
    names = {_letters(key): f"{mode.brand} {mode.model}" for mode in _modes() for key in (mode.model, mode.name)}
    similar_names = [names[key] for key in difflib.get_close_matches(_letters(name), names, n=4)]
    similar = [*dict.fromkeys([f"{mode.brand} {mode.model}" for mode in modes] or similar_names)]
    listed = ", ".join(similar[:4]) or "none"
    more = f" and {len(similar) - 4} more" if len(similar) > 4 else ""
    table = "table of readout times (rsvib cameras lists all)"
    return ValueError(f"no camera {quoted(name)} in the {table}; similar: {listed}{more}")


def camera_mode(name: str, *, width: int, height: int, frame_rate: float) -> CameraMode:
    """The mode of a camera model that fits the frames, with their size and rate.

    It is the measured mode of the same size (within 1 %) and rate (within 3 %).

    Args:
        name: Complete name of the model, with or without brand and field of view.
        width: Columns of the frames.
        height: Rows of the frames.
        frame_rate: Frames per second.

    Raises:
        ValueError: If no model has this name, no mode fits, or several do; the text lists similar models, or the modes.

    Example:
        >>> import rsvib_torch as rsv
        >>> print(rsv.camera_mode("HERO6 Black", width=3840, height=2160, frame_rate=29.97))
        GoPro HERO6 Black, 3840 x 2160 px at 29.97/s: readout 8.34 ± 0.25 ms, 1 calibration
    """
    size = check_whole_number("width", width, at_least=1), check_whole_number("height", height, at_least=1)
    rate = check_number("frame_rate", frame_rate, above=0.0)
    candidates = find_cameras(name)
    modes = [
        mode
        for mode in candidates
        if _letters(name) in {_letters(b + mode.model + v) for b in ("", mode.brand) for v in ("", mode.lens)}
    ]
    if not modes:  # of "iPhone 7", "iPhone 7 Plus" is another camera
        raise _unknown(name, candidates)
    sized = [mode for mode in modes if max(abs(mode.width / size[0] - 1), abs(mode.height / size[1] - 1)) <= _SAME_SIZE]
    fitting = [mode for mode in sized if math.isclose(mode.frame_rate, rate, rel_tol=_SAME_RATE)]
    if not fitting:
        listed = ", ".join(
            f"{' '.join(filter(None, (mode.size, mode.lens)))} (readout {1e3 * mode.readout_time:.3g} ms)"
            for mode in sorted(modes, key=lambda mode: mode not in sized)
        )
        remedy = "try the readout time of a known rate, which is right for two of three cameras, or " if sized else ""
        raise ValueError(
            f"no mode of {modes[0].brand} {modes[0].model} has the size and rate of {width} x {height} px at "
            f"{rate:.4g}/s: {listed}; {remedy}measure the row time (rsvib calibrate). Scaled frames take the readout "
            "time of their mode: row_time is this time / their rows"
        )
    names = dict.fromkeys(mode.name for mode in fitting)
    if len(names) > 1:
        raise ValueError(f"several modes fit, give the complete name: {', '.join(names)}")
    mode = min(fitting, key=lambda mode: abs(mode.frame_rate - rate))
    return replace(mode, width=width, height=height, frame_rate=rate)
