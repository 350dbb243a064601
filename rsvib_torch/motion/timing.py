"""Timing of a rolling-shutter sensor: the exposure start of each row of each frame.

Configuration files are checked with this module before torch is imported, which takes seconds: functions that need
torch import it themselves.
"""

from __future__ import annotations

import itertools
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rsvib_torch.checks.values import (
    Positive,
    check_choice,
    check_number,
    check_whole_number,
    described,
    options,
    validate,
)
from rsvib_torch.files.reading import Table, read_toml

if TYPE_CHECKING:
    import torch
    from torch import Tensor

MIN_ROW_TIME = 1e-9  # s; the fastest sensors read a row in 0.1 us
MAX_FRAMES, MAX_ROWS = 10**8, 10**6  # 40 days of a camera with 30 frames/s; the largest sensors have 3e4 rows
MAX_BATCH = 10**6  # stacks; their frames of 128 x 128 px would fill 130 GB
MAX_SPAN = 2**19  # row times from the first to the last frame; the detection in 4 frames then takes 30 s and 0.5 GB
_MIN_EXPOSURE = 0.01  # row times; the shortest exposure of sensors is about one row, so that this is one in seconds
_MAX_BLANKING = 32  # row times per row; of more frames with so long a blanking time, 1 ms of 32 ms is read
MAX_START_TIME = 1e10  # s; clocks that count from 1970 read 1.8e9 s, to 2e-7 s in float64
_AGREEMENT = 1e-3  # relative; keys that state the same time twice are rounded by whoever wrote them
_SCAN_AXES: dict[object, int] = {-2: -2, "y": -2, -1: -1, "x": -1}


class TimingWarning(UserWarning):
    """The frame rate or the times of frames contradict the timing of the sensor."""


