"""Times and frame rate that a file states, compared with the sensor and used as exposure starts of the frames."""

import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.motion.timing import MAX_START_TIME, MIN_ROW_TIME, SensorTiming, TimingWarning

_RATE_TOLERANCE = 0.01  # relative; files state 30 for 29.97 frames per second (0.1 %)
# Times from which independent deviations differ from those that add up: of 4000 random walks of 60 times, 0.2 % seem
# independent, of 30 times 10 %
_MIN_STAMPS = 50

_TURNED = {3: "rotated by 180 degrees", 6: "rotated by 90 degrees clockwise", 8: "rotated by 90 degrees anticlockwise"}


class _Spacing(NamedTuple):
    """Spacing of the frames of a file."""

    # intervals from the first frame to each, several where frames were dropped; empty if only a rate is stated; None if
    # the rate is variable: times are not whole intervals apart, to within their error, 2 % (clock of a camera), and a
    # quarter of one, which is also allowed where their deviations do not add up
    numbers: list[float] | None
    interval: float  # s, without dropped frames: of a straight line, or the median if the rate is variable
    limits: tuple[float, float]  # s, shortest and longest interval if the rate is variable, otherwise ``interval``
    error: float = 0.0  # s, of ``interval`` due to the error of the times
    jitter: float = 0.0  # s, largest deviation of the times from whole intervals


def _spacing(info: StackInfo) -> _Spacing | None:
    """Spacing by the times or the frame rate of a file; None if it states neither. Impossible ones are refused."""
    few = info.frame_times is None or len(info.frame_times) < 2
    if few and info.frame_rate is None:
        return None
    times = np.array((0.0, 1.0 / max(info.frame_rate or 0.0, 1e-300)) if few else info.frame_times)
    intervals = np.diff(times)
    possible = (np.abs(times) <= MAX_START_TIME) & (np.append(intervals, 1.0) >= MIN_ROW_TIME)
    if not possible.all():
        stated = f"frame_rate={info.frame_rate}" if few else f"the time of frame {int(np.argmin(possible))}"
        raise ValueError(
            f"{info.path or 'the file'}: {stated} is not that of a camera: times in seconds must be finite and "
            f"increase; correct or remove it ({info.time_source})"
        )
    median = float(np.median(intervals))
    if few:
        return _Spacing([], median, (median, median))
    # 1. Frames at whole numbers of intervals: a straight line, and deviations from it.
    single = float(intervals[np.round(intervals / median) == 1].mean())  # more accurate if times are rounded
    whole = np.round(intervals / single)
    numbers = np.concatenate([[0.0], np.cumsum(whole)])
    interval, start = np.polyfit(numbers, times, 1).tolist()
    deviations = times - (start + interval * numbers)
    jitter = float(np.abs(deviations).max())
    # 2. Durbin-Watson: 2 if the deviations are independent (clock of the program that records), 0 if intervals differ
    # and add up, 4 if they alternate.
    independence = float(np.square(np.diff(deviations)).sum() / max(np.square(deviations).sum(), 1e-300))
    is_clock = info.time_error > 0.0 and len(times) >= _MIN_STAMPS and 1.0 < independence < 3.0
    if whole.min() >= 1 and jitter <= 0.25 * single and (is_clock or jitter <= max(info.time_error, 0.02 * single)):
        return _Spacing(numbers.tolist(), interval, (interval, interval), info.time_error / float(numbers[-1]), jitter)
    return _Spacing(None, median, (float(intervals.min()), float(intervals.max())), info.time_error)


def stated_rate(info: StackInfo) -> float | None:
    """Frames per second that a file states by its times, between which frames may be missing, or as a rate."""
    spacing = _spacing(info)
    return None if spacing is None else 1.0 / spacing.interval


def _same_rate(spacing: _Spacing, info: StackInfo, timing: SensorTiming) -> bool:
    """Whether the frame rate of a file is that of the sensor.

    If it is variable, the period of the sensor must lie between the shortest and the longest interval. Frames with
    exact times may be every n-th frame of the sensor.
    """
    period = timing.frame_period
    if info.frame_times is not None and info.time_error == 0.0:
        period *= max(1, round(spacing.interval / period))
    tolerance = _RATE_TOLERANCE * period + spacing.error
    return spacing.limits[0] - tolerance <= period <= spacing.limits[1] + tolerance


def exposure_times(info: StackInfo, timing: SensorTiming) -> tuple[float, ...] | None:
    """Exposure start of every frame according to its file, in seconds; None if it is not stated, or at another rate.

    If a file without times states that frames are missing, the result consists of multiples of the sensor's frame
    period. Exact times are returned as they are. Times with an error, e.g. the presentation times of a video, are used
    only if their interval is the frame period of the sensor to 1 %, or their intervals include it. If they are whole
    numbers of intervals apart (``_Spacing.numbers``), the result consists of multiples of the sensor's frame period,
    with gaps where frames were dropped. Otherwise the frame rate is variable: the times are returned as they are if
    their error is less than a tenth of a period.
    """
    if info.frame_times is None and info.frame_numbers is not None:
        return tuple(number * timing.frame_period for number in info.frame_numbers)
    if info.frame_times is None or info.time_error == 0.0:
        return info.frame_times
    spacing = _spacing(info)
    if spacing is None or not _same_rate(spacing, info, timing):
        return None
    if spacing.numbers is not None:
        return tuple(number * timing.frame_period for number in spacing.numbers)
    return info.frame_times if info.time_error <= 0.1 * timing.frame_period else None


