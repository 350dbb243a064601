"""``calibrate_row_time_by_motion``: row time and readout direction of a camera from the motion in its frames.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from collections.abc import Callable
from typing import Literal, ParamSpec, Protocol

from pydantic import Field

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.checks.values import Number, Positive, check_number
from rsvib_torch.checks.values import options as option_group
from rsvib_torch.execution.parallel import full_precision, threads_for, without_gradients
from rsvib_torch.frames.entry_points import entry_point
from rsvib_torch.frames.prepare import grey_frames, reasons_from_row_order
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import MaskedInputOptions, RegistrationOptions
from rsvib_torch.results.reason import Reason
from rsvib_torch.row_time import RowTimeCalibration
from rsvib_torch.row_time.by_tones import CameraClock, Candidate, row_times_of_tones

P = ParamSpec("P")

_MIN_FRAMES = 3  # two frames determine the product of row time and frequency only
_MAX_STD = 0.01  # of the row time, standard deviation of a certain result; frequencies have the same relative error
_SHORTEST_READOUT = 0.1  # of the frame period, if no row times are given


@option_group
class RowTimeOptions(RegistrationOptions, MaskedInputOptions):
    """Options of ``calibrate_row_time_by_motion``; bands are those of the start."""

    frame_rate: Positive
    """Frames per second."""
    row_time: tuple[Number, Number] | None = Field(default=None, strict=False)
    """Shortest and longest possible row time in s. By default the rows of a frame are read within a tenth to the whole
    of the frame period."""
    exposure_time: Positive | None = None
    """Exposure in s, if known. It does not affect the row time, but long ones may be refused without it."""
    scan_axis: Literal[-2, -1, "y", "x"] = -2
    """Axis along which rows follow each other, as in ``SensorTiming``."""
    readout_direction: Literal["forward", "reverse"] | None = None
    """None to determine it as well."""


class _CalibratesByMotion(Protocol[P]):
    """Type of ``calibrate_row_time_by_motion``."""

    def __call__(self, frames: FramesOrFiles, *args: P.args, **kwargs: P.kwargs) -> RowTimeCalibration:
        """Call the function."""


def _row_time_options(
    options: Callable[P, RowTimeOptions],
) -> Callable[[Callable[..., RowTimeCalibration]], _CalibratesByMotion[P]]:
    return lambda function: entry_point(options, function)


@_row_time_options(RowTimeOptions)
@full_precision
@without_gradients
def calibrate_row_time_by_motion(frames: FramesOrFiles, options: RowTimeOptions) -> RowTimeCalibration:
    """Row time and readout direction from the motion of the camera, without a lamp.

    A tone of frequency f advances by ``f T_row`` cycles from row to row, and by ``f P`` cycles, of which the whole
    number k is unknown, from frame to frame of known period P. One tone therefore has one row time for each k; two
    tones of unrelated frequencies have one row time in common. The displacements of rows are measured on the images,
    and the row time is fitted together with all parameters of the tones.

    The result is reliable only if a single row time within the given limits, and a single readout direction, explains
    the frames. Other row times that explain them are listed in ``agreeing``.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) of three or more consecutive frames, as in ``detect_vibration``.
        options: Options; tones of more than ``0.5 / band_step`` cycles per row are not found.

    Returns:
        Row time with its standard deviation, and readout direction. ``reliable`` is False, with ``findings``, if the
        row time is not determined; it is None if nothing is known about it.

    Raises:
        ValueError: If frames cannot be registered, or an option is out of range.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=60e-6, exposure_rows=8, frame_rows=240)
        >>> vibration = rsv.Vibration(amplitude=[3.1, 2.2], frequency=[131.0, 97.0], phase=[0.4, 2.0])
        >>> frames = rsv.simulate_frames(city_and_fields(220, 190, seed=3), timing, vibration, num_frames=5)
        >>> found = rsv.calibrate_row_time_by_motion(frames, frame_rate=timing.frame_rate, row_time=(30e-6, 70e-6))
        >>> f"{1e6 * found.row_time:.2f} us, {found.readout_direction}"
        '60.00 us, forward'
        >>> two = rsv.calibrate_row_time_by_motion(frames[:2], frame_rate=timing.frame_rate)
        >>> two.reliable, two.findings[0].code
        (False, 'too_few_frames_for_row_time')
    """
    period, exposure = 1 / options.frame_rate, options.exposure_time
    if exposure is not None and exposure > period:
        raise ValueError(f"exposure_time={exposure:g} s exceeds the frame period of {period:.6g} s; give it in seconds")
    # frames are converted with any row time: only scan axis and readout direction matter
    sensor = SensorTiming(1e-9, 1.0, 10.0 * 2**20, options.scan_axis)
    stack = grey_frames(frames, sensor, options, timed=False)
    if stack.batched:
        raise ValueError(f"calibrate_row_time_by_motion takes one stack, got a batch of {len(stack.images)}")
    num_frames, num_rows = stack.images.shape[1:3]
    low, high = _limits(options.row_time, period, num_rows)
    signs = {None: (1.0, -1.0), "forward": (1.0,), "reverse": (-1.0,)}[options.readout_direction]
    clock = CameraClock(period, low, high, signs, exposure or 0.0)
    # 1. The row times that agree with the tones, and the reasons against them.
    agreeing, reasons = list[Candidate](), [Reason("too_few_frames_for_row_time", None, num_frames, _MIN_FRAMES)]
    if num_frames >= _MIN_FRAMES:
        with threads_for(stack.images):
            agreeing, reasons = row_times_of_tones(stack, clock, options)
        reasons += [] if agreeing else [Reason("no_motion_for_row_time")]
    if len(agreeing) > 1:
        listed = ", ".join(f"{1e6 * candidate.row_time:.4f}" for candidate in agreeing[1:9])
        details: dict[str, float | str] = {"row_time": 1e6 * agreeing[0].row_time, "others": listed}
        reasons.append(Reason("row_times_ambiguous", None, len(agreeing), 1, details))
    row_time, std = (abs(agreeing[0].row_time), agreeing[0].std) if agreeing else (None, None)
    if row_time is not None and std is not None and std > _MAX_STD * row_time:
        reasons.append(Reason("row_time_uncertain", None, std / row_time, _MAX_STD))
    # 2. The result; the readout direction if all of them have the same.
    directions: set[Literal["forward", "reverse"]] = {"forward" if one.row_time > 0 else "reverse" for one in agreeing}
    notes = (
        f"row times of {1e6 * low:.3f} to {1e6 * high:.3f} us were considered, a readout within a tenth to the "
        "whole of the frame period; pass row_time=(low, high) for other ones",
    )
    return RowTimeCalibration(
        row_time=row_time,
        row_time_std=std,
        frame_rows=None if row_time is None else period / row_time,
        readout_direction=directions.pop() if len(directions) == 1 else None,
        notes=notes if options.row_time is None else (),
        candidates=tuple(sorted(candidate.row_time for candidate in agreeing)),
        reliable=not reasons,
        findings=reasons_from_row_order(tuple(reasons), sensor),
    )


def _limits(row_time: tuple[float, float] | None, period: float, num_rows: int) -> tuple[float, float]:
    """Shortest and longest possible row time in s."""
    longest = period / num_rows
    if row_time is None:
        return _SHORTEST_READOUT * longest, longest
    low, high = (check_number("row_time", value, above=0.0) for value in row_time)
    if low >= high:
        raise ValueError(f"row_time=({low:g}, {high:g}): the first must be smaller")
    if low >= longest:
        raise ValueError(
            f"row_time=({low:g}, {high:g}) s: {num_rows} rows take longer than the frame period of {period:.6g} s; "
            f"row times are in seconds, and at most {longest:.4g}"
        )
    return low, min(high, longest)
