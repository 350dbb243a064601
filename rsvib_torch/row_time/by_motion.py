"""``calibrate_row_time_by_motion``: row time and readout direction of a camera from the motion in its frames.

Tones are fitted in ``by_tones.py``. A motion of any other shape that is smooth over the blanking time continues from
the end of one frame to the begin of the next: a spline in time with as few knots as explain the displacements of the
rows is fitted together with the row time. At a wrong row time, the continuation fails and more knots are needed.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, ParamSpec, Protocol

import numpy as np
from pydantic import Field
from scipy import linalg

from rsvib_torch.checks.arrays import FramesOrFiles
from rsvib_torch.checks.validation import Number, Positive
from rsvib_torch.checks.validation import options as option_group
from rsvib_torch.checks.values import check_number
from rsvib_torch.detection.shapes.free import measure_freely, normal_bands, residual_of_motion
from rsvib_torch.detection.start import band_start
from rsvib_torch.execution.parallel import threads_for
from rsvib_torch.execution.precision import full_precision, without_gradients
from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.entry_points import entry_point
from rsvib_torch.frames.grey import GreyFrames, grey_frames
from rsvib_torch.frames.orientation import reasons_from_row_order
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.splines import spline_taps
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import OffsetOptions, RegistrationOptions
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.results.reason import Reason
from rsvib_torch.row_time import RowTimeCalibration
from rsvib_torch.row_time.by_path import row_time_of_path
from rsvib_torch.row_time.by_tones import (
    MAX_CHI_SQUARE,
    CameraClock,
    Candidate,
    FramePlaces,
    RowTimeFit,
    bands_of_frames,
    is_tone,
    refined,
    row_time_of_tones,
)

P = ParamSpec("P")

_MIN_FRAMES = 3  # two frames determine the product of row time and frequency only
SHORTEST_READOUT = 0.1  # of the frame period, if no row times are given
DEGREE = 7  # a simulated motion of 8 Hz bandwidth needs knots of 11 ms to its noise, and of 8 ms with degree 3
_GRID_FRAMES = 24  # frames whose minima over the grid of row times are refined with all frames
GRID_STEP = 0.02  # of the row time; minima of the residual are 0.1 wide or wider for motions that are accepted


@option_group
class RowTimeOptions(OffsetOptions):
    """Options of ``calibrate_row_time_by_motion``; bands are those of the start."""

    frame_rate: Positive
    """Frames per second."""
    row_time: tuple[Number, Number] | None = Field(default=None, strict=False)
    """Shortest and longest possible row time in s. By default the rows of a frame are read within a tenth to the whole
    of the frame period."""
    exposure_time: Positive | None = None
    """Exposure in s. None to measure it from the blur, if possible; it hardly affects the row time."""
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
    tones of unrelated frequencies have one row time in common. Without tones, a smooth motion determines the row time,
    because it continues from the end of a frame to the begin of the next. The row displacements are measured directly
    on the images, and the row time is fitted together with all parameters of the motion.

    The result is reliable only if a single row time within the given limits, and a single readout direction, explains
    the frames. Other row times that explain them are listed in ``candidates``.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) of three or more consecutive frames, as in ``detect_vibration``.
        options: Options; tones of more than ``0.5 / band_step`` cycles per row are not found.

    Returns:
        Row time with its standard deviation, readout direction, and the exposure where it is known. ``reliable`` is
        False, with ``findings``, if the row time is not determined; it is None if nothing is known about it.

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
    directions = {None: (1.0, -1.0), "forward": (1.0,), "reverse": (-1.0,)}[options.readout_direction]
    clock = CameraClock(period, num_rows, low, high, directions, exposure)
    notes = []
    if options.row_time is None:
        notes.append(
            f"row times of {1e6 * low:.3f} to {1e6 * high:.3f} us were considered, a readout within a tenth to the "
            "whole of the frame period; pass row_time=(low, high) for other ones"
        )
    if exposure is not None:
        notes.append("the exposure time is the given one")
    if num_frames < _MIN_FRAMES:
        found = _undetermined(Reason("too_few_frames_for_row_time", None, num_frames, _MIN_FRAMES))
    else:
        with threads_for(stack.images):
            curve, bands = bands_of_frames(stack, clock, options)
            by_path = None if is_tone(curve) else row_time_of_path(stack, clock)
            if by_path is not None:
                clock = clock.near(by_path)
            by_tones = row_time_of_tones(stack, clock, options, bands)
            found = by_tones or _undetermined(Reason("no_motion_for_row_time"))
            if found.findings and not is_tone(curve):
                places = _measured_freely(stack, clock, options, curve)
                spline = row_time_of_splines(places, clock)
                if spline is not None and spline[0].std < spline[0].permitted * abs(spline[0].row_time):
                    found, spacing = spline
                    notes.append(f"the motion is no sum of few tones: a spline with knots {1e3 * spacing:.3g} ms apart")
                elif by_path is not None:
                    found = by_path
                    notes.append("the motion is that of a hand or a flight: the path of corners over all rows")
    return _result(replace(found, findings=reasons_from_row_order(found.findings, sensor)), clock, notes)


def _limits(row_time: tuple[float, float] | None, period: float, num_rows: int) -> tuple[float, float]:
    """Shortest and longest possible row time in s."""
    longest = period / num_rows
    if row_time is None:
        return SHORTEST_READOUT * longest, longest
    low, high = (check_number("row_time", value, above=0.0) for value in row_time)
    if low >= high:
        raise ValueError(f"row_time=({low:g}, {high:g}): the first must be smaller")
    if low >= longest:
        raise ValueError(
            f"row_time=({low:g}, {high:g}) s: {num_rows} rows take longer than the frame period of {period:.6g} s; "
            f"row times are in seconds, and at most {longest:.4g}"
        )
    return low, min(high, longest)


def _measured_freely(
    stack: GreyFrames, clock: CameraClock, options: RegistrationOptions, curve: OffsetCurve
) -> FramePlaces:
    """Displacements of rows, measured around a motion of any shape, which any assumed row time allows."""
    # the blanking time, over which the spline continues, is half of the period
    timing = clock.timing(0.5 * clock.period / clock.num_rows)
    start = band_start(stack, timing, options, curve, mere_start=True)
    rows, motion = measure_freely(stack, timing, start.measurements, 24, 4)
    measured = rows.measurements.reweighted(residual_of_motion(rows.measurements, motion[0]))
    residual = residual_of_motion(measured, motion[0])
    measured = replace(measured, independent=measured.independent_fraction(residual))
    return FramePlaces.of(measured, clock.period, timing.row_time, clock.num_rows)


def _undetermined(reason: Reason) -> RowTimeFit:
    return RowTimeFit(math.nan, math.nan, findings=(reason,))


def _result(found: RowTimeFit, clock: CameraClock, notes: list[str]) -> RowTimeCalibration:
    findings = list(found.findings)
    known = math.isfinite(found.row_time)
    if found.others:
        listed = ", ".join(f"{1e6 * one.row_time:.4f}" for one in found.others[:8])
        details: dict[str, float | str] = {"row_time": 1e6 * found.row_time, "others": listed}
        findings.append(Reason("row_times_ambiguous", None, len(found.others) + 1, 1, details))
    if known and found.std > found.permitted * abs(found.row_time):
        findings.append(Reason("row_time_uncertain", None, found.std / abs(found.row_time), found.permitted))
    exposure, exposure_std = (found.exposure_time, found.exposure_std) if known else (None, None)
    if clock.exposure_time is not None:
        exposure, exposure_std = clock.exposure_time, 0.0
    elif exposure is None and known:
        notes = [*notes, "exposure unknown: the blur hardly differs between the frames"]
    directions: tuple[Literal["forward", "reverse"], ...] = ("forward", "reverse")
    signs = {one.row_time > 0 for one in found.others} | {found.row_time > 0}
    return RowTimeCalibration(
        row_time=abs(found.row_time) if known else None,
        row_time_std=found.std if known else None,
        frame_rows=clock.period / abs(found.row_time) if known else None,
        readout_direction=directions[found.row_time < 0] if known and len(signs) == 1 else None,
        exposure_time=exposure,
        exposure_time_std=exposure_std,
        notes=tuple(notes),
        candidates=tuple(sorted((found.row_time, *(one.row_time for one in found.others)))) if known else (),
        reliable=not findings,
        findings=tuple(findings),
    )


def row_time_of_splines(places: FramePlaces, clock: CameraClock) -> tuple[RowTimeFit, float] | None:
    """Row time at which the fewest knots explain the displacements, and their distance in s; None if no motion does."""
    num_rows, low, high = clock.num_rows, clock.low, clock.high
    places = places.centred(num_rows)
    first_places, known = places.of_first_frames(_GRID_FRAMES), float(places.measurements.num_measurements.sum())
    count = max(1, math.ceil(math.log(high / low) / GRID_STEP))
    sizes = [low * (high / low) ** (i / count) for i in range(count + 1)]
    grid = sorted(direction * size for direction in clock.directions for size in sizes)
    period, spacing = places.period, places.period
    blank = period - num_rows * high
    while spacing > max(0.7 * blank, 0.1 * period):
        advance, costs = steps(len(grid), "row times"), []
        for tried in grid:
            costs.append(_evaluated(first_places, tried, spacing)[0].chi_square)
            advance()
        minima = [i for i, cost in enumerate(costs) if cost <= min(costs[max(i - 1, 0) : i + 2])]
        lowest = sorted(minima, key=costs.__getitem__)[:6]
        found = sorted((_refined(places, grid[i], spacing, low, high) for i in lowest), key=lambda one: one.chi_square)
        # knots twice as close explain noise only
        closer = _refined(places, found[0].row_time, 0.5 * spacing, low, high)
        # numbers of coefficients of both axes
        coarse, fine = (2 * _grid(places, found[0].row_time, step)[1][2] for step in (spacing, 0.5 * spacing))
        noise, added = closer.chi_square / max(1.0, known - fine), fine - coarse
        if found[0].chi_square - closer.chi_square < noise * (added + 3.0 * math.sqrt(2.0 * added)):
            break
        spacing /= 2**0.25
    else:
        return None
    if spacing < 0.7 * (period - num_rows * abs(found[0].row_time)):
        return None
    # with knots that are a little closer, the errors of the spline are below the noise
    finer = spacing / 2**0.25
    best = _refined(places, found[0].row_time, finer, low, high)
    std = best.std * math.sqrt(noise)
    others = tuple(
        one
        for one in found[1:]
        if one.chi_square < found[0].chi_square + noise * MAX_CHI_SQUARE
        and abs(one.row_time - best.row_time) > 5 * (std + one.std * math.sqrt(noise))
    )
    return RowTimeFit(best.row_time, std, others), finer


def _grid(places: FramePlaces, row_time: float, spacing: float) -> tuple[Array, tuple[float, float, int]]:
    """Times (N, G) in s of the rows, and first knot, distance and number of knots about ``spacing`` apart."""
    times = places.times(row_time)[0]
    first, last = float(times.min()), float(times.max())
    cells = max(1, math.ceil((last - first) / spacing))
    return times, (first, (last - first) / cells, cells + DEGREE)


def _evaluated(places: FramePlaces, row_time: float, spacing: float) -> tuple[Candidate, float]:
    """Splines of both axes at a row time, and the Gauss-Newton step in s, with the coefficients fitted again."""
    # 1. The coefficients that each row depends on.
    measured = places.measurements
    times, grid = _grid(places, row_time, spacing)
    index, basis = spline_taps(times, *grid, degree=DEGREE)
    _, slope = spline_taps(times, *grid, degree=DEGREE, derivative=1)
    weights = measured.inverse_variances[0].T
    bands = normal_bands(index, basis, measured.visible[0], weights, grid[2])

    def fitted(values: Array, weight: Array, factor: Array) -> tuple[Array, Array]:
        """Derivatives (N, G) by the time of a spline that is fitted to values (N, G), and the residual."""
        right = np.bincount(index.ravel(), (basis * (weight * values)[..., None]).ravel(), grid[2])
        solution = linalg.cho_solve_banded((factor, True), right, check_finite=False)[index]
        return (slope * solution).sum(-1), values - measured.relative((basis * solution).sum(-1)[None])[0]

    cost, step, information = 0.0, 0.0, 0.0
    for axis, (weight, band) in enumerate(zip(weights[..., None], bands, strict=True)):
        # 2. The spline.
        band[0] += 1e-10 * band[0].mean() + 1e-300
        factor = linalg.cholesky_banded(band, lower=True, check_finite=False)
        velocity, residual = fitted(measured.displacements[0, ..., axis], weight, factor)
        # 3. The change of the displacements by the row time that no change of the coefficients cancels.
        by_row_time = measured.relative((velocity * places.rows[0])[None])[0]
        _, unexplained = fitted(by_row_time, weight, factor)
        cost += float((weight * np.square(residual)).sum())
        step += float((weight * unexplained * residual).sum())
        information += float((weight * np.square(unexplained)).sum())
    independent = float(np.squeeze(measured.independent))
    information = max(information * independent, 1e-300)
    return Candidate(row_time, information**-0.5, cost * independent), step * independent / information


def _refined(places: FramePlaces, row_time: float, spacing: float, low: float, high: float) -> Candidate:
    return refined(lambda tried: _evaluated(places, tried, spacing), row_time, low, high)