@dataclass(frozen=True)
class SensorTiming:
    """Timing of a rolling-shutter sensor (Liu et al. 2023, Figure 1).

    Row ``i`` of frame ``p`` starts its exposure at ``frame_start(p) + i row_time``, with
    ``frame_start(p) = p frame_rows row_time`` unless ``frame_start_times`` states otherwise, and is exposed for
    ``exposure_rows row_time``. Row 0 is the row that is read first. The three times have no defaults, since they
    cannot be guessed: ``frame_rows`` counts blanking rows and is not the image height.

    Args:
        row_time: Time between the exposure starts of two neighbouring rows, in seconds.
        exposure_rows: Exposure time in row times (may be fractional).
        frame_rows: Row times between the exposure starts of one row in consecutive frames: 1 / (frame rate x row time),
            blanking rows included, and at least the number of rows.
        scan_axis: Axis along which rows are exposed one after another: ``-2`` (or ``"y"``, the default: rows are
            image rows) or ``-1`` (or ``"x"``: rows are image columns).
        readout_direction: ``"forward"`` if the row at index 0 of the scan axis is read first, ``"reverse"`` if the
            last one is.
        frame_start_times: Exposure start of the first row of each frame in seconds, for frames that are not evenly
            spaced (dropped frames, irregular clocks); strictly increasing.
        row_time_std: Standard deviation of ``row_time`` in s, with the same exposure and frame period in s. Those of
            detected motions contain its effect.

    Raises:
        ValueError: If a value is out of range, or indicates another unit (a row time over 10 ms, a frame period
            over 10 s).

    Example:
        >>> timing = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
        >>> round(timing.frame_rate, 2)
        23.8
        >>> SensorTiming(row_time=20.52, exposure_rows=20, frame_rows=2048)
        Traceback (most recent call last):
        ...
        ValueError: row_time=20.52 s is longer than 10 ms; row_time is in seconds (20.52 us is 20.52e-6)
    """

    row_time: float
    exposure_rows: float
    frame_rows: float
    scan_axis: Literal[-2, -1, "y", "x"] = -2
    readout_direction: Literal["forward", "reverse"] = "forward"
    frame_start_times: Sequence[float] | Tensor | None = None
    row_time_std: float = 0.0

    def __post_init__(self) -> None:
        row_time = check_number("row_time", self.row_time, above=0.0)
        if row_time < MIN_ROW_TIME:
            raise ValueError(f"row_time={row_time:g} s is shorter than 1 ns; row_time is in seconds")
        if row_time > 10e-3:
            us = row_time if row_time >= 1 else 1e3 * row_time  # a number of us, or of ms
            raise ValueError(
                f"row_time={row_time:g} s is longer than 10 ms; row_time is in seconds ({us:g} us is {us:g}e-6)"
            )
        exposure_rows = check_number("exposure_rows", self.exposure_rows, above=0.0)
        frame_rows = check_number("frame_rows", self.frame_rows, above=0.0)
        if frame_rows * row_time > 10.0:
            raise ValueError(
                f"frame_rows={frame_rows:g} times row_time={row_time:g} s is a frame period of "
                f"{frame_rows * row_time:g} s, longer than 10 s; row_time is in seconds, frame_rows in row times"
            )
        if exposure_rows > frame_rows:
            exposure = exposure_rows * row_time
            in_us = f"; {exposure:g} us is {exposure:g}us on the command line, {exposure:g}e-6 elsewhere"
            raise ValueError(
                f"exposure_rows={exposure_rows:g} exceeds the frame period of frame_rows={frame_rows:g} row times: "
                f"exposure {exposure:.4g} s, frame period {frame_rows * row_time:.4g} s" + in_us * (exposure > 1)
            )
        if exposure_rows < _MIN_EXPOSURE:
            raise ValueError(
                f"exposure_rows={exposure_rows:g} is an exposure of {exposure_rows * row_time:.3g} s; it is the "
                f"exposure time divided by row_time ({exposure_rows:g} s are exposure_rows="
                f"{exposure_rows / row_time:.6g}), see SensorTiming.from_seconds"
            )
        if type(self.scan_axis) not in (int, str) or self.scan_axis not in _SCAN_AXES:
            raise ValueError(f"scan_axis must be -2 ('y') or -1 ('x'), got {described(self.scan_axis)}")
        check_choice("readout_direction", self.readout_direction, ("forward", "reverse"))
        checked = {"row_time": row_time, "exposure_rows": exposure_rows, "frame_rows": frame_rows}
        checked["row_time_std"] = check_number("row_time_std", self.row_time_std, at_least=0.0, at_most=row_time)
        for name, value in (checked | {"scan_axis": _SCAN_AXES[self.scan_axis]}).items():
            object.__setattr__(self, name, value)
        if self.frame_start_times is not None:
            from rsvib_torch.checks.arguments import as_numbers  # noqa: PLC0415

            times = as_numbers("frame_start_times", self.frame_start_times).flatten().tolist()
            starts = tuple(check_number("frame_start_times", start) for start in times)
            if starts and max(abs(starts[0]), abs(starts[-1])) > MAX_START_TIME:
                raise ValueError(
                    f"frame_start_times must be at most {MAX_START_TIME:g} s, got {starts[0]:g} ... {starts[-1]:g} s"
                )
            if any(later <= earlier for earlier, later in itertools.pairwise(starts)):
                raise ValueError("frame_start_times must be strictly increasing (seconds)")
            object.__setattr__(self, "frame_start_times", starts)

    @classmethod
    def from_seconds(
        cls,
        *,
        row_time: float,
        exposure_time: float,
        frame_rate: float,
        scan_axis: Literal[-2, -1, "y", "x"] = -2,
        readout_direction: Literal["forward", "reverse"] = "forward",
        frame_start_times: Sequence[float] | Tensor | None = None,
        row_time_std: float = 0.0,
    ) -> SensorTiming:
        """The timing from the exposure time in s and the frame rate: ``N_e = T_e / T_row``, ``m = 1 / (rate T_row)``.

        Other arguments and errors are those of ``SensorTiming``.

        Example:
            >>> timing = SensorTiming.from_seconds(row_time=20e-6, exposure_time=1 / 500, frame_rate=30)
            >>> timing.exposure_rows, round(timing.frame_rows, 2)
            (100.0, 1666.67)
        """
        row_time = check_number("row_time", row_time, above=0.0)
        exposure = check_number("exposure_time", exposure_time, above=0.0)
        period = 1 / check_number("frame_rate", frame_rate, above=0.0)
        settings = scan_axis, readout_direction, frame_start_times, row_time_std
        return cls(row_time, exposure / row_time, period / row_time, *settings)

    @staticmethod
    def from_file(path: str | os.PathLike[str]) -> SensorTiming:
        """The timing in the table ``[sensor]`` of a configuration file, as ``rsvib init`` writes it.

        Raises:
            ValueError: If it is not TOML, or a key of ``[sensor]`` is missing, unknown or has a wrong type or value.

        Example:
            >>> SensorTiming.from_file("camera.toml").frame_rate  # doctest: +SKIP
            29.97
        """
        sections = {name: table for name, table in read_toml(Path(path)).items() if name == "sensor"}
        section: SensorSection = validate(_SensorFile, sections, str(path)).sensor
        return section.to_timing()

    @property
    def exposure_time(self) -> float:
        """Exposure time T_e = N_e T_row in seconds."""
        return self.exposure_rows * self.row_time

    @property
    def frame_period(self) -> float:
        """Time m T_row between the exposure starts of consecutive frames in seconds."""
        return self.frame_rows * self.row_time

    def time_to_middle(self, num_rows: int) -> float:
        """Time in s from the exposure start of a frame of ``num_rows`` rows to its middle."""
        return 0.5 * ((num_rows - 1) * self.row_time + self.exposure_time)

    @property
    def frame_rate(self) -> float:
        """Frames per second."""
        return 1.0 / self.frame_period

    def frame_starts(self, num_frames: int, device: torch.device | str | None = None) -> Tensor:
        """Exposure start (num_frames,) of the first row of the first frames, in seconds, float64.

        Raises:
            ValueError: If ``frame_start_times`` has fewer than ``num_frames`` entries.
        """
        import torch  # noqa: PLC0415

        from rsvib_torch.checks.arguments import check_device  # noqa: PLC0415

        count = check_whole_number("num_frames", num_frames, at_least=0, at_most=MAX_FRAMES)
        device = check_device("device", "cpu" if device is None else device)
        if self.frame_start_times is None:
            return torch.arange(count, dtype=torch.float64, device=device) * self.frame_period
        if len(self.frame_start_times) < num_frames:
            raise ValueError(f"frame_start_times has {len(self.frame_start_times)} entries for {num_frames} frames")
        return torch.tensor(self.frame_start_times[:num_frames], dtype=torch.float64, device=device)

    def row_starts(self, num_frames: int, num_rows: int, device: torch.device | str | None = None) -> Tensor:
        """Exposure start (num_frames, num_rows) of every row, in seconds, float64; row 0 is the row read first."""
        import torch  # noqa: PLC0415

        starts = self.frame_starts(num_frames, device)
        count = check_whole_number("num_rows", num_rows, at_least=0, at_most=MAX_ROWS)
        rows = torch.arange(count, dtype=torch.float64, device=starts.device)
        return starts[:, None] + rows * self.row_time

    def check_rows(self, num_rows: int) -> None:
        """Raise a ``ValueError`` if a frame of this sensor has fewer row times than ``num_rows``."""
        check_whole_number("num_rows", num_rows, at_least=0, at_most=MAX_ROWS)
        if self.frame_rows < num_rows:
            raise ValueError(
                f"frame_rows={self.frame_rows:g} is less than the {num_rows} rows of the frames; it is the number of "
                f"row times from one frame to the next, including blanking rows, 1 / (frame rate x row time): with "
                f"{self.frame_rate:g} frames/s, row_time is at most {self.frame_period / num_rows:.6g} s"
            )

    def check_span(self, num_frames: int, num_rows: int) -> None:
        """Raise a ``ValueError`` if frames are too far apart for their number of rows to resolve frequencies.

        The number of frequencies that are tried, and the time and memory that they take, grow with the span.
        A ``TimingWarning`` states intervals between frames that are all far from the frame period.
        """
        check_whole_number("num_rows", num_rows, at_least=1)
        check_whole_number("num_frames", num_frames, at_least=1)
        starts = self.frame_starts(num_frames)
        step, span = float(starts.diff().median()), float(starts[-1] - starts[0])
        if span <= self.row_time * max(MAX_SPAN, _MAX_BLANKING * num_frames * num_rows):
            text = contradiction(self, starts, num_rows)
            if text:
                warnings.warn(text, TimingWarning, stacklevel=2)
            return
        units = {"ms": 1e3, "us": 1e6, "ns": 1e9}  # within a factor of two
        unit = next((name for name, size in units.items() if 0.5 < step / (size * self.frame_period) < 2), None)
        remedy = "use frames that follow each other" + (f"; times are seconds, and these may be {unit}" if unit else "")
        raise ValueError(
            f"frames are {step:.4g} s apart and {span:.4g} s in all, too long for frames that are read in "
            f"{num_rows * self.row_time:.3g} s; check frame_start_times and frame_rows, or {remedy}"
        )

    def to_dict(self) -> Table:
        """The arguments that make this timing, as plain numbers and texts."""
        starts = self.frame_start_times
        scan_axis = "x" if self.scan_axis == -1 else "y"
        return asdict(self) | {"scan_axis": scan_axis, "frame_start_times": None if starts is None else list(starts)}

    def in_row_order(self) -> RowTiming:
        """The same timing for frames already turned to row order (rows on axis -2, first row read first)."""
        return RowTiming(**(vars(self) | {"scan_axis": -2, "readout_direction": "forward"}))


