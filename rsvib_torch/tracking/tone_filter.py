"""Recursive estimate of tones that change slowly: an extended Kalman filter on the displacements of rows.

Each axis has the displacement, with s the time from a reference time that moves along with the frames,

    ``D(s) = Re sum_k C_k exp((g_k + 2 pi i f_k) s) + v s + a s^2 / 2``

Its state is C (px), the growth g (1/s) and the angular frequency (rad/s) of each tone, v (px/s) and a (px/s^2). Between
two frames, growth and angular frequency are random walks, and so is a. How fast they walk is not known in advance.
Several filters with different process noise therefore run side by side, with probabilities from their innovations
(interacting multiple models, Blom and Bar-Shalom, IEEE Trans. Autom. Control 33, 780, 1988).
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import block_diag
from scipy.special import softmax

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit
from rsvib_torch.numerics.tables import Array, median, split_axis, without_nan

# Random walk of g and 2 pi f in rad/s per square root of a second, and of a in px/s^2 per square root of a second.
# A tone that sweeps by 2 Hz/s changes by 12.6 rad/s in a second; a tone that grows to twice its amplitude has 0.7 / s.
# A camera held by hand shakes by 2 px at 3 Hz, which are 13000 px/s^3. Measured in docs/live.md.
PROCESS_NOISE = ((0.00003, 200.0), (0.00003, 4000.0), (0.5, 200.0), (12.0, 1200.0))
_STAY = 0.995  # probability that the process noise of the next frame is the same
# Standard deviations at the start, px/s and px/s^2 (tones and drift are correlated, their sum is more accurate), and
# 1/s: amplitudes that double within a second or two are followed
_DRIFT_STD, _GROWTH_STD = (10.0, 500.0), 1.0


@dataclass(frozen=True, eq=False)
class ToneFilter:
    """State of the filters of both axes (A), for M values of the process noise and K tones, in row order."""

    time: float  # reference time in s
    values: Array  # (A, M, P) float64, the P = 4 K + 2 parameters [Re C, Im C, g, 2 pi f of each tone, v, a]
    covariance: Array  # (A, M, P, P) float64 of the parameters
    probability: Array  # (A, M) float64 of each process noise
    exposure_time: float  # T_e in s

    @classmethod
    def started(
        cls,
        time: float,
        exposure_time: float,
        coefficients: Array,
        frequencies: Array,
        drift: Array,
        size_std: Array,
        frequency_std: Array,
    ) -> Self:
        """Filter from tones at a time, in s, as is the exposure time.

        Coefficients (A, K) complex128 px are 0 for tones that do not exist; frequencies (A, K) are in Hz, the drift (A,
        2) in px/s and px/s^2, and the standard deviations (A, K) of coefficients and frequencies in px and Hz.
        """
        models, rates = len(PROCESS_NOISE), 2j * math.pi * frequencies
        probability = np.full((len(drift), models), (1 - _STAY) / (models - 1))
        probability[:, 0] = _STAY
        parts = np.stack([size_std, size_std, np.full_like(size_std, _GROWTH_STD), 2 * math.pi * frequency_std], -1)
        of_tones = np.where((np.abs(coefficients) > 0)[..., None], parts, 0.0).reshape(len(drift), -1)
        std = np.concatenate([of_tones, np.broadcast_to(_DRIFT_STD, drift.shape)], -1)
        values = np.repeat(_packed(coefficients, rates, drift)[:, None], models, 1)
        covariance = np.repeat((np.square(std)[..., None] * np.eye(std.shape[-1]))[:, None], models, 1)
        return cls(time, values, covariance, probability, exposure_time)

    @property
    def coefficients(self) -> Array:
        """(A, M, K) complex128 C in px at the reference time."""
        return self.values[..., :-2:4] + 1j * self.values[..., 1:-2:4]

    @property
    def rates(self) -> Array:
        """(A, M, K) complex128 ``g + 2 pi i f`` in 1/s."""
        return self.values[..., 2:-2:4] + 1j * self.values[..., 3:-2:4]

    @property
    def drift(self) -> Array:
        """(A, M, 2) float64 v and a."""
        return self.values[..., -2:]

    # Prediction

    def predicted(self, time: float, *, mixed: bool = True) -> Self:
        """The filter at another time, with the process noise added, which may change in between if ``mixed``."""
        before, step = self._mixed() if mixed else self, time - self.time
        factor = np.exp(before.rates * step)
        coefficients = before.coefficients * factor
        eye = np.eye(self.values.shape[-1])
        transition = np.broadcast_to(eye, before.covariance.shape).copy()
        noise = np.zeros_like(transition)
        walk, jerk = np.moveaxis(np.square(np.array(PROCESS_NOISE))[..., None, None], 1, 0)  # (M, 1, 1)
        # Tones: C turns and grows by g and 2 pi f, whose random walk is integrated once.
        for tone in range(coefficients.shape[-1]):
            size, rate = slice(4 * tone, 4 * tone + 2), slice(4 * tone + 2, 4 * tone + 4)
            by_rate = _as_matrix(coefficients[..., tone])  # derivative of C by the rate, per second
            transition[..., size, size] = _as_matrix(factor[..., tone])
            transition[..., size, rate] = step * by_rate
            exists = (np.abs(coefficients[..., tone]) > 0)[..., None, None] * walk
            noise[..., size, size] = exists * (step**3 / 3) * (by_rate @ by_rate.mT)
            noise[..., size, rate] = exists * (step**2 / 2) * by_rate
            noise[..., rate, size] = noise[..., size, rate].mT
            noise[..., rate, rate] = exists * step * eye[:2, :2]
        # Image motion: v grows by a, whose random walk is integrated once.
        transition[..., -2, -1] = step
        noise[..., -2:, -2:] = jerk * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        velocity, acceleration = np.moveaxis(before.drift, -1, 0)
        drift = np.stack([velocity + step * acceleration, acceleration], -1)
        covariance = transition @ before.covariance @ transition.mT + noise
        return replace(before, time=time, values=_packed(coefficients, before.rates, drift), covariance=covariance)

    def _mixed(self) -> Self:
        """Every filter starts from the mean of all, weighted by how probable a change to its process noise is."""
        models = self.probability.shape[-1]
        change = np.full((models, models), (1 - _STAY) / (models - 1))
        np.fill_diagonal(change, _STAY)
        joint = self.probability[..., None] * change  # (A, from, to)
        probability = joint.sum(1)
        values, covariance = self._moments(joint / probability[:, None])
        return replace(self, values=values, covariance=covariance, probability=probability)

    def _moments(self, weight: Array) -> tuple[Array, Array]:
        """Means (A, N, P) and covariances (A, N, P, P) of mixtures with weights (A, M, N) of the filters."""
        # as products of matrices: einsum takes five times as many operations
        share = weight.mT
        mean = share @ self.values
        deviation = self.values[:, None] - mean[:, :, None]  # (A, N, M, P)
        spread = (deviation * share[..., None]).mT @ deviation
        size = self.covariance.shape[-1]
        covariance = split_axis(share @ self.covariance.reshape(*self.covariance.shape[:2], -1), -1, size, size)
        return mean, covariance + spread

    # Update

    def updated(self, measurements: Measurements, origin: float, noise_factor: Array) -> Self:
        """The filter after displacements (1, N, 2, 2) of the rows of two frames, measured around the prediction.

        Their time origin is in s. The variance has a factor (A,), because neighbouring pairs share a frame.
        """
        # 1. The offsets, linear in the parameters, with robust weights.
        jacobian, residual = self._linearised(measurements, origin)
        weights = 0.5 * measurements.weights[0].T * (measurements.num_differences[0] > 0)  # (A, N) of an offset
        weights = self._robust(jacobian, residual, weights) / noise_factor[:, None]
        weighted = jacobian * weights[:, None, :, None]
        normal, right = weighted.mT @ jacobian, (weighted.mT @ residual[..., None])[..., 0]
        # 2. Posterior (P^-1 + N)^-1 = (I + P N)^-1 P of the covariance P and the normal matrix N, in units of the
        # standard deviations: their sizes differ by many orders of magnitude, and fixed parameters have none.
        scale = np.sqrt(np.maximum(self.covariance.diagonal(axis1=-2, axis2=-1), 0.0))
        inverse_scale = np.where(scale > 0, 1 / np.maximum(scale, 1e-300), 0.0)
        correlation = self.covariance * inverse_scale[..., None] * inverse_scale[..., None, :]
        eye = np.eye(scale.shape[-1])
        system = eye + correlation @ (normal * scale[..., None] * scale[..., None, :])
        posterior = np.linalg.solve(system, correlation)
        posterior = 0.5 * (posterior + posterior.mT) * scale[..., None] * scale[..., None, :]
        step = (posterior @ right[..., None])[..., 0]
        values = self.values + step
        values[..., 3:-2:4] = np.abs(values[..., 3:-2:4])  # frequencies stay positive
        # 3. Probabilities of the process noise, from how well each filter predicted the offsets.
        fit = (weights[:, None] * np.square(residual)).sum(-1) - (step * right).sum(-1)
        score = np.log(self.probability) - 0.5 * (fit + np.linalg.slogdet(system)[1])
        probability = np.maximum(softmax(score, -1), 1e-6)  # a filter that failed must be able to return
        probability = probability / probability.sum(-1, keepdims=True)
        return replace(self, values=values, covariance=posterior, probability=probability)

    def explained(self, measurements: Measurements, origin: float) -> tuple[Array, Array]:
        """Displacements (1, N, 2, A) in px of rows in two frames relative to their mean, by the tones and by the drift.

        They are the means of all filters.
        """
        middles, _ = self._offsets(measurements, origin)
        parts = np.stack(self._expected(self._waves(middles), middles))  # (2, A, M, N)
        mean = (self.probability[..., None, :] @ parts)[..., 0, :].mT  # (2, N, A)
        relative = measurements.relative(np.stack([-0.5 * mean, 0.5 * mean], 2))
        return relative[:1], relative[1:]

    def _linearised(self, measurements: Measurements, origin: float) -> tuple[Array, Array]:
        """Derivatives (A, M, N, P) of the offsets between two frames, and their residuals (A, M, N) in px."""
        middles, offsets = self._offsets(measurements, origin)
        wave = self._waves(middles)
        by_rate = _between(self.coefficients[..., None, None] * wave * middles)
        amplitude = _between(wave)
        parts = np.stack([amplitude.real, -amplitude.imag, by_rate.real, -by_rate.imag], 3)  # (A, M, K, 4, N)
        parts = parts * (np.abs(self.coefficients) > 0)[..., None, None]
        powers = _powers(middles)
        drift = np.broadcast_to(powers, (*parts.shape[:2], *powers.shape))
        jacobian = np.concatenate([parts.reshape(*parts.shape[:2], -1, parts.shape[-1]), drift], 2).mT
        return jacobian, offsets[:, None] - sum(self._expected(wave, middles))

    def _offsets(self, measurements: Measurements, origin: float) -> tuple[Array, Array]:
        """Mid-exposures (N, 2) from the reference time in s, and the measured offsets (A, N) in px."""
        middles = measurements.exposure_starts[0] + (0.5 * self.exposure_time + origin - self.time)
        return middles, _between(np.moveaxis(measurements.displacements[0], -1, 0))

    def _waves(self, middles: Array) -> Array:
        """(A, M, K, N, 2) displacements by unit tones at times (N, 2)."""
        attenuation = np.sinc(self.rates.imag * (0.5 / math.pi * self.exposure_time))
        return np.exp(self.rates[..., None, None] * middles) * attenuation[..., None, None]

    def _expected(self, wave: Array, middles: Array) -> tuple[Array, Array]:
        """(A, M, N) px each, offsets by the tones with ``_waves``, and by the drift."""
        tones = (self.coefficients[:, :, None] @ _between(wave))[:, :, 0].real
        return tones, self.drift @ _powers(middles)

    def _robust(self, jacobian: Array, residual: Array, weights: Array) -> Array:
        """Weights (A, N) in px^-2 by the residual of a fit without prior: outliers have weight 0.

        The variance of the rows is that of the residuals, as in ``fit_tones``.
        """
        best = self.probability.argmax(-1)[:, None]
        jacobian = np.take_along_axis(jacobian, best[..., None, None], 1)[:, 0]
        residual = np.take_along_axis(residual, best[..., None], 1)[:, 0]
        columns = jacobian / np.maximum(np.sqrt(np.square(jacobian).mean(1, keepdims=True)), 1e-300)
        eye = np.eye(columns.shape[-1])
        ridge = (1e-9 * weights.sum(-1)[:, None, None] + 1e-300) * eye
        robust = weights
        for _ in range(2):
            weighted = columns * robust[..., None]
            solution = np.linalg.solve(weighted.mT @ columns + ridge, weighted.mT @ residual[..., None])
            scaled = (residual - (columns @ solution)[..., 0]) * np.sqrt(weights)
            measured = np.where(weights > 0, np.abs(scaled), np.nan)
            spread = 1.4826 * np.maximum(without_nan(median(measured, -1, keepdims=True), 1.0), 1e-9)
            share = np.square(np.maximum(1 - np.square(scaled / (6 * spread)), 0.0))
            robust = weights * share
        freedom = (share * (weights > 0)).sum(-1, keepdims=True) - columns.shape[-1]
        variance = (share * np.square(scaled)).sum(-1, keepdims=True) / np.maximum(freedom, 1.0)
        return robust / np.maximum(variance, 1e-12)

    # Results

    def path(self, step: float) -> Array:
        """(A,) px, displacement by v and a from the reference time to ``step`` s later."""
        drift = (self.probability[..., None] * self.drift).sum(1)
        return step * drift[:, 0] + 0.5 * step**2 * drift[:, 1]

    @property
    def _best_covariance(self) -> Array:
        """(A, P, P) covariance of the parameters, of the most probable filter."""
        best = self.probability.argmax(-1)[:, None, None, None]
        return np.take_along_axis(self.covariance, best, 1)[:, 0]

    def path_std(self, step: float) -> float:
        """px, standard deviation of ``path`` by the most probable filter; of the worse axis."""
        jerk = np.array(PROCESS_NOISE)[self.probability.argmax(-1), 1]
        powers = np.array([step, 0.5 * step**2])
        variance = (self._best_covariance[:, -2:, -2:] @ powers) @ powers + np.square(jerk) * (abs(step) ** 5 / 20)
        return float(np.sqrt(np.maximum(variance, 0.0).max()))

    def displacement_std(self) -> float:
        """px, standard deviation of the tones at the reference time, by the most probable filter; of the worse axis."""
        variance = self._best_covariance.diagonal(axis1=-2, axis2=-1)
        real, imaginary = variance[:, :-2:4], variance[:, 1:-2:4]
        return float(np.sqrt(np.maximum((0.5 * (real + imaginary)).sum(-1), 0.0).max()))

    def growth(self) -> Array:
        """(A, K) 1/s, growth of the tones, the mean of all filters."""
        return (self.probability[..., None] * self.rates.real).sum(1)

    def as_fit(self, origin: float) -> ToneFit:
        """The mean of all filters as a fit whose time origin is ``origin`` in s; the growth is left out."""
        values, covariance = (part[:, 0] for part in self._moments(self.probability[..., None]))
        unit, keep = np.ones_like(values[0]), np.ones_like(values[0], dtype=bool)
        unit[3:-2:4], keep[2:-2:4] = 0.5 / math.pi, False
        covariance = (covariance * unit[:, None] * unit)[:, keep][:, :, keep]
        coefficients = values[:, :-2:4] + 1j * values[:, 1:-2:4]
        return ToneFit(
            coefficients[None],
            values[None, :, 3:-2:4] / (2 * math.pi),
            (np.abs(coefficients) > 0)[None],
            values[None, :, -2:],
            block_diag(*covariance)[None],
            np.array([self.time - origin]),
        )


def _packed(coefficients: Array, rates: Array, drift: Array) -> Array:
    """(..., P) parameters of coefficients and rates (..., K) and drift (..., 2)."""
    tones = np.stack([coefficients.real, coefficients.imag, rates.real, rates.imag], -1)
    return np.concatenate([tones.reshape(*drift.shape[:-1], -1), drift], -1)


def _between(values: Array) -> Array:
    """Differences (...) between the two frames of values (..., 2)."""
    return values[..., 1] - values[..., 0]


def _powers(middles: Array) -> Array:
    """(2, N), offsets by unit v and a between times (N, 2)."""
    return _between(np.stack([middles, 0.5 * np.square(middles)]))


def _as_matrix(numbers: Array) -> Array:
    """Complex numbers (...) as matrices (..., 2, 2) that multiply [Re, Im]."""
    real, imaginary = numbers.real, numbers.imag
    return split_axis(np.stack([real, -imaginary, imaginary, real], -1), -1, 2, 2)
