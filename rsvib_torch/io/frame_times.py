"""When frames were exposed, by what their file states."""

from dataclasses import replace

import numpy as np

from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.motion.timing import SensorTiming

__all__ = ["exposure_times", "timing_from_first_frame", "timing_of_stack"]

_NEAR = 0.25  # periods between a time of playback and a whole number of them


def exposure_times(info: StackInfo, timing: SensorTiming) -> tuple[float, ...] | None:
    """Exposure start of every frame as its file states it, in seconds; None where it does not.

    The times of a video say when a frame is to be shown: they are rounded, and may run at another rate. Where they are
    the camera's they are whole frame periods apart, most of them one, and tell which frames were dropped; else None.

    Args:
        info: What the file says of itself.
        timing: The sensor.
    """
    if info.frame_times is None or not info.times_of_playback:
        return info.frame_times
    gaps = np.diff(np.array(info.frame_times)) / timing.frame_period
    whole = np.round(gaps)
    if not len(gaps) or whole.min() < 1 or np.abs(gaps - whole).max() > _NEAR or np.median(whole) != 1:
        return None
    return tuple(float(count) * timing.frame_period for count in (0.0, *np.cumsum(whole)))


def timing_of_stack(timing: SensorTiming, info: StackInfo) -> SensorTiming:
    """The sensor with the frame times of a file, where it has none of its own and these are not those of its period.

    Args:
        timing: The sensor.
        info: What the file says of itself.
    """
    if timing.frame_start_times is not None or (times := exposure_times(info, timing)) is None:
        return timing
    if info.times_of_playback and np.ptp(np.diff(times)) < 1e-9 * timing.frame_period:
        return timing  # no frame was dropped
    return replace(timing, frame_start_times=times)


def timing_from_first_frame(timing: SensorTiming, info: StackInfo) -> SensorTiming:
    """``timing_of_stack`` for a stack that is looked at as a whole: times of its file begin with its first frame."""
    whole = timing_of_stack(timing, info)
    if timing.frame_start_times is not None or whole.frame_start_times is None:
        return whole
    times = [float(time) for time in whole.frame_start_times]
    return replace(whole, frame_start_times=tuple(time - times[0] for time in times))
