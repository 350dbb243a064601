"""Row time as a further parameter of the fit of tones to displacements of rows.

The exposure of row r of frame g starts at ``g P + r T_row``. Displacements of rows that were measured in the frames do
not depend on the row time; the times that belong to them do.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import dataclass, replace

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit, axis_jacobian, fit_tones, motion_of_fit, residual_of
from rsvib_torch.motion.motion import Motion
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
        frames = self.frames[0] - 0.5 * (self.frames.min() + self.frames.max())
        return RowRecord(
            self.rows[0] - 0.5 * (num_rows - 1),
            frames,
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


def row_time_columns(measured: Measurements, rows: Array, motion: Motion) -> Array:
    """Derivatives (1, N, G, 2) of the relative displacements by the row time: velocity times row."""
    starts, exposure = tensor(measured.exposure_starts), measured.exposure_time
    velocity = (motion.displacement(starts + exposure) - motion.displacement(starts)) / exposure
    return measured.relative(table(velocity) * rows[..., None])


def fit_row_time(
    places: FramePlaces, row_time: float, fit: ToneFit, *, iterations: int = 12
) -> tuple[float, float, ToneFit]:
    """Gauss-Newton on the row time, with all tones fitted again in every step.

    The measurements have the weights of a robust fit. The result is the row time in s, its standard deviation, and the
    tones.
    """
    std = 0.0
    for _ in range(iterations):
        measured = places.timed(row_time)
        fit = fit_tones(measured, fit.frequencies, fit.active, fit.model)
        residual = residual_of(measured, fit)
        free = fit.active.sum(-1) * 3 + fit.drift.shape[-1]
        variance = measured.square(residual) / np.maximum(measured.num_measurements - free - 0.5, 1.0)
        weighted = measured.scaled(1 / np.maximum(variance, 1e-300))
        tones = [axis_jacobian(measured, fit, axis)[0][0] for axis in range(2)]  # (N, G, M)
        zero = np.zeros_like(tones[0])
        columns = np.concatenate(
            [
                np.stack([tones[0], zero], 2),
                np.stack([zero, tones[1]], 2),
                row_time_columns(measured, places.rows, motion_of_fit(fit))[0, ..., None],
            ],
            -1,
        )  # (N, G, 2, P)
        of_information = np.einsum("nac,ngcq->ngaq", weighted.information[0], columns)
        gram = np.einsum("ngap,ngaq->pq", columns, of_information)
        right = np.einsum("ngap,nga->p", of_information, residual[0])
        scale = 1 / np.sqrt(np.where(gram.diagonal() > 0, gram.diagonal(), 1.0))
        eye = np.diag(1e-13 + (gram.diagonal() <= 0))
        inverse = np.linalg.inv(gram * scale * scale[:, None] + eye) * scale * scale[:, None]
        step = float((inverse @ right)[-1])
        std = (max(float(inverse[-1, -1]), 0.0) / float(np.squeeze(measured.independent))) ** 0.5
        row_time = row_time + min(max(step, -0.02 * row_time), 0.02 * row_time)
        if abs(step) < 1e-2 * std:
            break
    measured = places.timed(row_time)
    return row_time, std, fit_tones(measured, fit.frequencies, fit.active, fit.model)