def timing_of_stack(timing: SensorTiming, info: StackInfo) -> SensorTiming:
    """The sensor with the frame times of a file, unless it has its own or the frames are evenly spaced."""
    if timing.frame_start_times is not None:
        return timing
    spacing, times, text = _spacing(info), exposure_times(info, timing), ""
    if spacing is not None and not _same_rate(spacing, info, timing):
        exact = info.frame_times is not None and info.time_error == 0.0
        used = "the times of the file are used" if exact else f"{timing.frame_rate:.5g} is used, with equal intervals"
        text = (
            f"{1.0 / spacing.interval:.5g} frames per second according to its {info.time_source}, but "
            f"{timing.frame_rate:.5g} according to the sensor (frame_rows={timing.frame_rows:g}, "
            f"row_time={timing.row_time:g} s); {used}. If the file is right, set the frame rate to "
            f"{1.0 / spacing.interval:.6g} (frame_rows={spacing.interval / timing.row_time:.6g}) or correct row_time; "
            "if the sensor is right (slow motion), nothing needs to be changed"
        )
    elif times is None and info.frame_times is not None and len(info.frame_times) > 1:
        text = f"the {info.time_source} are irregular and have errors of up to {1e3 * info.time_error:.3g} ms; "
        text += "equal intervals are assumed, set frame_start_times if they are not"
    if text:
        warnings.warn(f"{info.path or 'the file'}: {text}", TimingWarning, stacklevel=2)
    if times is None or (info.time_error and np.ptp(np.diff(times)) < 1e-9 * timing.frame_period):
        return timing
    return replace(timing, frame_start_times=times)


@checks_arguments
def timing_from_first_frame(timing: SensorTiming, info: StackInfo) -> SensorTiming:
    """The timing of a stack: the sensor, with the frame times of the file relative to the first frame.

    Args:
        timing: The sensor. Its own ``frame_start_times``, if it has any, are kept.
        info: What the file states, from ``read_stack_info``.

    Warns:
        TimingWarning: If the file states another frame rate than the sensor has, or irregular times that are too rough.

    Example:
        >>> import rsvib_torch as rsv
        >>> timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=20, frame_rows=333.3)  # 30 frames per second
        >>> info = rsv.StackInfo((3, 256, 256), "uint8", 255, frame_times=(5.0, 5.03333, 5.1))  # a dropped frame
        >>> rsv.timing_from_first_frame(timing, info).frame_starts(3).round(decimals=4).tolist()  # s
        [0.0, 0.0333, 0.1]
    """
    of_stack = timing_of_stack(timing, info)
    times = of_stack.frame_start_times
    if timing.frame_start_times is not None or times is None:
        return of_stack
    return replace(of_stack, frame_start_times=tuple(float(time) - float(times[0]) for time in times))


def describe_stack(info: StackInfo, timing: SensorTiming | None) -> list[str]:
    """Sentences about an orientation, dropped frames and unequal intervals that a file states."""
    name, notes, missing, source = info.path or "the file", [], 0, f"its {info.time_source}"
    if info.orientation != 1:
        displayed = _TURNED.get(info.orientation, "mirrored")
        notes.append(f"{name}: displayed {displayed}; rows, x and y are those of the stored frames")
    if timing is None or timing.frame_start_times is not None:
        return notes
    times, spacing = exposure_times(info, timing), _spacing(info)
    if info.frame_times is None and info.frame_numbers is not None:
        missing, source = info.frame_numbers[-1] + 1 - info.shape[0], "the numbers in the file names"
    elif times is not None and spacing is not None and spacing.numbers is None:
        low, high = (1e3 * interval for interval in spacing.limits)
        error = f"whose error is up to {1e3 * info.time_error:.2g} ms; --frame-rate selects equal intervals"
        notes.append(f"{name}: frame intervals of {low:.4g} to {high:.4g} ms; {source} are used, {error}")
    elif times is not None and spacing is not None and spacing.numbers is not None:
        missing = round(float(spacing.numbers[-1])) + 1 - len(times)
    if missing:
        are = "frame is" if missing == 1 else "frames are"
        notes.append(f"{name}: {missing} {are} missing according to {source}, which are used")
    if times is not None and spacing is not None and spacing.jitter > max(info.time_error, 0.02 * spacing.interval):
        scatter = f"{source} scatter by up to {1e3 * spacing.jitter:.2g} ms like those of a program that records"
        notes.append(f"{name}: {scatter}; equal intervals are used, set frame_start_times if they are not")
    return notes