@options
class SensorSection:
    """``[sensor]``: the timing, and the full scale of integer frames.

    Exposure and frame period are in seconds (``exposure_time``, ``frame_rate``) or in row times (``exposure_rows``,
    ``frame_rows``).
    """

    row_time: Positive
    """Time between the exposure starts of adjacent rows, in s. Data sheets call it line time or row period; 'rsvib
    calibrate' measures it with a flickering light. It is not 1 / (frame rate x rows), because sensors have blanking
    rows."""
    exposure_time: Positive | None = None
    """Exposure time in s: the setting of the camera (shutter, integration time), not the frame period."""
    exposure_rows: Positive | None = None
    """Exposure time divided by row_time."""
    frame_rate: Positive | None = None
    """Frames per second of the sensor. A slow-motion or time-lapse video is played at another rate."""
    frame_rows: Positive | None = None
    """Frame period divided by row_time, blanking rows included: 1 / (frame rate x row_time)."""
    scan_axis: Literal["y", "x"] = "y"
    """'y' if image rows are exposed one after another, 'x' for image columns (a camera on its side)."""
    readout_direction: Literal["forward", "reverse"] = "forward"
    """'forward' if the top row (or left column) is read first, 'reverse' if the last one is."""
    frame_start_times: list[float] | None = None
    """Exposure start of the first row of each frame in seconds, for frames that are not evenly spaced (dropped frames,
    irregular clocks); strictly increasing."""
    row_time_std: float = 0.0
    """Standard deviation of row_time in s, which those of frequencies and amplitudes then contain."""
    full_scale: Positive | None = None
    """Count of a saturated pixel: 4095 for 12 bits, also in a 16-bit file."""

    def __post_init__(self) -> None:
        self.to_timing()  # which checks the values

    def to_timing(self) -> SensorTiming:
        """The timing, with exposure and frame period in row times."""
        row_time, rate = self.row_time, self.frame_rate
        if rate is not None and rate < 0.1:
            raise ValueError(f"frame_rate={rate:g} is less than 0.1; it is in frames per second, 1 / (frame period)")
        exposure = None if self.exposure_time is None else self.exposure_time / row_time
        period = None if rate is None else 1.0 / (rate * row_time)
        return SensorTiming(
            row_time,
            _in_rows("exposure_time", self.exposure_time, exposure, "exposure_rows", self.exposure_rows),
            _in_rows("frame_rate", rate, period, "frame_rows", self.frame_rows),
            self.scan_axis,
            self.readout_direction,
            self.frame_start_times,
            self.row_time_std,
        )


