"""Tones and image motion: model, weighted least-squares fit, and inversion to amplitude, frequency and phase.

The paper fits one sine to the offset curve of an axis (Eq. 5 of Liu et al. 2023) and inverts the result for the
exposure (Eq. 2) and for the gain from displacement to offset (Eqs. 4, 6-8). Here exposure, gain, band average and the
coupling of the scan with motion along it are part of the model, and all tones of both axes are fitted together.
"""

import math
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import (
    Array,
    cos_sin,
    select_stacks,
    split_axis,
    take_stacks,
    tensor,
    unit_wave,
    without_nan,
)

MIN_GAIN = 0.1  # px of offset per px of displacement; below it, amplitudes are ten times noisier than offsets
# px, amplitude of tones near blind frequencies, of x, y, roll and zoom. A clip with a blind vibration along y was
# fitted by a tone of 59 px; after warping by it, the known motion along x was not measurable in 13 of 24 repetitions.
# Roll of 2.5e-3 to 0.03 rad in 40 parts of 2 to 4 frames: with 0.1, 0.3, 1 and 30 px, 59, 62, 66 and 63 axes were right
# and 2, 1, 2 and 2 wrong; with 30 px, a nearly blind roll of 0.2 px in two frames was 2.7 px and reliable
LARGEST = (30.0, 30.0, 1.0, 1.0)

# --- Model ---


@dataclass(frozen=True, eq=False)
class ToneFit:
    """Fitted motion ``D(t) = Re sum_k C_k exp(2 pi i f_k s) + sum_j d_j s^j / j!`` of each axis, s = t - centre."""

    coefficients: Array  # (B, 2, K) complex128 C in px
    frequencies: Array  # (B, 2, K) float64 f in Hz
    active: Array  # (B, 2, K) bool, tones that exist
    drift: Array  # (B, 2, J) float64 d in px/s^j; J = 1 for a uniform image motion, 2 for an accelerated one
    # (B, 2 P, 2 P) float64 of the P = 3 K + J parameters [Re C, Im C, f of each tone, d] of x, then of y. With roll and
    # zoom there are A = 3 or 4 axes instead of 2, in the units of the measurements.
    covariance: Array
    centre: Array  # (B,) float64 s, the middle of the record, where phase and frequency are least correlated

    @property
    def drift_order(self) -> int:
        """J, the order of the image motion."""
        return self.drift.shape[-1]

    @property
    def tones(self) -> Array:
        """(B, 2, K, 3) Re C, Im C and f."""
        return np.stack([self.coefficients.real, self.coefficients.imag, self.frequencies], -1)

    @property
    def parameters(self) -> Array:
        """(B, 2, P) parameters of each axis, in the order of the covariance."""
        return np.concatenate([self.tones.reshape(*self.drift.shape[:2], -1), self.drift], -1)

    @property
    def amplitude(self) -> Array:
        """(B, 2, K) px, 0 for tones that are not active."""
        return np.where(self.active, np.abs(self.coefficients), 0.0)

    def about(self, centre: Array) -> "ToneFit":
        """The same motion with another centre (B,) in s; only the covariance is not changed."""
        shift = (centre - self.centre)[:, None]
        turn = 2 * math.pi * self.frequencies * shift[..., None]
        drift = self.drift
        if drift.shape[-1] > 1:  # the constant of (s + moved)^2 / 2 cancels within the group
            drift = np.stack([drift[..., 0] + drift[..., 1] * shift, drift[..., 1]], -1)
        return replace(self, coefficients=self.coefficients * unit_wave(turn), drift=drift, centre=centre)


def tone_response(measurements: Measurements, frequencies: Array) -> Array:
    """Relative displacements, complex128 (B, N, G, 2, K), that unit tones of frequencies (B, 2, K) in Hz cause.

    ``S(f) exp(2 pi i f (t - centre))`` at the mid-exposures t of the rows, less the mean over the frames of the group,
    which is the gain of Eq. (4). ``S(f) = sinc(f T_e) sinc(f h T_row)`` is the attenuation by exposure (Eq. 2) and by a
    band of h rows. The times t contain the coupling of the scan with motion along it.
    """
    return measurements.relative(_tones_at(measurements, frequencies))


