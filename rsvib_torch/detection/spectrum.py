"""Spectrum of the displacement from the offsets of rows between frames: lines, and the residual without them.

Rows are measured while a frame is read out, with gaps between the frames. A Fourier transform of such a record shows
every line again at multiples of the frame rate beside it, as large as the gap is long. Lines are therefore fitted to
the offsets and subtracted one after another (CLEAN, Hogbom 1974), and drawn into the spectrum of the residual with the
width of the resolution.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.values import check_single
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit, fit_roughly, motion_of_fit
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.interpolation import fourier_sums
from rsvib_torch.numerics.tables import Array, table, tensor, unit_wave
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.results.presentation import AXIS_NAMES, Result, check_pixel_size, plain_values
from rsvib_torch.text import measured_text, text_table

_BLIND_GAIN = 0.1  # of the largest response; noise is amplified tenfold, and errors of the timing as well
_SEARCHED_GAIN = 0.01  # a line in a blind band has ghosts outside, one frame rate away, if it is not subtracted
_MAX_LINES = 20  # per axis; the joint fit of 20 lines to 27,000 offsets takes 2 s
_FALSE_ALARM = 1e-3  # probability that noise alone has a line
SMALLEST_SHOWN = 0.01  # of the strongest line of an axis; smaller ones are near the errors of the registration
_UNITS = ("px", "px", "rad", "relative")


@dataclass(frozen=True, eq=False, repr=False)
class DisplacementSpectrum(
    Result,
    units={
        "frequency": "Hz",
        **dict.fromkeys(("amplitude", "noise"), "px; of roll rad, of zoom 1"),
        "resolution": "Hz",
    },
    shapes={"frequency": "F", "blind": "F", "amplitude": "A F", "noise": "A F"},
):
    """Amplitude spectrum and power spectral density (PSD) of the displacement, from ``DetectionResult.spectrum``.

    A line of amplitude A has a peak of A in ``amplitude``. The PSD is ``amplitude^2 / (2 resolution)``, in px^2/Hz; its
    integral over a line is A^2 / 2.

    Attributes:
        frequency: (F,) Hz, in steps of half the resolution, up to half of the rate at which rows are measured (one
            value for every 8 rows in the direct method).
        amplitude: (A, F) px (roll rad, zoom relative); NaN where the frames are blind.
        noise: (A, F), the rms amplitude that the noise of the rows alone has.
        blind: (F,) bool, where the response of the offsets is below a tenth of its maximum: near multiples of the frame
            rate, at which all frames are displaced alike, and of 1 / exposure time.
        lines: The tones of the detection, and lines that were found besides; the time origin is that of the detection.
            Rows are measured around the motion of the detection, and what it does not contain has errors of up to 13 %
            (lines of 0.1 px beside a tone of 0.8 px, 5 simulated stacks).
        resolution: Hz, the inverse of the duration of the record.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames(num_frames=4)
        >>> spectrum = rsv.detect_vibration(frames, timing).spectrum()
        >>> spectrum.lines.frequency[:, 0].round().tolist()  # Hz
        [110.0, 90.0]
    """

    frequency: Tensor
    amplitude: Tensor
    noise: Tensor
    blind: Tensor
    lines: Vibration
    resolution: float

    @property
    def psd(self) -> Tensor:
        """(A, F) power spectral density in px^2/Hz."""
        return self.amplitude.square() / (2 * self.resolution)

    @property
    def noise_psd(self) -> Tensor:
        """(A, F) power spectral density of the noise in px^2/Hz."""
        return self.noise.square() / (2 * self.resolution)

    def summary(self) -> str:
        """The lines of each axis above 1 % of its strongest one, and the median noise outside blind bands."""
        amplitude, frequency = self.lines.amplitude, self.lines.frequency
        rows = [
            [AXIS_NAMES[axis], measured_text(amplitude[axis, line]), measured_text(frequency[axis, line])]
            for axis, line in (amplitude > SMALLEST_SHOWN * amplitude.amax(-1, keepdim=True)).nonzero().tolist()
        ]
        noise = ", ".join(
            f"{name} {measured_text(values[~self.blind].nanmedian(), digits=2)}"
            for name, values in zip(AXIS_NAMES, self.noise, strict=False)
        )
        first, last = float(self.frequency[0]), float(self.frequency[-1])
        limits = f"{first:.4g} … {last:.5g} Hz, resolution {self.resolution:.3g} Hz"
        lines = text_table(["axis", "line (px)", "frequency (Hz)"], rows)
        return "\n".join([limits, lines, f"noise (px rms): {noise}"])

    def table(self, *, pixel_size: float | None = None) -> dict[str, list[object]]:
        """One row per frequency; arguments as in ``Result.table``."""
        pixel_size = check_pixel_size(pixel_size)
        columns = {"frequency_Hz": self.frequency, "blind": self.blind}
        for axis, name, unit in zip(range(len(self.amplitude)), AXIS_NAMES, _UNITS, strict=False):
            columns |= {
                f"amplitude_{name}_{unit}": self.amplitude[axis],
                f"noise_{name}_{unit}": self.noise[axis],
                f"psd_{name}_{unit}2_per_Hz": self.psd[axis],
                f"noise_psd_{name}_{unit}2_per_Hz": self.noise_psd[axis],
            }
            if pixel_size is not None and axis < 2:
                metres, angular = pixel_size * self.amplitude[axis], 2 * math.pi * self.frequency
                columns |= {
                    f"amplitude_{name}_um": 1e6 * metres,
                    f"psd_{name}_um2_per_Hz": (1e6 * pixel_size) ** 2 * self.psd[axis],
                    f"velocity_{name}_um_per_s": 1e6 * angular * metres,
                    f"acceleration_{name}_m_per_s2": angular.square() * metres,
                    f"acceleration_psd_{name}_m2_per_s4_Hz": angular**4 * pixel_size**2 * self.psd[axis],
                }
        return {name: plain_values(values) for name, values in columns.items()}


def displacement_spectrum(
    curve: OffsetCurve, timing: SensorTiming, vibration: Vibration, fitted: Tensor
) -> DisplacementSpectrum:
    """The spectrum of the displacement from offsets of one stack, ``fitted`` (P, N, A) by a known vibration."""
    check_single("result", curve.batch_shape)
    mask = curve.good & (curve.quality > 0)
    if curve.std is not None:
        mask &= (torch.isfinite(curve.std) & (curve.std > 0)).all(-1)
    if int(mask.sum()) < 8:
        raise ValueError(f"a spectrum needs at least 8 measured offsets, got {int(mask.sum())}; use more frames")
    measurements = _measurements(curve, mask, fitted, timing)
    # Rows of bands that overlap are averaged: above the rate of separate bands, their errors would be amplified.
    spacing = float(curve.rows.diff().median()) if len(curve.rows) > 1 else timing.frame_rows
    spacing = max(spacing, *curve.heights)
    step = 0.5 / float(measurements.span[0])
    frequency = step * np.arange(2, max(math.floor(0.5 / (spacing * timing.row_time) / step), 8) + 1)
    spectra = [
        _spectrum(measurements.of_axis(axis), frequency, _lines_of(vibration, axis, measurements.centre))
        for axis in range(measurements.displacements.shape[-1])
    ]
    amplitudes, noises, lines, responses = zip(*spectra, strict=True)
    # a frequency that is blind on one axis counts as blind
    blind = np.any([response < _BLIND_GAIN * response.max() for response in responses], 0)
    return DisplacementSpectrum(
        tensor(frequency),
        tensor(np.where(blind, np.nan, np.stack(amplitudes))),
        tensor(np.where(blind, np.nan, np.stack(noises))),
        tensor(blind),
        motion_of_fit(_fit_of_lines(lines, measurements.centre))[0],
        2 * step,
    )


def _measurements(curve: OffsetCurve, mask: Tensor, fitted: Tensor, timing: SensorTiming) -> Measurements:
    """The offsets of one stack in a mask, less the ``fitted`` ones, weighted by their quality and variance."""
    offsets, quality = table((curve.offsets - fitted)[mask]), table(curve.quality[mask])
    std = np.ones_like(offsets) if curve.std is None else table(curve.std[mask])
    starts = np.stack([table(times[mask]) for times in (curve.times, curve.later_times)], -1)
    weights = quality[:, None] / np.square(std)
    return Measurements(
        starts[None],
        np.stack([-0.5 * offsets, 0.5 * offsets], 1)[None],
        visible=np.ones((1, *starts.shape)),
        information=(weights[..., None] * np.eye(weights.shape[-1]))[None],
        exposure_time=timing.exposure_time,
        average_times=(curve.heights[0] * timing.row_time, curve.heights[1] * timing.row_time),
    )


def _spectrum(measured: Measurements, frequency: Array, known_lines: Array) -> tuple[Array, Array, Array, Array]:
    """Amplitudes (F,), noise (F,), lines (L, 2) as frequency and complex amplitude, and the response (F,), of an axis.

    ``frequency`` (F,) Hz has equal steps and begins at twice the step. ``known_lines`` (K, 2) were already subtracted
    from the displacements.
    """
    span, grid = float(measured.span[0]), (float(frequency[1] - frequency[0]), 2, len(frequency))
    times, weights = measured.middles[..., 0, 0], measured.weights[..., 0]  # (1, N, 2), (1, N)
    # Response of an offset to a displacement of each frequency, and its sum over the offsets.
    attenuation = np.sinc(frequency * measured.smearing_times[:, 0]).prod(0)[0]
    energy = 2 * (weights.sum() - fourier_sums(np.diff(times), weights[..., None], grid)[0].real)
    energy = np.maximum(energy, 1e-12 * energy.max())
    response = np.abs(attenuation) * np.sqrt(energy)
    visible, shown = (response >= gain * response.max() for gain in (_BLIND_GAIN, _SEARCHED_GAIN))
    searched = shown
    threshold = math.log(len(frequency) / 2 / _FALSE_ALARM)
    fit, residual = _fitted(measured, np.zeros(0))
    while True:
        # The residual as a tone of each frequency; the mean and a drift are image motion.
        sums = fourier_sums(times, 2 * weights[..., None] * residual[..., 0], grid)[0].conj()
        power = np.square(np.abs(sums)) / energy
        level = float(np.median(power[visible])) / math.log(2)  # the power of white noise is exponential
        excess = np.where(searched, power / max(level, 1e-300), 0.0)
        if excess.max() < threshold or fit.active.shape[-1] == _MAX_LINES:
            break
        # The most significant line is added, and all lines are fitted together. A line beside another one, or at a
        # frequency that the offsets do not show, is an error of the other lines.
        peak = frequency[excess.argmax()]
        trial, trial_residual = _fitted(measured, np.append(fit.frequencies, peak))
        peaks = np.sort(trial.frequencies[0, 0])
        if (np.diff(peaks) < 0.25 / span).any() or not np.interp(peaks, frequency, shown.astype(float)).all():
            searched = searched & (np.abs(frequency - peak) > 0.5 / span)
        else:
            fit, residual = trial, trial_residual
    complex_amplitude = sums / (0.5 * np.where(visible, attenuation, np.inf) * energy)
    lines = np.concatenate([known_lines, np.stack([fit.frequencies[0, 0], fit.coefficients[0, 0]], -1)])
    # the width of a line is chosen so that the integral of its PSD is half of its squared amplitude
    places, sizes = (frequency - lines[:, :1].real) * span, lines[:, 1:]
    complex_amplitude = complex_amplitude + (sizes * np.exp(-0.5 * np.pi * np.square(places))).sum(0)
    noise = 2 * np.sqrt(level / energy) / np.maximum(np.abs(attenuation), 1e-12)
    # Errors of the registration are lines of any size in a blind band: the offsets must also show these.
    gain = np.interp(lines[:, 0].real, frequency, response / response.max())
    offset = np.abs(lines[:, 1]) * gain
    listed = (gain >= _BLIND_GAIN) | (offset >= SMALLEST_SHOWN * offset.max(initial=0.0))
    listed[: len(known_lines)] = True
    return np.abs(complex_amplitude), noise, lines[listed], response


def _fitted(measured: Measurements, frequencies: Array) -> tuple[ToneFit, Array]:
    """The lines of an axis, fitted from frequencies (L,), and the residual displacements."""
    start = frequencies[None, None]
    return fit_roughly(measured, start, np.ones_like(start, dtype=bool), drift_order=2, iterations=3)


def _lines_of(vibration: Vibration, axis: int, centre: Array) -> Array:
    """Lines (K, 2) of the tones of an axis, complex amplitudes of ``exp(2 pi i f (t - centre))``."""
    amplitude, frequency, phase = (
        table(values[axis]) for values in (vibration.amplitude, vibration.frequency, vibration.phase)
    )
    lines = np.stack([frequency, amplitude * unit_wave(phase - 0.5 * np.pi + 2 * np.pi * frequency * centre)], -1)
    return lines[amplitude > 0]


def _fit_of_lines(lines: tuple[Array, ...], centre: Array) -> ToneFit:
    """Lines of each axis as a fit, inverse of ``_lines_of``."""
    values = np.zeros((2, 1, len(lines), max(1, *map(len, lines))), complex)
    for axis, axis_lines in enumerate(lines):
        values[:, 0, axis, : len(axis_lines)] = axis_lines.T
    frequencies, coefficients = values
    drift, covariance = np.zeros((1, len(lines), 1)), np.zeros((1, 0, 0))
    return ToneFit(coefficients, frequencies.real, coefficients != 0, drift, covariance, centre)
