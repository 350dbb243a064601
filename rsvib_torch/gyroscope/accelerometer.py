"""Comparison of a detected vibration with the record of an accelerometer, tone by tone."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from torch import Tensor

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.arrays import as_tensor
from rsvib_torch.checks.values import check_single
from rsvib_torch.detection.result import DetectionResult
from rsvib_torch.gyroscope.clock_range import offset_range
from rsvib_torch.numerics.tables import Array, table, tensor
from rsvib_torch.results.presentation import AXIS_NAMES, Result, check_pixel_size
from rsvib_torch.text import measured_text, text_table, wrapped

_LIMIT = 3.0  # standard deviations; of 100 tones that agree, 3 exceed it in one of three values
_AS_GOOD = 0.9  # of the largest correlation; clocks that differ by periods of the tones
_MOST_CLOCKS = 100  # that are tried; each takes 2 ms
# px; errors by aliasing repeat where a scene rests: 0.0014 px at 411 Hz in 8 to 200 frames, beside 0.8 px at 137 Hz
_REPEATED = 0.001

_Span = tuple[float, float]  # start and end of a record, or of its possible offsets, in s


class _Fit(NamedTuple):
    """Tones of the record at an offset of the clock, with standard deviations, from ``_tones_of``."""

    offset: float
    offset_std: float
    at: Array  # (N,) s, samples while the frames were taken, on the clock of the frames
    taken: Array  # (N, 2) m/s^2
    response: Array
    shift: Array
    response_std: Array
    shift_std: Array
    turn: Array  # (K,) rad
    turn_std: Array

    def misfit(self) -> Array:
        """Squared phases (K,) in standard deviations."""
        return np.square(self.turn / self.turn_std)


@dataclass(frozen=True, eq=False, repr=False)
class AccelerometerComparison(
    Result,
    units={
        **dict.fromkeys(("frequency", "difference", "difference_std"), "Hz"),
        **dict.fromkeys(("ratio", "ratio_std", "scale", "scale_std"), "m/px"),
        **dict.fromkeys(("phase", "phase_std"), "rad"),
        **dict.fromkeys(("times", "offset", "offset_std"), "s"),
        **dict.fromkeys(("measured", "predicted"), "m/s^2"),
    },
    shapes={
        **dict.fromkeys(("frequency", "difference", "difference_std", "ratio", "ratio_std", "phase", "phase_std"), "K"),
        **dict.fromkeys(("coherence", "agree"), "K"),
        **{"times": "N", "measured": "N 2", "predicted": "N 2"},
    },
):
    """Tones of a detection beside those of an accelerometer, from ``compare_accelerometer``.

    Attributes:
        axis: Name of the axis of each tone.
        frequency: (K,) Hz, of the tones of the reliable axes, as detected.
        difference: (K,) Hz, frequency of the accelerometer less that of the frames.
        difference_std: (K,) Hz, of both.
        ratio: (K,) m/px, amplitude of the displacement by the accelerometer over that in the frames.
        ratio_std: (K,) m/px, of both.
        phase: (K,) rad, phase by the accelerometer less that in the frames, on their common clock.
        phase_std: (K,) rad, of both.
        coherence: (K,) of the tones of the frames and the accelerometer while the frames were taken (Welch's method).
        agree: (K,) bool, frequency, ratio and phase are within 3 standard deviations.
        scale: m/px, that the ratios are compared with: the stated size of a pixel, or their mean.
        scale_std: m/px, of the mean; 0 if it was stated.
        offset: s, time of the accelerometer at the exposure start of the first row of frame 0.
        offset_std: s; 0 if it was stated, NaN if the phases agree at no offset at which the record covers the frames.
        other_offsets: s, others at which all phases agree as well, by the periods of the tones.
        times: (N,) s, samples of the accelerometer on the clock of the frames.
        measured: (N, 2) m/s^2 by the accelerometer, axes (x, y), without its mean.
        predicted: (N, 2) m/s^2 by the tones of the frames, with ``scale``.
    """

    axis: tuple[str, ...]
    frequency: Tensor
    difference: Tensor
    difference_std: Tensor
    ratio: Tensor
    ratio_std: Tensor
    phase: Tensor
    phase_std: Tensor
    coherence: Tensor
    agree: Tensor
    scale: float
    scale_std: float
    offset: float
    offset_std: float
    other_offsets: tuple[float, ...]
    times: Tensor
    measured: Tensor
    predicted: Tensor

    def summary(self) -> str:
        """A table of the tones, the clock, the scale, and whether both agree."""
        head = ["axis", "frequency (Hz)", "difference (Hz)", "ratio (µm/px)", "phase (rad)", "coherence", "agree"]
        rows = [
            [
                self.axis[tone],
                measured_text(self.frequency[tone]),
                measured_text(self.difference[tone], self.difference_std[tone]),
                measured_text(1e6 * self.ratio[tone], 1e6 * self.ratio_std[tone]),
                measured_text(self.phase[tone], self.phase_std[tone]),
                f"{float(self.coherence[tone]):.3f}",
                "yes" if self.agree[tone] else "no",
            ]
            for tone in range(len(self.axis))
        ]
        clock = (
            f"{measured_text(self.offset, self.offset_std)} s" if self.offset_std else f"{self.offset:.8g} s (stated)"
        )
        if np.isnan(self.offset_std):
            clock = (
                f"unknown: the phases agree at none at which the record covers the frames (best: {self.offset:.8g} s); "
                "use a record that covers them, with the same vibration"
            )
        elif self.other_offsets:
            clock += (
                f", or one of {len(self.other_offsets)} others from {min(self.other_offsets):.8g} to "
                f"{max(self.other_offsets):.8g} s, by the periods of the tones: state the offset to decide"
            )
        scale = measured_text(1e6 * self.scale, 1e6 * self.scale_std) if self.scale_std else f"{1e6 * self.scale:g}"
        lines = [text_table(head, rows), wrapped(f"time of the accelerometer at the start of frame 0: {clock}")]
        lines.append(f"1 px is {scale} µm{'' if self.scale_std else ' (stated)'}")
        count = int(self.agree.sum())
        verdict = f"{count} of {len(self.axis)} tones agree within 3 standard deviations"
        return "\n".join([*lines, verdict])


@checks_arguments
def compare_accelerometer(
    detection: DetectionResult,
    times: Tensor | NDArray[np.float64],
    acceleration: Tensor | NDArray[np.float64],
    *,
    pixel_size: float | None = None,
    offset: float | None = None,
    offsets: tuple[float, float] | None = None,
) -> AccelerometerComparison:
    """Compare the tones of a detection with an accelerometer on the object, or on the camera (with opposite signs).

    Args:
        detection: One detection; its reliable axes x and y are compared.
        times: (N,) s, evenly spaced samples on the clock of the accelerometer.
        acceleration: (N, 2) m/s^2 along x (right) and y (down) of the image.
        pixel_size: Size of a pixel on the object in m; by default the mean ratio of the tones.
        offset: Time of the accelerometer at the exposure start of the first row of frame 0, in s; by default that at
            which the record resembles the tones most.
        offsets: Smallest and largest offset to try.

    Raises:
        ValueError: If no axis is reliable, or the record is no table of finite values, does not cover the frames, is
            constant, or is too slow for a tone.
    """
    stamps, values = (
        table(as_tensor(name, of)).astype(float) for name, of in (("times", times), ("acceleration", acceleration))
    )
    if stamps.ndim != 1 or len(stamps) < 2 or values.shape != (len(stamps), 2):
        raise ValueError(f"times {stamps.shape} and acceleration {values.shape} must have the shapes (N,) and (N, 2)")
    if not (np.isfinite(stamps).all() and np.isfinite(values).all() and (np.diff(stamps) > 0).all()):
        raise ValueError("times and acceleration must be finite, and times must increase: remove the other samples")
    pixel_size = check_pixel_size(pixel_size)
    check_single("detection", detection)
    found, std = detection.vibration, detection.std
    places = [(a, k) for a, k in found.amplitude[:2].nonzero().tolist() if detection.reliable[a]]
    if not places:
        raise ValueError("no axis of the detection is reliable")
    axes = np.array([axis for axis, _ in places])
    amplitude, frequency, phase, amplitude_std, frequency_std, phase_std = (
        np.array([float(of[place]) for place in places])
        for of in (found.amplitude, found.frequency, found.phase, std.amplitude, std.frequency, std.phase)
    )
    step = float(np.median(np.diff(stamps)))
    if frequency.max() > 0.4 / step:
        raise ValueError(f"{1 / step:.5g} samples per second are too few for a tone of {frequency.max():.5g} Hz")
    # the phase of the frames is stated at time 0, its error in their middle is half of that
    amplitude_std, phase_std = np.hypot(amplitude_std, _REPEATED), np.hypot(0.5 * phase_std, _REPEATED / amplitude)
    curve = detection.offsets
    first, last = float(curve.times.min()), float(curve.later_times.max())
    values = values - values.mean(0)
    for axis in sorted(set(axes.tolist())):
        if np.ptp(values[:, axis]) == 0:
            raise ValueError(f"acceleration along {AXIS_NAMES[axis]} is constant: is the accelerometer connected?")
    # complex acceleration of each tone per px, and in px/s^2: its real part is the second derivative of A sin(wt + p)
    angular = 2 * np.pi * frequency
    known = 1j * amplitude * np.square(angular) * np.exp(1j * phase)

    # 1. Clock: the lags at which record and tones correlate, those by other periods of the tones included.
    limits = offsets if offset is None else (offset, offset)
    clock = offset_range(float(stamps[0]), float(stamps[-1]), first, last, limits)
    tried = [offset] if offset is not None else _resembling(stamps, values, axes, angular, known, (first, last), clock)

    # 2. Tones of the record while the frames were taken. The clock follows from their phases: that with the best ones.
    def fitted(start: float, rounds: int) -> _Fit:
        inside = (stamps - start >= first) & (stamps - start <= last)
        at, taken = stamps[inside] - start, values[inside]
        middle = 0.5 * (at[0] + at[-1])
        tones = _tones_of(at - middle, taken, axes, angular, known * np.exp(1j * angular * middle))
        turn = np.angle(tones[0]), np.hypot(tones[2] / np.abs(tones[0]), phase_std)
        weights = np.square(angular / turn[1])
        if rounds:
            return fitted(start - float((weights * turn[0] / angular).sum() / weights.sum()), rounds - 1)
        return _Fit(start, float(1 / np.sqrt(weights.sum())), at, taken, *tones, *turn)

    fits = sorted(
        (fitted(start, 0 if offset is not None else 2) for start in tried), key=lambda fit: fit.misfit().sum()
    )
    fit = fits[0]
    fitting = [one for one in fits if one.misfit().max() < _LIMIT**2]
    offset_std = 0.0 if offset is not None else fit.offset_std if fitting else np.nan
    # 3. Agreement with one clock and one scale.
    ratio = np.abs(fit.response)
    ratio_std = np.hypot(fit.response_std, ratio * amplitude_std / amplitude)
    weights = 1 / np.square(ratio_std)
    scale = float((weights * ratio).sum() / weights.sum()) if pixel_size is None else pixel_size
    scale_std = 0.0 if pixel_size is not None else float(1 / np.sqrt(weights.sum()))
    difference_std = np.hypot(fit.shift_std, frequency_std)
    wrong = np.stack([fit.shift / difference_std, (ratio - scale) / ratio_std, np.sqrt(fit.misfit())])
    predicted = _model(fit.at, axes, angular, scale * known)
    segment = max(len(fit.at) // 4, 8)
    bins, coherence = signal.coherence(predicted[:, axes], fit.taken[:, axes], 1 / step, nperseg=segment, axis=0)
    return AccelerometerComparison(
        axis=tuple(AXIS_NAMES[axis] for axis in axes),
        frequency=tensor(frequency),
        difference=tensor(fit.shift),
        difference_std=tensor(difference_std),
        ratio=tensor(ratio),
        ratio_std=tensor(ratio_std),
        phase=tensor(fit.turn),
        phase_std=tensor(fit.turn_std),
        coherence=tensor(coherence[np.abs(bins[:, None] - frequency).argmin(0), range(len(axes))]),
        agree=tensor(np.abs(wrong).max(0) < _LIMIT),
        scale=scale,
        scale_std=scale_std,
        offset=fit.offset,
        offset_std=offset_std,
        other_offsets=tuple(one.offset for one in fitting if one is not fit),
        times=tensor(fit.at),
        measured=tensor(fit.taken),
        predicted=tensor(predicted),
    )


def _model(times: Array, axes: Array, angular: Array, known: Array) -> Array:
    """Acceleration (N, 2) of tones with complex amplitudes at times."""
    waves = (known * np.exp(1j * times[:, None] * angular)).real
    return np.stack([waves[:, axes == axis].sum(1) for axis in (0, 1)], 1)


def _resembling(
    stamps: Array, values: Array, axes: Array, angular: Array, known: Array, frames: _Span, clock: _Span
) -> list[float]:
    """Offsets of the clock, within limits, at which a record correlates with tones, the best one first."""
    step = float(np.median(np.diff(stamps)))
    model = _model(np.arange(*frames, step), axes, angular, known)
    # each axis by its own size, so that none outweighs the other
    used = sorted(set(axes.tolist()))
    sums = [
        signal.correlate(values[:, a], model[:, a], "valid") / (values[:, a].std() * model[:, a].std()) for a in used
    ]
    lags = stamps[0] - frames[0] + step * np.arange(len(sums[0]))
    total = np.where((lags >= clock[0] - step) & (lags <= clock[1] + step), np.sum(sums, 0), -np.inf)
    peaks = signal.find_peaks(np.pad(total, 1, constant_values=-np.inf), height=_AS_GOOD * total.max())[0] - 1
    return [float(lags[peak]) for peak in peaks[np.argsort(-total[peaks])][:_MOST_CLOCKS]]


def _tones_of(
    times: Array, values: Array, axes: Array, angular: Array, known: Array
) -> tuple[Array, Array, Array, Array]:
    """Complex responses of the record to tones, and shifts of their frequencies in Hz, with standard deviations.

    Each axis is fitted by its tones, whose phases may drift linearly: a response is that in the middle of the record.
    """
    response, shift, response_std, shift_std = (np.zeros(len(axes), kind) for kind in (complex, float, float, float))
    for axis in set(axes.tolist()):
        of = np.flatnonzero(axes == axis)
        waves = known[of] * np.exp(1j * times[:, None] * angular[of])
        design = np.concatenate([waves.real, -waves.imag, times[:, None] * waves.real, -times[:, None] * waves.imag], 1)
        solution, _, _, _ = np.linalg.lstsq(design, values[:, axis], rcond=None)
        residual = values[:, axis] - design @ solution
        variance = residual @ residual / max(len(times) - design.shape[1], 1)
        errors = np.sqrt(variance * np.diag(np.linalg.pinv(design.T @ design))).reshape(4, -1)
        real, imaginary, growth, drift = solution.reshape(4, -1)
        response[of] = real + 1j * imaginary
        response_std[of] = np.hypot(errors[0], errors[1]) / np.sqrt(2)
        # the drift of the phase is that of the imaginary part of (growth + i drift) / response
        shift[of] = ((growth + 1j * drift) / response[of]).imag / (2 * np.pi)
        shift_std[of] = errors[3] / np.abs(response[of]) / (2 * np.pi)
    return response, shift, response_std, shift_std