def _tones_at(measurements: Measurements, frequencies: Array) -> Array:
    """``tone_response`` without subtraction of the mean."""
    attenuation = np.sinc(frequencies * measurements.smearing_times).prod(0)[:, None, None]
    return attenuation * unit_wave(2 * math.pi * frequencies[:, None, None] * measurements.middles)


def displacements(measurements: Measurements, fit: ToneFit) -> Array:
    """Displacements (B, N, G, A) in px of the fitted motion at the measurements, up to a constant."""
    fit = fit.about(measurements.centre)
    tones = (fit.coefficients[:, None, None] * _tones_at(measurements, fit.frequencies)).real.sum(-1)
    powers = [measurements.middles[..., 0] ** order / order for order in range(1, fit.drift.shape[-1] + 1)]
    return sum((power * fit.drift[:, None, None, :, j] for j, power in enumerate(powers)), tones)


def model_displacements(measurements: Measurements, fit: ToneFit) -> Array:
    """Displacements (B, N, G, 2) in px that the fitted motion predicts at the measurements."""
    return measurements.relative(displacements(measurements, fit))


def residual_of(measurements: Measurements, fit: ToneFit) -> Array:
    """Residual displacements (B, N, G, 2) in px of a fit."""
    return measurements.displacements - model_displacements(measurements, fit)


# --- Weighted least squares ---


def _jacobian_of_tones(smearing_times: Array, time: Array, tones: Array) -> Array:
    """Derivatives (B, N, G, 2, 3 K) of displacements by Re C, Im C in px and f >= 0 in Hz of tones (B, 2, K, 3)."""
    frequencies = tones[..., 2]
    smeared, smeared_slope = _sinc(frequencies * smearing_times)
    attenuation = smeared[0] * smeared[1]
    slope = (smeared_slope * smearing_times * smeared[::-1]).sum(0)
    # the frequency changes the attenuation and the angle: Re((slope + 2 pi i time attenuation) C exp(i angle))
    slope, attenuation, frequencies, real, imaginary = (
        values[:, None, None] for values in (slope, attenuation, frequencies, tones[..., 0], tones[..., 1])
    )
    turn = (2 * math.pi) * attenuation
    angle = (2 * math.pi * frequencies) * time
    cos, sin = cos_sin(angle)
    by_frequency = cos * (slope * real - time * (turn * imaginary)) - sin * (slope * imaginary + time * (turn * real))
    by_tones = np.stack([attenuation * cos, -attenuation * sin, by_frequency], -1)
    return by_tones.reshape(*angle.shape[:-1], -1)


