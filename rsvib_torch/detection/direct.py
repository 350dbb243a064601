"""Detection at the limit: measure around the model, fit, repeat."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.inversion import vibration_of_fit
from rsvib_torch.detection.selection import find_tones, reweighted
from rsvib_torch.detection.tones import Measurements, ToneFit, fit_tones, model_offsets
from rsvib_torch.imaging.coupling import rows_showing
from rsvib_torch.registration.gradients import RowSpectra, remaining_offsets
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration

__all__ = ["refine_directly"]

_LAGS = 12  # rows over which residuals may be correlated


def measure_rows(spectra: RowSpectra, timing: SensorTiming, motion: Vibration, num_frames: int) -> Measurements:
    """Offsets of every scene row between consecutive frames, measured around a motion.

    The motion's own offset is added to what remains, so that the measurements do not depend on it to first order.
    """
    height = spectra.values.shape[-2]
    device = spectra.values.device
    frame_starts = timing.frame_starts(num_frames, device)
    scene_rows = torch.arange(height, dtype=torch.float64, device=device)
    parts: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for pair in range(num_frames - 1):  # one pair at a time bounds the memory
        # whole pixels of an image motion move the scene rows and columns that this pair sees
        middle = frame_starts[pair] + 0.5 * (height * timing.row_time + frame_starts[pair + 1] - frame_starts[pair])
        travelled = (motion.image_motion * middle).round()
        seen = scene_rows - travelled[:, 1:]
        moments, rows, displacements = [], [], []
        for frame in (pair, pair + 1):
            place = rows_showing(seen, frame_starts[frame], timing, motion)
            start = frame_starts[frame] + place * timing.row_time
            rows.append(place)
            moments.append(start)
            displacements.append(motion.mean_displacement(start, timing.exposure_time))
        shifts = tuple(d[..., 0] - travelled[:, :1] for d in displacements)
        remaining, information = remaining_offsets(
            spectra, (pair, pair + 1), (rows[0], rows[1]), (shifts[0], shifts[1])
        )
        parts.append((moments[0], moments[1], displacements[1] - displacements[0] + remaining, information))
    starts, later, offsets, information = (torch.cat([part[i] for part in parts], dim=1) for i in range(4))
    typical = information.diagonal(dim1=-2, dim2=-1).mean(dim=(1, 2))[:, None, None, None].clamp(min=1e-300)
    return Measurements(starts, later, offsets, information / typical, timing.exposure_time, (0.0, 0.0))


def independent_fraction(measurements: Measurements, residual: Tensor) -> float:
    """Fraction of rows that are independent, from the correlation of neighbouring residuals.

    Rows were smoothed together, so that the residuals of neighbours are alike; the variance of a mean is larger by
    ``1 + 2 sum rho(k)``.
    """
    scaled = residual * measurements.weights.sqrt()
    energy = scaled.square().sum()
    total = sum(float((scaled[:, lag:] * scaled[:, :-lag]).sum() / energy) for lag in range(1, _LAGS + 1))
    return 1.0 / max(1.0, 1.0 + 2.0 * total)


def refine_directly(
    frames: Tensor, timing: SensorTiming, start: Vibration, tones: int | None, iterations: int = 4
) -> tuple[Measurements, ToneFit]:
    """Refine a detected motion on the images themselves.

    Both frames of a pair are warped to the scene with the motion, every row tells its remaining offset and how well it
    knows it, and the motion is fitted again to those rows; image work and motion model meet only here.

    Args:
        frames: (B, T, H, W) grey, in row order.
        timing: The sensor, in row order.
        start: The motion to start with (a batch), from the band offsets.
        tones: Number of tones of each axis; None to choose it from the rows.
        iterations: Rounds of measuring and fitting.

    Returns:
        The last measurements and the fit to them.
    """
    spectra = RowSpectra(frames)
    motion = start
    interval = max(timing.row_time, 0.5 * timing.exposure_time)  # tones above 1 / T_e are averaged out anyway
    for step in range(iterations):
        measurements = measure_rows(spectra, timing, motion, frames.shape[1])
        active = motion.amplitude > 0
        if step == 1:
            # the first round removed the error of the bands: now weak tones show, and must stand above noise that
            # neighbouring rows share
            known = fit_tones(measurements, motion.frequency, active)
            residual = measurements.offsets - model_offsets(measurements, known)
            measurements = replace(measurements, independent=independent_fraction(measurements, residual))
            fit = find_tones(measurements, interval, tones, group=max(1, round(interval / timing.row_time)))
        else:
            fit = fit_tones(measurements, motion.frequency, active)
            fit = fit_tones(
                reweighted(measurements, measurements.offsets - model_offsets(measurements, fit)),
                fit.frequencies,
                active,
            )
        motion, _ = vibration_of_fit(measurements, fit)
    residual = measurements.offsets - model_offsets(measurements, fit)
    weighed = reweighted(measurements, residual)
    honest = replace(weighed, independent=independent_fraction(weighed, residual))
    return honest, fit_tones(honest, motion.frequency, motion.amplitude > 0)