def _in_rows(name: str, value: float | None, converted: float | None, rows_name: str, rows: float | None) -> float:
    """A time in row times that is stated by one of two keys, or by both if they agree."""
    if rows is None:
        if converted is None:
            raise ValueError(f"{name} or {rows_name} is missing")
        return converted
    if converted is not None and not math.isclose(converted, rows, rel_tol=_AGREEMENT):
        raise ValueError(
            f"{name}={value:g} contradicts {rows_name}={rows:g}: with this row_time it is {rows_name}={converted:.6g}; "
            "remove one of the two keys"
        )
    return rows


@options
class _SensorFile:
    sensor: SensorSection


@dataclass(frozen=True)
class RowTiming(SensorTiming):
    """Timing of frames in row order: rows lie on axis -2, and row 0 is read first.

    ``SensorTiming.in_row_order`` returns it. Functions of frames, offsets or motions in row order take it, so that a
    type checker refuses a timing whose frames have not been turned.
    """


def with_lost_frame(timing: SensorTiming, num_frames: int, first: int) -> SensorTiming:
    """The timing of ``num_frames`` frames if a further frame was lost before the frame ``first``."""
    starts: list[float] = timing.frame_starts(num_frames).tolist()
    later = [start + timing.frame_period * (frame >= first) for frame, start in enumerate(starts)]
    return replace(timing, frame_start_times=tuple(later))