def _sinc(x: Array) -> tuple[Array, Array]:
    """sin(pi x) / (pi x) of x >= 0 and its derivative, which is -5e-4 instead of 0 below 1e-4."""
    value, positive = np.sinc(x), np.maximum(x, 1e-4)
    return value, (np.cos(math.pi * positive) - value) / positive


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Parameters with their residual and normal equations."""

    values: Array  # (B, 2, P) all parameters
    jacobian: Array  # (B, N, G, 2, P) derivatives of the displacements of each axis by its parameters
    residual: Array  # (B, N, G, 2) px
    cost: Array  # (B,) weighted square of the residual
    matrix: Array  # (B, M, M) normal matrix of all M = A P parameters
    right_side: Array  # (B, M) its right-hand side


class _Problem:
    """Nonlinear least squares ``min sum_n r_n^T W_n r_n`` of the rows for the ``active`` (B, 2, K) tones."""

    def __init__(self, measurements: Measurements, active: Array, drift_order: int) -> None:
        self.measurements, self.active = measurements, active
        self.axes, self.tones = active.shape[1:]
        exists = np.pad(np.repeat(active, 3, -1), ((0, 0), (0, 0), (0, drift_order)), constant_values=True)
        place = np.arange(exists.shape[-1])
        self.is_frequency = (place < 3 * self.tones) & (place % 3 == 2)  # (P,)
        # (B, M) bool, parameters that are fitted, and those of them on which displacements depend linearly
        self.free, self.linear = (mask.reshape(len(active), -1) for mask in (exists, exists & ~self.is_frequency))
        drifts = measurements.drifts[..., :drift_order]
        self.drift_columns = np.broadcast_to(drifts, (*drifts.shape[:3], self.axes, drift_order))
        self.root = measurements.root[:, :, None]  # (B, N, 1, A, A)

    def stacks_at(self, index: Array) -> "_Problem":
        """The problem of some stacks."""
        selection = copy(self)
        selection.measurements = take_stacks([self.measurements], index)
        for name in ("active", "free", "linear", "drift_columns", "root"):
            setattr(selection, name, getattr(self, name)[index])
        return selection

    def tones_of(self, values: Array) -> Array:
        """Tones (B, 2, K, 3) of parameters (B, 2, P), as in ``_jacobian_of_tones``."""
        return split_axis(values[..., : 3 * self.tones], -1, self.tones, 3)

    def fit(self, values: Array, covariance: Array) -> ToneFit:
        """The parameters (B, 2, P) as a ``ToneFit``."""
        (real, imaginary, frequencies), drift = np.moveaxis(self.tones_of(values), -1, 0), values[..., 3 * self.tones :]
        return ToneFit(real + 1j * imaginary, frequencies, self.active, drift, covariance, self.measurements.centre)

    def jacobian(self, values: Array) -> Array:
        """Derivatives (B, N, G, 2, P) of the displacements of each axis by its parameters (B, 2, P)."""
        measurements = self.measurements
        tones = _jacobian_of_tones(measurements.smearing_times, measurements.middles, self.tones_of(values))
        return np.concatenate([measurements.relative(tones), self.drift_columns], -1)

    @property
    def num_spare(self) -> Array:
        """(B, 2) number of independent measurements of each axis, less that of its free parameters."""
        # `num_measurements` counts independent measurements only: overlapping bands repeat each other
        return self.measurements.num_measurements - split_axis(self.free, 1, self.axes, -1).sum(-1)

    def variances(self, state: _Estimate) -> Array:
        """(B, 2) variance of the errors of each axis, in units of those of the measurements, from the residual.

        A fit with no more independent measurements than parameters is exact for any errors, which then count as large
        as the displacements.
        """
        measurements, spare = self.measurements, np.maximum(self.num_spare, 1.0)
        if self.axes > 2:  # unequal variances would not keep the precise combinations of correlated components
            return np.broadcast_to((state.cost / spare.sum(-1))[:, None], spare.shape)
        largest = measurements.square(measurements.displacements) / np.maximum(measurements.num_measurements, 1.0)
        return np.where(self.num_spare > 0, measurements.square(state.residual) / spare, largest)

    def covariance(self, state: _Estimate, deviation: Array) -> Array:
        """Covariance (B, 2 P, 2 P) for errors of a row of the covariance ``S W^-1 S``, S the deviations (B, 2)."""
        # W = R^T R, and the whitened errors R e have the covariance T T^T with T = R S R^-1; T^T R = R^-T S W
        diagonal = self.root.diagonal(axis1=-2, axis2=-1)
        safe = self.root + (diagonal == 0)[..., None] * np.eye(self.axes)
        scaled = deviation[:, None, None, :, None] * (self.root.mT @ self.root)
        mixed = np.linalg.solve(safe.mT, scaled)  # (B, N, 1, A, A)
        columns = self._whitened(mixed, state.jacobian) @ self.inverse(state)
        return columns.mT @ columns

    def inverse(self, state: _Estimate) -> Array:
        """Inverse (B, M, M) of the normal matrix of the free parameters; 0 for the others."""
        matrix, scale = _scaled(state, self.free, np.zeros_like(state.cost))
        return np.linalg.inv(matrix) * scale[:, :, None] * scale[:, None]

    @staticmethod
    def _whitened(root: Array, jacobian: Array) -> Array:
        """Derivatives (B, N G A, A P) of the displacements times ``root``, from those of each axis (B, N, G, A, P)."""
        factors = np.repeat(root, jacobian.shape[-1], -1)  # long inner loops are twice as fast
        return (factors * jacobian.reshape(*jacobian.shape[:-2], 1, -1)).reshape(len(jacobian), -1, factors.shape[-1])

    def in_std(self, jacobian: Array, residual: Array) -> tuple[Array, Array]:
        """Derivatives (B, N G A, M) by the parameters and residual (B, N G A, 1), in standard deviations."""
        columns = self._whitened(self.root, jacobian)
        return columns, (residual @ self.root[:, :, 0].mT).reshape(*columns.shape[:2], 1)

    def evaluate(self, values: Array) -> _Estimate:
        """Residual and normal equations at the parameters ``values`` (B, 2, P)."""
        jacobian = self.jacobian(values)
        linear = np.where(self.is_frequency, 0.0, values)[:, None, None]
        residual = self.measurements.displacements - np.vecdot(jacobian, linear)
        columns, whitened = self.in_std(jacobian, residual)
        right_side = (columns.mT @ whitened)[..., 0]
        return _Estimate(values, jacobian, residual, np.square(whitened).sum((1, 2)), columns.mT @ columns, right_side)

    def moved(self, values: Array, step: Array) -> Array:
        """Parameters (B, 2, P) after a step (B, M); frequencies stay positive."""
        values = values + step.reshape(values.shape)
        return np.where(self.is_frequency, np.abs(values), values)

    def is_lone_and_resolved(self, values: Array) -> Array:
        """(B,) bool, one tone of each axis, of half a period or more: valleys of others lead to tones of 1e4 px."""
        periods = self.tones_of(values)[..., 2] * self.measurements.span[:, None, None]
        return (self.tones == 1) & ((periods >= 0.5) | ~self.active).all((1, 2))

    def with_best_amplitudes(self, state: _Estimate) -> _Estimate:
        """The estimate with the amplitudes, phases and drifts that fit its frequencies best."""
        return self.evaluate(self.moved(state.values, _step(state, self.linear, np.zeros_like(state.cost))))

    def solve(self, start: Array | ToneFit, iterations: int, tolerance: float) -> _Estimate:
        """Levenberg-Marquardt, for each stack until a step promises a relative decrease below the tolerance."""
        # 1. Start values.
        if isinstance(start, ToneFit):
            start = start.about(self.measurements.centre)
            tones = np.where(self.active[..., None], start.tones, 0.0)
            state = self.evaluate(np.concatenate([tones.reshape(*tones.shape[:2], -1), start.drift], -1))
        else:  # amplitudes, phases and drifts are linear once the frequencies are given
            values = np.zeros((len(start), self.axes, len(self.is_frequency)))
            values[..., self.is_frequency] = np.where(self.active, start, 0.0)
            state = self.with_best_amplitudes(self.evaluate(values))
        # 2. Damped steps. A step that decreases the cost is taken, and the damping of a stack decreases or increases.
        # Converged stacks leave the batch.
        problem, stacks, damping = self, np.arange(len(state.cost)), np.full_like(state.cost, 1e-3)
        finished: list[_Estimate] = []
        order: list[Array] = []
        for _ in range(iterations):
            step = _step(state, problem.free, damping)
            converged = (step * state.right_side).sum(-1) <= tolerance * state.cost
            if bool(converged.all()):
                break
            if bool(converged.any()):
                (ended,), (index,) = converged.nonzero(), (~converged).nonzero()
                finished.append(take_stacks([state], ended))
                order.append(stacks[ended])
                problem, state = problem.stacks_at(index), take_stacks([state], index)
                stacks, step, damping = stacks[index], step[index], damping[index]
            trial = problem.evaluate(problem.moved(state.values, step))
            curved = (trial.cost > state.cost) & problem.is_lone_and_resolved(trial.values)
            if bool(curved.any()):
                # valleys of slow tones are curved: the amplitudes that fit the new frequencies follow them, in 5 steps
                # instead of 24
                trial = select_stacks(curved, problem.with_best_amplitudes(trial), trial)
            better = trial.cost <= state.cost
            state = trial if bool(better.all()) else select_stacks(better, trial, state)
            damping = np.clip(np.where(better, damping * 0.1, damping * 10.0), 1e-12, 1e6)
        return take_stacks([*finished, state], np.concatenate([*order, stacks]).argsort()) if finished else state


def _scaled(state: _Estimate, free: Array, damping: Array) -> tuple[Array, Array]:
    """Damped normal matrix of the ``free`` (B, M) parameters, each divided by its size, and the factors (B, M)."""
    size = state.matrix.diagonal(axis1=-2, axis2=-1)
    scale = np.where(free & (size > 1e-200), 1 / np.sqrt(np.maximum(size, 1e-200)), 0.0)
    matrix = state.matrix * scale[:, :, None] * scale[:, None]
    place = np.arange(matrix.shape[-1])
    matrix[:, place, place] += np.where(free, 1e-12 + damping[:, None], 1.0)
    return matrix, scale


def _step(state: _Estimate, free: Array, damping: Array) -> Array:
    """Step (B, M) of the ``free`` (B, M) parameters."""
    matrix, scale = _scaled(state, free, damping)
    scaled: Array = np.linalg.solve(matrix, (state.right_side * scale)[..., None])[..., 0]
    return scaled * scale


def _problem(measurements: Measurements, start: Array | ToneFit, active: Array, drift_order: int) -> _Problem:
    """The problem of a fit from frequencies, or from an earlier fit, whose order of the image motion remains."""
    return _Problem(measurements, active, start.drift_order if isinstance(start, ToneFit) else drift_order)


def fit_roughly(
    measurements: Measurements, start: Array | ToneFit, active: Array, drift_order: int = 1, iterations: int = 5
) -> tuple[ToneFit, Array]:
    """A few steps of ``fit_tones``, without its covariance, and the residual displacements (B, N, G, 2)."""
    problem = _problem(measurements, start, active, drift_order)
    state = problem.solve(start, iterations, tolerance=1e-4)
    return problem.fit(state.values, state.matrix), state.residual


def fit_tones(
    measurements: Measurements,
    start: Array | ToneFit,
    active: Array,
    drift_order: int = 1,
    iterations: int = 30,
) -> ToneFit:
    """Fit all tones of both axes and the image motion by weighted least squares (Levenberg-Marquardt).

    ``start`` are frequencies (B, 2, K) in Hz, with the ``drift_order`` of the image motion, or an earlier fit of the
    same tones, whose order remains. Tones that are not ``active`` (B, 2, K) stay at zero.

    The variance of the errors of each axis is that of its residuals: with ``S = diag(s_x, s_y)`` the errors of a row
    have the covariance ``S W^-1 S`` instead of the ``W^-1`` of the fit. With roll and zoom, all axes have one variance.
    """
    problem = _problem(measurements, start, active, drift_order)
    state = problem.solve(start, iterations, tolerance=1e-7)
    return problem.fit(state.values, problem.covariance(state, np.sqrt(problem.variances(state))))


def fitted_again(measurements: Measurements, fit: ToneFit) -> ToneFit:
    """``fit_tones`` from an earlier fit; the earlier fit for stacks where it diverges."""
    exact = fit_tones(measurements, fit, fit.active)
    return select_stacks(is_bounded(exact, measurements.exposure_time), exact, fit)


# px, motion during an exposure; px, amplitude; Hz. Fits with larger values have diverged: frames are smaller. A path of
# 700 px in each of four frames of 400 px took 120 s
_MAX_PATH, _MAX_SIZE, _MAX_FREQUENCY = 300.0, 1e6, 1e9


def is_bounded(fit: ToneFit, exposure_time: float) -> Array:
    """(B,) bool, fits whose parameters are finite and of a size that frames can be warped by."""
    amplitude, drift = fit.amplitude, np.abs(fit.drift).max(-1)
    cycles = without_nan(fit.frequencies * exposure_time, 0.0)
    path = (amplitude * np.minimum(2 * math.pi * cycles, 4 * cycles + 2)).sum(-1) + drift * exposure_time  # (B, A)
    variances = fit.covariance.diagonal(axis1=-2, axis2=-1)
    return (
        ((path <= _MAX_PATH) & (amplitude.max(-1) <= _MAX_SIZE) & (fit.frequencies.max(-1) <= _MAX_FREQUENCY)).all(-1)
        & (drift <= _MAX_SIZE * _MAX_PATH).all(-1)
        & np.isfinite(variances).all(-1)
    )


# --- Inversion ---


def offset_gain(frequencies: Array, intervals: Array) -> Array:
    """Largest gain (...) from displacement to offset (Eq. 7) of tones (...) over intervals (M,) s between frames."""
    return 2 * np.abs(np.sin(math.pi * frequencies[..., None] * intervals)).max(-1)


def motion_of_fit(fit: ToneFit, device: torch.device | None = None) -> Vibration:
    """Vibration (B, 2, K) of a fit: ``A = |C|``, ``phi = arg C + pi/2 - 2 pi f centre`` (Eqs. 6-8); 0 if not active."""
    centre = fit.centre[:, None, None]
    frequency = np.where(fit.active, fit.frequencies, 0.0)
    phase = np.angle(fit.coefficients) + 0.5 * math.pi - 2 * math.pi * frequency * centre
    phase = np.where(fit.active, np.mod(phase + math.pi, 2 * math.pi) - math.pi, 0.0)
    motion, acceleration = fit.drift[..., 0], np.zeros_like(fit.drift[..., 0])
    if fit.drift.shape[-1] > 1:  # speed at the time origin instead of the middle of the record
        acceleration = fit.drift[..., 1]
        motion = motion - acceleration * centre[..., 0]
    order = (-fit.amplitude).argsort(-1, stable=True)
    tones = [np.take_along_axis(values, order, -1) for values in (fit.amplitude, frequency, phase)]
    drift = np.stack([motion, acceleration, np.zeros_like(motion)], -1)
    return Vibration.from_parameters(tensor(np.concatenate([*tones, drift], -1)).to(device))


def vibration_of_fit(fit: ToneFit) -> tuple[Vibration, VibrationStd]:
    """``motion_of_fit`` and its standard deviations; 0 for tones that are not active.

    They are of first order, except for uncertain frequencies. Rows determine the square of the frequency f of a slow
    tone, and the inverse of an amplitude that depends on f, with symmetric errors; the image motion compensates a slow
    tone in proportion to its period. The standard deviation of these is half of the distance to the limit at two
    standard deviations, at most 4.5 times the value.
    """
    # 1. First order.
    centre = fit.centre[:, None, None]
    real, imaginary, amplitude = _direction(fit)
    zero = np.zeros_like(real)
    gradients = [
        np.stack([real, imaginary, zero], -1),  # of the amplitude, frequency and phase
        np.stack([zero, zero, zero + 1.0], -1),
        np.stack([-imaginary / amplitude, real / amplitude, zero - 2 * math.pi * centre], -1),
    ]
    amplitude_std, frequency_std, phase_std = _propagated(fit, np.stack(gradients))
    frequency = np.where(fit.active & (fit.frequencies > 0), fit.frequencies, 1.0)
    tones, axes = 3 * fit.frequencies.shape[-1], _covariance_of_axes(fit)
    drift, by_frequency = axes[..., tones:, tones:], axes[..., 2:tones:3, :]  # covariances of each frequency
    by_frequency = by_frequency / np.where(frequency_std > 0, frequency_std, np.inf)[..., None]
    motion_variance, acceleration_variance = drift[..., 0, 0], np.zeros_like(drift[..., 0, 0])
    if fit.drift.shape[-1] > 1:
        acceleration_variance, shift = drift[..., 1, 1], centre[..., 0]
        motion_variance = motion_variance - 2 * shift * drift[..., 0, 1] + np.square(shift) * acceleration_variance
    # 2. The limits of f and of its period, relative to their values, and the amplitude and the image motion with them.
    share = frequency_std / frequency
    lower = np.sqrt(np.maximum(1 - 4 * share, 0.01))
    longer = np.maximum(0.5 * (1 / lower - 1), share)
    place = np.arange(frequency.shape[-1])
    along = np.abs(real * by_frequency[..., place, 3 * place] + imaginary * by_frequency[..., place, 3 * place + 1])
    larger = 0.5 * amplitude * (1 / np.maximum(1 - 2 * along / amplitude, 0.1) - 1)
    remaining_std = np.sqrt(np.maximum(np.square(amplitude_std) - np.square(along), 0.0))
    amplitude_std = np.hypot(remaining_std, np.maximum(larger, along))
    growth = np.square(longer / np.maximum(share, 1e-300)) - 1
    motion_variance = motion_variance + (np.square(by_frequency[..., tones]) * np.where(share > 0, growth, 0.0)).sum(-1)
    frequency_std = np.maximum(0.5 * frequency * (1 - lower), frequency_std)
    # 3. The order of the tones of a Vibration.
    order = (-fit.amplitude).argsort(-1, stable=True)
    tone_std = np.stack([amplitude_std, frequency_std, longer / frequency, phase_std]) * fit.active
    drift_std = np.sqrt(np.maximum([motion_variance, acceleration_variance], 0.0))
    parameter_std = (*np.take_along_axis(tone_std, order[None], -1), *drift_std)
    return motion_of_fit(fit), VibrationStd(*map(tensor, parameter_std))


def displacement_std(fit: ToneFit, exposure_starts: Array, exposure_time: float) -> Array:
    """Standard deviation (B, 2) in px of the displacement of rows (N,) without their mean, rms over the rows."""
    jacobian = displacement_jacobian(fit, exposure_starts[None], exposure_time)
    jacobian = (jacobian - jacobian.mean(1, keepdims=True)).swapaxes(1, 2)  # (B, A, N, P)
    return np.sqrt(np.maximum(((jacobian @ _covariance_of_axes(fit)) * jacobian).sum(-1), 0.0).mean(-1))


def displacement_jacobian(fit: ToneFit, exposure_starts: Array, exposure_time: float) -> Array:
    """Derivatives (B, N, 2, P) of the mean displacements of exposures from starts (B, N) by the parameters."""
    time = (exposure_starts + 0.5 * exposure_time - fit.centre[:, None])[..., None, None, None]
    tones = _jacobian_of_tones(np.array([exposure_time, 0.0])[:, None, None, None], time, fit.tones)
    powers = [time, 0.5 * np.square(time)][: fit.drift.shape[-1]]
    drift = np.broadcast_to(np.concatenate(powers, -1), (*tones.shape[:-1], len(powers)))
    return np.concatenate([tones, drift], -1)[:, :, 0]


def tone_displacements(fit: ToneFit, exposure_starts: Array, exposure_time: float) -> Array:
    """Mean displacements (B, N, A) in px of exposures from starts (N,) in s, by the tones without the image motion."""
    jacobian = displacement_jacobian(fit, exposure_starts[None], exposure_time)
    tones = np.where(np.arange(3) < 2, fit.tones, 0.0)  # the frequencies are not linear
    count = 3 * fit.frequencies.shape[-1]
    return (jacobian[..., :count] * tones.reshape(len(tones), 1, -1, count)).sum(-1)


def free_jacobian(measurements: Measurements, fit: ToneFit) -> Array:
    """Derivatives (B, N, G, A, P) of the displacements of each axis by its parameters; 0 where no tone is."""
    problem = _Problem(measurements, fit.active, fit.drift_order)
    return problem.jacobian(fit.parameters) * split_axis(problem.free, 1, problem.axes, -1)[:, None, None]


def amplitude_std(fit: ToneFit) -> Array:
    """Standard deviation (B, 2, K) of the amplitudes in px; 0 for tones that are not active."""
    real, imaginary, _ = _direction(fit)
    return _propagated(fit, np.stack([real, imaginary, np.zeros_like(real)], -1))


def shrunk(fit: ToneFit, intervals: Array) -> ToneFit:
    """The fit with uncertain amplitudes near blind frequencies reduced, for warping frames by its motion.

    An amplitude A of standard deviation s becomes ``A max(0, 1 - s^2 / A^2)`` (positive-part James-Stein estimate)
    where the gain is small. Nearly blind tones whose amplitude exceeds about ``LARGEST`` are left out.
    """
    blindness = 1 / (1 + np.square(offset_gain(fit.frequencies, intervals) / MIN_GAIN))
    noise = np.square(amplitude_std(fit) / np.maximum(np.abs(fit.coefficients), 1e-30))
    share = np.maximum(1 - blindness * noise, 0.0)
    largest = np.array(LARGEST)[: share.shape[1], None]
    share = np.where(blindness * np.square(fit.amplitude / largest) < 1, share, 0.0)
    return replace(fit, coefficients=np.where(fit.active, fit.coefficients * share, 0.0))


def strongest_only(fit: ToneFit) -> ToneFit:
    """The fit with only the strongest tone of each axis."""
    strongest = fit.amplitude.argmax(-1)[..., None]
    names = ("coefficients", "frequencies", "active")
    picked: Table = {name: np.take_along_axis(getattr(fit, name), strongest, -1) for name in names}
    return replace(fit, **picked)


def with_tones(fit: ToneFit, count: int) -> ToneFit:
    """The fit with arrays for ``count`` tones on each axis; the added ones are not active."""
    further = ((0, 0), (0, 0), (0, count - fit.active.shape[-1]))
    names = ("coefficients", "frequencies", "active")
    extended: Table = {name: np.pad(getattr(fit, name), further) for name in names}
    return replace(fit, **extended, covariance=covariance_with_tones(fit.covariance, fit, count))


def covariance_with_tones(covariance: Array, fit: ToneFit, count: int) -> Array:
    """A covariance (B, A P, A P) of the parameters of a fit, enlarged to ``count`` tones on each axis by zeros."""
    axes, tones = fit.active.shape[1:]
    added = np.full(axes, 3 * (count - tones))
    places = np.repeat((np.arange(axes) + 1) * (covariance.shape[-1] // axes) - fit.drift.shape[-1], added)
    return np.insert(np.insert(covariance, places, 0.0, 1), places, 0.0, 2)


def with_axes(fit: ToneFit, axes: int) -> ToneFit:
    """The strongest tone of each axis of a fit, with further axes that have no tones; without a covariance."""
    fit = strongest_only(fit)
    further = ((0, 0), (0, axes - fit.active.shape[1]), (0, 0))
    names = ("coefficients", "frequencies", "active", "drift")
    extended: Table = {name: np.pad(getattr(fit, name), further) for name in names}
    return replace(fit, **extended, covariance=fit.covariance[:, :0, :0])


def _covariance_of_axes(fit: ToneFit) -> Array:
    """Covariances (B, 2, P, P) of the parameters of each axis."""
    axes = fit.coefficients.shape[1]
    size = fit.covariance.shape[-1] // axes
    return np.moveaxis(fit.covariance.reshape(-1, axes, size, axes, size).diagonal(axis1=1, axis2=3), -1, 1)


def _direction(fit: ToneFit) -> tuple[Array, Array, Array]:
    """Real and imaginary part of the coefficients over their modulus, and the modulus, 1 where there is no tone."""
    amplitude = fit.amplitude
    modulus = np.where(amplitude > 0, amplitude, 1.0)
    return fit.coefficients.real / modulus, fit.coefficients.imag / modulus, modulus


def _propagated(fit: ToneFit, gradient: Array) -> Array:
    """Standard deviations (..., B, 2, K) of functions with gradients (..., B, 2, K, 3) by Re C, Im C and f of tones."""
    tones = fit.frequencies.shape[-1]
    covariance = _covariance_of_axes(fit)
    blocks = np.stack([covariance[..., 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(tones)], 2)
    variance = np.maximum(((gradient[..., None, :] @ blocks)[..., 0, :] * gradient).sum(-1), 0.0)
    return np.where(fit.active, np.sqrt(variance), 0.0)
