"""Spectrum of the displacement from the offsets of rows between frames: lines, and what remains without them.

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
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.fourier import fourier_sums
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
    good = curve.good & (curve.quality > 0)
    if curve.std is not None:
        good &= (torch.isfinite(curve.std) & (curve.std > 0)).all(-1)
    if int(good.sum()) < 8:
        raise ValueError(f"a spectrum needs at least 8 measured offsets, got {int(good.sum())}; use more frames")
    offsets, quality = table((curve.offsets - fitted)[good]), table(curve.quality[good])
    std = np.ones_like(offsets) if curve.std is None else table(curve.std[good])
    earlier, later = (table(times[good]) + 0.5 * timing.exposure_time for times in (curve.times, curve.later_times))
    centre = 0.5 * (earlier.min() + later.max())
    span = float(later.max() - earlier.min())
    # Rows of bands that overlap are averaged: above the rate of separate bands, their errors would be amplified.
    spacing = float(curve.rows.diff().median()) if len(curve.rows) > 1 else timing.frame_rows
    spacing = max(spacing, *curve.heights)
    step = 0.5 / span
    frequency = step * np.arange(2, max(math.floor(0.5 / (spacing * timing.row_time) / step), 8) + 1)
    found = []
    for axis in range(offsets.shape[-1]):
        height = curve.heights[axis % 2 if axis < 2 else 0]
        record = _Offsets(
            earlier - centre,
            later - centre,
            offsets[:, axis],
            quality / np.square(std[:, axis]),
            timing.exposure_time,
            height * timing.row_time,
        )
        found.append(record.spectrum(frequency, span, _lines_of(vibration, axis, centre)))
    amplitudes, noises, lines, responses = zip(*found, strict=True)
    # a frequency is blind if it is for any axis
    blind = np.any([response < _BLIND_GAIN * response.max() for response in responses], 0)
    return DisplacementSpectrum(
        tensor(frequency),
        tensor(np.where(blind, np.nan, np.stack(amplitudes))),
        tensor(np.where(blind, np.nan, np.stack(noises))),
        tensor(blind),
        _tones(lines, centre),
        1 / span,
    )


@dataclass(frozen=True, eq=False)
class _Offsets:
    """Offsets of one axis and their times, from which a spectrum is computed."""

    earlier: Array  # (N,) s, mid-exposures of the rows in the earlier frame, from the middle of the record
    later: Array  # (N,) s, those in the later frame
    values: Array  # (N,) px, displacement at ``later`` less that at ``earlier``, without the lines that are known
    weights: Array  # (N,) px^-2, inverse variances up to a factor
    exposure_time: float  # s
    band_time: float  # s, time over which the rows of one offset are exposed

    def spectrum(self, frequency: Array, span: float, known: Array) -> tuple[Array, Array, Array, Array]:
        """Amplitudes (F,), noise (F,), lines (L, 2) as frequency and complex amplitude, and the response (F,).

        ``frequency`` (F,) Hz has equal steps that begin at twice the step, ``span`` is the duration in s, and ``known``
        (K, 2) are lines that the values do not contain.
        """
        grid = float(frequency[1] - frequency[0]), 2, len(frequency)
        times = np.concatenate([self.later, self.earlier])[None, :, None]
        # Response of an offset to a displacement of each frequency, and its sum over the offsets.
        attenuation = self._attenuation(frequency)
        intervals = fourier_sums((self.later - self.earlier)[None, :, None], self.weights[None, :, None], grid)[0]
        energy = 2 * (self.weights.sum() - intervals.real)
        energy = np.maximum(energy, 1e-12 * energy.max())
        response = np.abs(attenuation) * np.sqrt(energy)
        visible, shown = (response >= gain * response.max() for gain in (_BLIND_GAIN, _SEARCHED_GAIN))
        searched = shown
        threshold = math.log(len(frequency) / 2 / _FALSE_ALARM)
        lines = np.zeros((0, 2), complex)
        while True:
            # The residual as a tone of each frequency; the mean and a drift are image motion.
            residual = self._without(lines)
            parts = self.weights * residual
            sums = fourier_sums(times, np.concatenate([parts, -parts])[None, :, None], grid)[0].conj()
            power = np.square(np.abs(sums)) / energy
            level = float(np.median(power[visible])) / math.log(2)  # the power of white noise is exponential
            excess = np.where(searched, power / max(level, 1e-300), 0.0)
            if excess.max() < threshold or len(lines) == _MAX_LINES:
                break
            # The line that is most significant, then all lines together. A line beside another one, or at a frequency
            # that the offsets do not show, is an error of the others.
            peak = frequency[excess.argmax()]
            refined = self._refined(np.concatenate([lines, [[peak, 0.0]]]), span)
            at = np.sort(refined[:, 0].real)
            if (np.diff(at) < 0.25 / span).any() or not np.interp(at, frequency, shown.astype(float)).all():
                searched = searched & (np.abs(frequency - peak) > 0.5 / span)
            else:
                lines = refined
        complex_amplitude = sums / (0.5 * np.where(visible, attenuation, np.inf) * energy)
        lines = np.concatenate([known, lines])
        # the width of a line is chosen so that the integral of its PSD is half of its squared amplitude
        places, sizes = (frequency - lines[:, :1].real) * span, lines[:, 1:]
        complex_amplitude = complex_amplitude + (sizes * np.exp(-0.5 * np.pi * np.square(places))).sum(0)
        noise = 2 * np.sqrt(level / energy) / np.maximum(np.abs(attenuation), 1e-12)
        return np.abs(complex_amplitude), noise, lines, response

    def _attenuation(self, frequency: Array) -> Array:
        """Displacement that an offset keeps of a tone: averages over the exposure and over the rows."""
        return np.sinc(frequency * self.exposure_time) * np.sinc(frequency * self.band_time)

    def _design(self, lines: Array) -> Array:
        """Derivatives (N, 3 L + 2) of the offsets by real part, imaginary part and frequency of lines, and by drift."""
        frequency, amplitude = lines[:, 0].real, lines[:, 1]
        waves = [unit_wave(2 * np.pi * frequency * times[:, None]) for times in (self.later, self.earlier)]
        factor = self._attenuation(frequency)
        offset = factor * (waves[0] - waves[1])
        slope = 2j * np.pi * factor * (self.later[:, None] * waves[0] - self.earlier[:, None] * waves[1]) * amplitude
        drift = [self.later - self.earlier, 0.5 * (np.square(self.later) - np.square(self.earlier))]
        return np.concatenate([offset.real, -offset.imag, slope.real, np.stack(drift, -1)], 1)

    def _solved(self, design: Array, count: int) -> Array:
        """Weighted least-squares parameters of a design of ``count`` lines; combinations that it hardly shows are 0."""
        root = np.sqrt(self.weights)[:, None]
        scale = np.linalg.norm(root * design, axis=0)
        # columns of one unit have one scale, so that a line without response is not enlarged
        for part in (slice(0, 2 * count), slice(2 * count, design.shape[1] - 2)):
            scale[part] = scale[part].max(initial=0.0)
        scale = np.maximum(scale, 1e-300)
        scaled = root * design / scale
        normal, right = scaled.T @ scaled, scaled.T @ (root[:, 0] * self.values)
        return np.linalg.lstsq(normal, right, rcond=1e-7)[0] / scale

    def _refined(self, lines: Array, span: float) -> Array:
        """Lines after three Gauss-Newton steps of all amplitudes and frequencies; the first sets new amplitudes."""
        count = len(lines)
        for _ in range(3):
            real, imaginary, shift = self._solved(self._design(lines), count)[: 3 * count].reshape(3, count)
            frequency = lines[:, 0].real + np.clip(shift, -0.25 / span, 0.25 / span)  # within the main lobe
            lines = np.stack([np.maximum(frequency, 0.5 / span), real + 1j * imaginary], -1)
        return lines

    def _without(self, lines: Array) -> Array:
        """Offsets (N,) without the lines and the drift."""
        design = self._design(lines)
        kept = np.r_[: 2 * len(lines), 3 * len(lines) : design.shape[1]]
        return self.values - design[:, kept] @ self._solved(design[:, kept], len(lines))


def _lines_of(vibration: Vibration, axis: int, centre: float) -> Array:
    """Lines (K, 2) of the tones of an axis, inverse of ``_tones``."""
    amplitude, frequency, phase = (
        table(values[axis]) for values in (vibration.amplitude, vibration.frequency, vibration.phase)
    )
    lines = np.stack([frequency, amplitude * unit_wave(phase - 0.5 * np.pi + 2 * np.pi * frequency * centre)], -1)
    return lines[amplitude > 0]


def _tones(lines: tuple[Array, ...], centre: float) -> Vibration:
    """Lines of each axis, complex amplitudes of ``exp(2 pi i f (t - centre))``, as a vibration."""
    values = np.zeros((3, len(lines), max(1, *map(len, lines))))
    for axis, of_axis in enumerate(lines):
        frequency, amplitude = of_axis[:, 0].real, of_axis[:, 1]
        # Re(C exp(i w t)) = |C| sin(w t + arg C + pi / 2)
        phase = np.angle(amplitude) + 0.5 * np.pi - 2 * np.pi * frequency * centre
        wrapped = np.mod(phase + np.pi, 2 * np.pi) - np.pi
        values[:, axis, : len(of_axis)] = np.abs(amplitude), frequency, wrapped
    amplitude_of_axes, frequency_of_axes, phase_of_axes = map(tensor, values)
    return Vibration(amplitude_of_axes, frequency_of_axes, phase_of_axes)