def check_timing(value: object) -> None:
    """Raise a ``TypeError`` unless ``value`` is a ``SensorTiming``."""
    if not isinstance(value, SensorTiming):
        raise TypeError(f"timing must be a SensorTiming, got {type(value).__name__}")


def row_axes(timing: SensorTiming, num_axes: int) -> tuple[list[int], list[float]]:
    """Order and signs of the components of a motion when frames are turned to row order.

    Transposing frames exchanges x and y; flipping them along the rows changes the sign of y. Both change the sign of
    roll. Component i in row order is component ``order[i]`` in image axes times ``signs[i]``.
    """
    transposed, reverse = timing.scan_axis == -1, timing.readout_direction == "reverse"
    order = [1, 0, 2, 3] if transposed else [0, 1, 2, 3]
    signs = [1.0, -1.0 if reverse else 1.0, -1.0 if transposed != reverse else 1.0, 1.0]
    return order[:num_axes], signs[:num_axes]


def other_intervals(timing: SensorTiming | RowTiming, starts: Tensor, num_rows: int) -> tuple[float, float] | None:
    """Shortest and longest interval in s between frames whose intervals are not whole frame periods, to 1 %.

    None if they are and the shortest one is at most 3 periods, and for line sensors: their frames have no blanking
    rows, and start after delays.
    """
    if len(starts) < 2 or timing.frame_rows <= num_rows:
        return None
    periods = starts.diff() / timing.frame_period
    whole = periods.round().clamp(min=1.0)
    if float(periods.min()) < 3.1 and bool(((periods - whole).abs() <= 0.01 * whole).all()):
        return None
    return float(periods.min()) * timing.frame_period, float(periods.max()) * timing.frame_period


def contradiction(timing: SensorTiming | RowTiming, starts: Tensor, num_rows: int) -> str:
    """Sentence about starts of frames whose intervals are all far from the frame period; empty if they are not."""
    shortest, longest = other_intervals(timing, starts, num_rows) or (timing.frame_period, timing.frame_period)
    if 0.9 * shortest <= timing.frame_period <= longest / 0.9:
        return ""
    return (
        f"by their times, frames are {float(starts.diff().median()):.3g} s apart, but the frame period is "
        f"{timing.frame_period:.3g} s (frame_rows={timing.frame_rows:g} x row_time={timing.row_time:g} s): wrong times "
        "give wrong frequencies; times are seconds, correct them or frame_rows"
    )
