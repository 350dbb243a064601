"""Tones of the vibration of a camera in a window of frames, whose amplitude and phase change slowly."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.numerics.interpolation import spline_taps
from rsvib_torch.numerics.tables import Array

# turns, by which the phase of a tone drifts over a window without noise: frequencies of 48 tones in H.264 were wrong by
# 0.003 to 0.005 Hz, 2 to 4 standard deviations of noise
_DRIFT = 0.012

Averaged = tuple[float, float]  # s, the exposure, and the time in which the rows of the patch of a corner are read


@dataclass(frozen=True, eq=False)
class Tone:
    """A tone of one axis of the vibration around a time."""

    axis: int  # 0: x, 1: y
    frequency: float  # Hz
    coefficient: complex  # px; the displacement is Re c exp(2 pi i f t)
    amplitude_std: float  # px
    frequency_std: float  # Hz


@dataclass(eq=False)
class WindowTone:
    """A tone of one axis in a window, whose amplitude and phase change slowly; times count from its middle."""

    axis: int  # 0: x, 1: y
    frequency: float  # Hz
    # (M,) px, coefficients of a spline c(t); the displacement is Re c(t) exp(2 pi i f t)
    knots: NDArray[np.complex128]
    start: float  # s, of the first knot
    step: float  # s, between knots
    slope: float = 0.0  # Hz/s, by which the frequency changes
    amplitude_std: float = math.inf  # px
    frequency_std: float = math.inf  # Hz
    left_in_third: float = 0.0  # largest part of the tone that is left in a third of the rows or columns
    jump: float = 0.0  # rad, largest significant change of its phase from a frame to the next one that is not followed

    @property
    def size(self) -> float:
        """Mean amplitude (rms) in px."""
        return math.sqrt(np.square(np.abs(self.knots)).mean())

    def bend(self, part: slice = slice(None)) -> float:
        """What the spline does not follow near some of the knots, in px."""
        return 0.25 * float(np.abs(np.diff(self.knots[part], 2)).max())

    def at(self, time: float, origin: float, weight: float = 1.0) -> Tone:
        """The tone as it is at a time in s, with the time origin of its phase, multiplied by a weight."""
        index, factors = spline_taps(np.array([time]), self.start, self.step, len(self.knots))
        frequency = self.frequency + self.slope * time
        turns = frequency * origin - 0.5 * self.slope * time**2
        turned = (factors * self.knots[index]).sum() * np.exp(2j * math.pi * turns)
        if frequency < 0:  # a tone that has swept through 0 Hz; Re c exp(i a) = Re c* exp(-i a)
            frequency, turned = -frequency, turned.conjugate()
        # What a spline does not follow: behind a blow that decays with 0.1 s, amplitudes were wrong by 6 to 20 std.
        bent = self.bend(slice(index.min(), index.max() + 1))
        bent = math.sqrt(max(bent**2 - 0.375 * min(self.amplitude_std, 1e9) ** 2, 0.0))  # without that of noise
        size_std = math.hypot(self.amplitude_std, bent)
        phase = bent / max(abs(turned), bent, 1e-30)
        rate_std = math.hypot(self.frequency_std, phase / (2 * math.pi * self.step * (len(self.knots) - 3)))
        return Tone(self.axis, frequency, complex(weight * turned), weight * size_std, rate_std)

    def waves(self, times: Array, averaged: Averaged | tuple[()]) -> NDArray[np.complex128]:
        """Values at times, averaged over the exposure and the patch of a corner, of an amplitude of 1."""
        frequency = self.frequency + self.slope * times if self.slope else np.array(self.frequency)
        attenuation = np.prod([np.sinc(frequency * seconds) for seconds in averaged], 0)
        return np.asarray(attenuation * np.exp(1j * math.pi * (self.frequency + frequency) * times))

    def correct_frequency(self, limit: float) -> None:
        """Change the frequency, by at most ``limit`` in Hz, so that the phase of the knots stays the same.

        That of a tone that sweeps changes by as much at the ends of the window, in opposite directions.
        """
        turned = self.knots[1:] * self.knots[:-1].conj()
        mean = turned.sum()  # weighted by size
        times = self.start + self.step * (np.arange(len(self.knots)) - 1)
        middles = 0.5 * (times[1:] + times[:-1])
        change = float(np.clip(np.angle(mean) / (2 * math.pi * self.step), -limit, limit))
        slope = 0.0
        if self.slope:
            weight = np.abs(turned)
            bent = (weight * middles) @ np.angle(turned * np.conj(mean)) / (2 * math.pi * self.step)
            slope = float(np.clip(bent / max(weight @ middles**2, 1e-30), -limit / middles[-1], limit / middles[-1]))
        self.frequency, self.slope = self.frequency + change, self.slope + slope
        self.knots = self.knots * np.exp(-1j * math.pi * (2 * change + slope * times) * times)

    def set_std(self, covariance: Array) -> None:
        """Standard deviations, from the covariance (2 M, 2 M) of the real and the imaginary parts of the knots."""
        count = len(self.knots)
        variance = covariance.diagonal()
        self.amplitude_std = math.sqrt(max(np.median(variance[:count]), np.median(variance[count:])))
        weight = np.square(np.abs(self.knots))
        times = self.step * np.arange(count)
        times -= weight @ times / max(float(weight.sum()), 1e-30)
        spread = float(weight @ np.square(times))
        # The slope of the phase is sum(|c|^2 t phi) / sum(|c|^2 t^2), and phi changes by Im(dc / c).
        gradient = np.concatenate([-times * self.knots.imag, times * self.knots.real])
        noise = math.sqrt(max(gradient @ covariance @ gradient, 0.0)) / (2 * math.pi * max(spread, 1e-30))
        self.frequency_std = math.hypot(noise, _DRIFT / (self.step * (count - 3)))


def wave_columns(waves: NDArray[np.complex128], values: Array) -> Array:
    """(N, 2 M) offsets between both times of waves (N, 2), by the real and imaginary parts of M knots (N, 2, M)."""
    late, early = (waves[:, time, None] * values[:, time] for time in (1, 0))
    return np.concatenate([(late - early).real, (early - late).imag], -1)
