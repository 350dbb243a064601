"""Row time from frames and a motion that another instrument recorded.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import replace

from rsvib_torch.detection.shapes.free import residual_of_motion, rms_motion
from rsvib_torch.detection.verdict import recording_reasons
from rsvib_torch.gyroscope.alignment import FittedClock, best_offset, fit_clock
from rsvib_torch.gyroscope.clock_range import offset_range
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.results.reason import Reason
from rsvib_torch.row_time.by_tones import CameraClock, RowTimeFit
from rsvib_torch.row_time.joint_fit import FramePlaces
from rsvib_torch.row_time.row_tones import MAX_CHI_SQUARE, Candidate


def row_time_of_recording(
    places: FramePlaces,
    recorded: FreeMotion,
    clock: CameraClock,
    num_frames: int,
    *,
    offsets: tuple[float, float] | None,
    fit_gain: bool,
) -> RowTimeFit:
    """Row time at which the recorded motion, its axes in row order, explains the displacements of the rows.

    Offset and rate of the clock, drift and (on request) gain are fitted together with the row time, from starts at many
    row times. Rows are counted from the middle one, whose time determines the offset whatever the row time is.
    """
    half = 0.5 * (clock.num_rows - 1)
    places = replace(places, rows=places.rows - half)
    reach = half * clock.high
    end = (num_frames - 1) * clock.period + reach + places.measurements.exposure_time
    low, high = offset_range(recorded, -reach, end, offsets)
    middle = 0.5 * (end - reach)
    found: list[tuple[float, Candidate, FittedClock]] = []
    timing = clock.timing(clock.high)
    count = max(1, math.ceil(math.log(clock.high / clock.low) / 0.1))  # Gauss-Newton converges over this step
    for direction in clock.directions:
        for index in range(count + 1):
            row_time = direction * clock.low * (clock.high / clock.low) ** (index / count)
            if index % 4 == 0:  # the offset of the middle row hardly depends on the row time
                offset, _ = best_offset(places.timed(row_time), recorded, low, high, timing)
                start = FittedClock(offset + middle, 1.0, (1.0, 1.0), (0.0, 0.0), middle)
            if found and any(abs(row_time - one.row_time) < 0.05 * abs(row_time) for _, one, _ in found):
                continue
            fitted = start
            for _ in range(3):  # weights against outliers
                measured = places.timed(row_time)
                weighted = measured.reweighted(residual_of_motion(measured, fitted.motion(recorded)))
                fitted, covariance, later = fit_clock(weighted, recorded, fitted, False, fit_gain, places.rows)
                row_time += later
            if not clock.allows(row_time):
                continue
            residual = residual_of_motion(places.timed(row_time), fitted.motion(recorded))
            independent = float(places.measurements.independent_fraction(residual)[0])
            std = (max(float(covariance[-1, -1]), 0.0) / independent) ** 0.5
            size = float(weighted.square(residual).sum()) / max(float(weighted.num_measurements.sum()), 1.0)
            found.append((size, Candidate(row_time, std, 0.0), fitted))
    if not found:
        return RowTimeFit(math.nan, math.nan, (), None, None, (Reason("recording_explains_nothing"),))
    found.sort(key=lambda one: one[0])
    size, best, fitted = found[0]
    known = float(places.measurements.num_measurements.sum())
    others = tuple(
        Candidate(one.row_time, one.std, known * (cost / size - 1.0))
        for cost, one, _ in found[1:]
        if known * (cost / size - 1.0) < MAX_CHI_SQUARE and abs(one.row_time - best.row_time) > 5 * (one.std + best.std)
    )
    measured = places.timed(best.row_time)
    _, other = best_offset(measured, recorded, low, high, timing)
    aligned = fitted.motion(recorded)
    rest, moved = measured.unexplained(residual_of_motion(measured, aligned))[0], rms_motion(measured, aligned)
    reasons = recording_reasons(moved.tolist(), rest.tolist(), other)
    return RowTimeFit(best.row_time, best.std, others, None, None, tuple(reasons))
