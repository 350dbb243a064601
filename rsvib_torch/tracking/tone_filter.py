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

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import MotionModel, ToneFit

__all__ = ["PROCESS_NOISE", "ToneFilter"]

# Random walk of g and 2 pi f in rad/s per square root of a second, and of a in px/s^2 per square root of a second.
# A tone that sweeps by 2 Hz/s changes by 12.6 rad/s in a second; a tone that grows to twice its amplitude has 0.7 / s.
# A camera held by hand shakes by 2 px at 3 Hz, which are 13000 px/s^3. Measured in docs/live.md.
PROCESS_NOISE = ((0.00003, 200.0), (0.00003, 4000.0), (0.5, 200.0), (12.0, 1200.0))
_STAY = 0.95  # probability that the process noise of the next frame is the same


@dataclass(frozen=True, eq=False)
class ToneFilter:
    """State of the filters of both axes (A), for M values of the process noise and K tones, in row order.

    Attributes:
        time: Reference time in s.
        values: (A, M, P) float64, the P = 4 K + 2 parameters [Re C, Im C, g, 2 pi f of each tone, v, a].
        covariance: (A, M, P, P) float64 of the parameters.
        probability: (A, M) float64 of each process noise.
        exposure_time: T_e in s.
    """

    time: float
    values: Tensor
    covariance: Tensor
    probability: Tensor
    exposure_time: float

    @classmethod
    def started(
        cls, time: float, coefficients: Tensor, frequencies: Tensor, drift: Tensor, std: Tensor, exposure_time: float
    ) -> Self:
        """Filter from tones at a time.

        Args:
            time: s.
            coefficients: (A, K) complex128 px; 0 for tones that do not exist.
            frequencies: (A, K) float64 Hz.
            drift: (A, 2) float64 px/s and px/s^2.
            std: (A, 4 K + 2) float64, standard deviations of the parameters; 0 for those that are fixed.
            exposure_time: T_e in s.
        """
        models = len(PROCESS_NOISE)
        probability = torch.full((len(std), models), (1 - _STAY) / (models - 1), dtype=std.dtype, device=std.device)
        probability[:, 0] = _STAY
        rates = torch.complex(torch.zeros_like(frequencies), 2 * math.pi * frequencies)
        values = _packed(coefficients, rates, drift)[:, None].repeat(1, models, 1)
        covariance = torch.diag_embed(std.square())[:, None].repeat(1, models, 1, 1)
        return cls(time, values, covariance, probability, exposure_time)

    @property
    def coefficients(self) -> Tensor:
        """(A, M, K) complex128 C in px at the reference time."""
        return torch.complex(self.values[..., :-2:4], self.values[..., 1:-2:4])

    @property
    def rates(self) -> Tensor:
        """(A, M, K) complex128 ``g + 2 pi i f`` in 1/s."""
        return torch.complex(self.values[..., 2:-2:4], self.values[..., 3:-2:4])

    @property
    def drift(self) -> Tensor:
        """(A, M, 2) float64 v and a."""
        return self.values[..., -2:]

    # Prediction

    def predicted(self, time: float, *, mixed: bool = True) -> Self:
        """The filter at another reference time, with the process noise added.

        Args:
            time: s.
            mixed: Whether the process noise may change in between.
        """
        before, step = self._mixed() if mixed else self, time - self.time
        factor = (before.rates * step).exp()
        moved = before.coefficients * factor
        eye = torch.eye(self.values.shape[-1], dtype=torch.float64, device=moved.device)
        transition = eye.expand_as(before.covariance).clone()
        noise = torch.zeros_like(transition)
        walk, jerk = eye.new_tensor(PROCESS_NOISE).square()[..., None, None].unbind(1)  # (M, 1, 1)
        # Tones: C turns and grows by g and 2 pi f, whose random walk is integrated once.
        for tone in range(moved.shape[-1]):
            size, rate = slice(4 * tone, 4 * tone + 2), slice(4 * tone + 2, 4 * tone + 4)
            by_rate = _as_matrix(moved[..., tone])  # derivative of C by the rate, per second
            transition[..., size, size] = _as_matrix(factor[..., tone])
            transition[..., size, rate] = step * by_rate
            exists = (moved[..., tone].abs() > 0)[..., None, None] * walk
            noise[..., size, size] = exists * (step**3 / 3) * (by_rate @ by_rate.mT)
            noise[..., size, rate] = exists * (step**2 / 2) * by_rate
            noise[..., rate, size] = noise[..., size, rate].mT
            noise[..., rate, rate] = exists * step * eye[:2, :2]
        # Image motion: v grows by a, whose random walk is integrated once.
        transition[..., -2, -1] = step
        noise[..., -2:, -2:] = jerk * eye.new_tensor([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        velocity, acceleration = before.drift.unbind(-1)
        drift = torch.stack([velocity + step * acceleration, acceleration], -1)
        covariance = transition @ before.covariance @ transition.mT + noise
        return replace(before, time=time, values=_packed(moved, before.rates, drift), covariance=covariance)

    def _mixed(self) -> Self:
        """Every filter starts from the mean of all, weighted by how probable a change to its process noise is."""
        models = self.probability.shape[-1]
        change = torch.full((models, models), (1 - _STAY) / (models - 1), dtype=torch.float64, device="cpu")
        change = change.fill_diagonal_(_STAY).to(self.probability)
        joint = self.probability[..., None] * change  # (A, from, to)
        probability = joint.sum(1)
        values, covariance = self._moments(joint / probability[:, None])
        return replace(self, values=values, covariance=covariance, probability=probability)

    def _moments(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Means (A, N, P) and covariances (A, N, P, P) of mixtures with weights (A, M, N) of the filters."""
        # as products of matrices: einsum takes five times as many operations
        share = weight.mT
        mean = share @ self.values
        apart = self.values[:, None] - mean[:, :, None]  # (A, N, M, P)
        spread = (apart * share[..., None]).mT @ apart
        covariance = (share @ self.covariance.flatten(-2)).unflatten(-1, self.covariance.shape[-2:])
        return mean, covariance + spread

    # Update

    def updated(self, measurements: Measurements, origin: float, noise_factor: Tensor) -> Self:
        """The filter after the offsets between two frames, measured around the prediction.

        Args:
            measurements: Displacements (1, N, 2, 2) of the rows of two frames.
            origin: Time origin of the measurements in s.
            noise_factor: (A,) factor of the variance of the offsets, because neighbouring pairs share a frame.
        """
        # 1. The offsets, linear in the parameters, with robust weights.
        jacobian, residual = self._linearised(measurements, origin)
        weights = 0.5 * measurements.weights[0].T * (measurements.num_differences[0] > 0)  # (A, N) of an offset
        weights = self._robust(jacobian, residual, weights) / noise_factor[:, None]
        weighted = jacobian * weights[:, None, :, None]
        normal, right = weighted.mT @ jacobian, (weighted.mT @ residual[..., None])[..., 0]
        # 2. Posterior (P^-1 + N)^-1 = (I + P N)^-1 P of the covariance P and the normal matrix N, in units of the
        # standard deviations: their sizes differ by many orders of magnitude, and fixed parameters have none.
        scale = self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
        inverse_scale = torch.where(scale > 0, 1 / scale.clamp(min=1e-300), 0.0)
        correlation = self.covariance * inverse_scale[..., None] * inverse_scale[..., None, :]
        eye = torch.eye(scale.shape[-1], dtype=torch.float64, device=scale.device)
        system = eye + correlation @ (normal * scale[..., None] * scale[..., None, :])
        posterior = torch.linalg.solve(system, correlation)
        posterior = 0.5 * (posterior + posterior.mT) * scale[..., None] * scale[..., None, :]
        step = (posterior @ right[..., None])[..., 0]
        values = self.values + step
        values[..., 3:-2:4] = values[..., 3:-2:4].abs()  # frequencies stay positive
        # 3. Probabilities of the process noise, from how well each filter predicted the offsets.
        fit = (weights[:, None] * residual.square()).sum(-1) - (step * right).sum(-1)
        score = self.probability.log() - 0.5 * (fit + torch.linalg.slogdet(system).logabsdet)
        probability = score.softmax(-1).clamp(min=1e-6)  # a filter that failed must be able to return
        probability = probability / probability.sum(-1, keepdim=True)
        return replace(self, values=values, covariance=posterior, probability=probability)

    def explained(self, measurements: Measurements, origin: float) -> tuple[Tensor, Tensor]:
        """Displacements (1, N, 2, A) in px of rows in two frames relative to their mean, by the tones and by the drift.

        They are the means of all filters.
        """
        middles, _ = self._offsets(measurements, origin)
        parts = torch.stack(self._expected(self._waves(middles), middles))  # (2, A, M, N)
        mean = (self.probability[..., None, :] @ parts)[..., 0, :].mT  # (2, N, A)
        tones, drift = measurements.relative(torch.stack([-0.5 * mean, 0.5 * mean], 2)).split(1)
        return tones, drift

    def _linearised(self, measurements: Measurements, origin: float) -> tuple[Tensor, Tensor]:
        """Derivatives (A, M, N, P) of the offsets between two frames, and their residuals (A, M, N) in px."""
        middles, offsets = self._offsets(measurements, origin)
        wave = self._waves(middles)
        by_rate = _between(self.coefficients[..., None, None] * wave * middles)
        amplitude = _between(wave)
        parts = torch.stack([amplitude.real, -amplitude.imag, by_rate.real, -by_rate.imag], 3)  # (A, M, K, 4, N)
        parts = parts * (self.coefficients.abs() > 0)[..., None, None]
        drift = _powers(middles).expand(*parts.shape[:2], -1, -1)
        return torch.cat([parts.flatten(2, 3), drift], 2).mT, offsets[:, None] - sum(self._expected(wave, middles))

    def _offsets(self, measurements: Measurements, origin: float) -> tuple[Tensor, Tensor]:
        """Mid-exposures (N, 2) from the reference time in s, and the measured offsets (A, N) in px."""
        middles = measurements.exposure_starts[0] + (0.5 * self.exposure_time + origin - self.time)
        return middles, _between(measurements.displacements[0].permute(2, 0, 1))

    def _waves(self, middles: Tensor) -> Tensor:
        """(A, M, K, N, 2) displacements by unit tones at times (N, 2)."""
        attenuation = torch.sinc(self.rates.imag * (0.5 / math.pi * self.exposure_time))
        return (self.rates[..., None, None] * middles).exp() * attenuation[..., None, None]

    def _expected(self, wave: Tensor, middles: Tensor) -> tuple[Tensor, Tensor]:
        """(A, M, N) px each, offsets by the tones with ``_waves``, and by the drift."""
        tones = (self.coefficients[:, :, None] @ _between(wave))[:, :, 0].real
        return tones, self.drift @ _powers(middles)

    def _robust(self, jacobian: Tensor, residual: Tensor, weights: Tensor) -> Tensor:
        """Weights (A, N) in px^-2 by the residual of a fit without prior: outliers have weight 0.

        The variance of the rows is that of the residuals, as in ``fit_tones``.
        """
        best = self.probability.argmax(-1)[:, None]
        jacobian = jacobian.take_along_dim(best[..., None, None], 1)[:, 0]
        residual = residual.take_along_dim(best[..., None], 1)[:, 0]
        columns = jacobian / jacobian.square().mean(1, keepdim=True).sqrt().clamp(min=1e-300)
        eye = torch.eye(columns.shape[-1], dtype=columns.dtype, device=columns.device)
        ridge = (1e-9 * weights.sum(-1)[:, None, None] + 1e-300) * eye
        robust = weights
        for _ in range(2):
            weighted = columns * robust[..., None]
            solution = torch.linalg.solve(weighted.mT @ columns + ridge, weighted.mT @ residual[..., None])
            apart = (residual - (columns @ solution)[..., 0]) * weights.sqrt()
            measured = torch.where(weights > 0, apart.abs(), torch.nan)
            spread = 1.4826 * measured.nanmedian(-1, keepdim=True).values.nan_to_num(1.0).clamp(min=1e-9)
            share = (1 - (apart / (6 * spread)).square()).clamp(min=0.0).square()
            robust = weights * share
        freedom = (share * (weights > 0)).sum(-1, keepdim=True) - columns.shape[-1]
        variance = (share * apart.square()).sum(-1, keepdim=True) / freedom.clamp(min=1.0)
        scaled: Tensor = robust / variance.clamp(min=1e-12)
        return scaled

    # Results

    def path(self, step: float) -> Tensor:
        """(A,) px, displacement by v and a from the reference time to ``step`` s later."""
        drift = (self.probability[..., None] * self.drift).sum(1)
        return step * drift[:, 0] + 0.5 * step**2 * drift[:, 1]

    def path_std(self, step: float) -> float:
        """px, standard deviation of ``path`` by the most probable filter; of the worse axis."""
        best = self.probability.argmax(-1)
        covariance = self.covariance[..., -2:, -2:].take_along_dim(best[:, None, None, None], 1)[:, 0]
        jerk = covariance.new_tensor(PROCESS_NOISE)[best, 1]
        powers = covariance.new_tensor([step, 0.5 * step**2])
        variance = (covariance @ powers) @ powers + jerk.square() * (abs(step) ** 5 / 20)
        return float(variance.clamp(min=0.0).amax().sqrt())

    def displacement_std(self) -> float:
        """px, standard deviation of the tones at the reference time, by the most probable filter; of the worse axis."""
        best = self.probability.argmax(-1)[:, None, None]
        variance = self.covariance.diagonal(dim1=-2, dim2=-1).take_along_dim(best, 1)[:, 0, :-2]
        real, imaginary = variance[:, ::4], variance[:, 1::4]
        return float((0.5 * (real + imaginary)).sum(-1).clamp(min=0.0).amax().sqrt())

    def as_fit(self, origin: float) -> ToneFit:
        """The mean of all filters as a fit whose time origin is ``origin`` in s; the growth is left out."""
        values, covariance = (part[:, 0] for part in self._moments(self.probability[..., None]))
        unit, keep = torch.ones_like(values[0]), torch.ones_like(values[0], dtype=torch.bool)
        unit[3:-2:4], keep[2:-2:4] = 0.5 / math.pi, False
        covariance = (covariance * unit[:, None] * unit)[:, keep][:, :, keep]
        coefficients = torch.complex(values[:, :-2:4], values[:, 1:-2:4])
        return ToneFit(
            coefficients[None],
            values[None, :, 3:-2:4] / (2 * math.pi),
            (coefficients.abs() > 0)[None],
            values[None, :, -2:],
            torch.block_diag(*covariance)[None],
            values.new_tensor([self.time - origin]),
            MotionModel(1, 2),
        )


def _packed(coefficients: Tensor, rates: Tensor, drift: Tensor) -> Tensor:
    """(..., P) parameters of coefficients and rates (..., K) and drift (..., 2)."""
    tones = torch.stack([coefficients.real, coefficients.imag, rates.real, rates.imag], -1)
    return torch.cat([tones.flatten(-2), drift], -1)


def _between(values: Tensor) -> Tensor:
    """Differences (...) between the two frames of values (..., 2)."""
    return values[..., 1] - values[..., 0]


def _powers(middles: Tensor) -> Tensor:
    """(2, N), offsets by unit v and a between times (N, 2)."""
    return _between(torch.stack([middles, 0.5 * middles.square()]))


def _as_matrix(numbers: Tensor) -> Tensor:
    """Complex numbers (...) as matrices (..., 2, 2) that multiply [Re, Im]."""
    real, imaginary = numbers.real, numbers.imag
    matrices: Tensor = torch.stack([real, -imaginary, imaginary, real], -1).unflatten(-1, (2, 2))
    return matrices
