"""Row time as a further parameter of the fit of tones to displacements of rows.

The exposure of row r of frame g starts at ``g P + r T_row``. Displacements of rows that were measured in the frames do
not depend on the row time; the times that belong to them do.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import dataclass, replace

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit, fit_tones, motion_of_fit
from rsvib_torch.detection.tones.uncertainty import linearised
from rsvib_torch.numerics.tables import Array, table, tensor
from rsvib_torch.row_time.row_tones import RowRecord


@dataclass(frozen=True, eq=False)
class FramePlaces:
    """Frame rows and frames of measurements of one stack, from which their times follow for any row time."""

    measurements: Measurements  # the displacements (B = 1); their times are replaced
    rows: Array  # (1, N, G) frame rows
    frames: Array  # (1, N, G) indices of the frames
    period: float  # frame period in s

    def timed(self, row_time: float) -> Measurements:
        """The measurements with the times of a row time in s."""
        return replace(self.measurements, exposure_starts=self.frames * self.period + self.rows * row_time)

    def of_first_frames(self, count: int) -> "FramePlaces":
        """The rows that were measured in the first frames only."""
        rows = (self.frames[0] - self.frames.min()).max(-1) < max(count, 1 + np.ptp(self.frames[0, 0]))
        measured = self.measurements.of_rows(slice(0, int(rows.argmin()) or None))
        number = measured.visible.shape[1]
        return FramePlaces(measured, self.rows[:, :number], self.frames[:, :number], self.period)

    def of_axis(self, axis: int, num_rows: int, row_time: float) -> RowRecord:
        """The displacements along one axis, for tones of independent frequencies."""
        measured = self.measurements
        return RowRecord(
            self.rows[0] - 0.5 * (num_rows - 1),
            self.frames[0] - 0.5 * (self.frames.min() + self.frames.max()),
            measured.displacements[0, ..., axis],
            measured.visible[0],
            measured.inverse_variances[0, :, axis],
            float(np.squeeze(measured.independent)),
            row_time / self.period,
        )


def rows_of_frames(measured: Measurements, period: float, row_time: float, num_rows: int) -> FramePlaces:
    """Frame rows of measurements of one stack that were timed with a row time in s."""
    blank = 0.5 * (period - num_rows * row_time)  # rows up to half of the blanking outside of a frame are its rows
    frames = np.floor((measured.exposure_starts + blank) / period)
    return FramePlaces(measured, (measured.exposure_starts - frames * period) / row_time, frames, period)


def fit_row_time(places: FramePlaces, row_time: float, fit: ToneFit) -> tuple[float, float, ToneFit]:
    """Row time in s, its standard deviation, and the tones, by Gauss-Newton with all tones fitted in every step."""
    std, exposure = 0.0, places.measurements.exposure_time
    for _ in range(12):
        measured = places.timed(row_time)
        fit = fit_tones(measured, fit.frequencies, fit.active, fit.model)
        # derivatives of the displacements by the row time: velocity times row
        motion, starts = motion_of_fit(fit), tensor(measured.exposure_starts)
        velocity = (motion.displacement(starts + exposure) - motion.displacement(starts)) / exposure
        by_row_time = measured.relative(table(velocity) * places.rows[..., None])[..., None]
        # the part of the change by the row time that no change of the tones cancels
        information = step = 0.0
        for axis, problem in linearised(measured, fit):
            unexplained = problem.unexplained(by_row_time[:, :, :, axis], axis)[0][0, :, 0]
            information += float(np.square(unexplained).sum())
            step += float(unexplained @ problem.residual[0])
        information = max(information, 1e-300)
        std, step = information**-0.5, step / information
        row_time = row_time + min(max(step, -0.02 * row_time), 0.02 * row_time)
        if abs(step) < 1e-2 * std:
            break
    measured = places.timed(row_time)
    return row_time, std, fit_tones(measured, fit.frequencies, fit.active, fit.model)
