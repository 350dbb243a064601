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
        coefficients: (A, M, K) complex128 C in px at the reference time.
        rates: (A, M, K) complex128 ``g + 2 pi i f`` in 1/s.
        drift: (A, M, 2) float64 v and a.
        covariance: (A, M, P, P) float64 of the P = 4 K + 2 parameters [Re C, Im C, g, 2 pi f of each tone, v, a].
        probability: (A, M) float64 of each process noise.
        exposure_time: T_e in s.
    """

    time: float
    coefficients: Tensor
    rates: Tensor
    drift: Tensor
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

        def repeated(values: Tensor) -> Tensor:
            return values[:, None].expand(-1, models, *values.shape[1:]).clone()

        rates = torch.complex(torch.zeros_like(frequencies), 2 * math.pi * frequencies)
        probability = torch.full((len(std), models), (1 - _STAY) / (models - 1), dtype=std.dtype, device=std.device)
        probability[:, 0] = _STAY
        covariance = torch.diag_embed(std.square())
        coefficients, rates, drift, covariance = map(repeated, (coefficients, rates, drift, covariance))
        return cls(time, coefficients, rates, drift, covariance, probability, exposure_time)

    @property
    def tones(self) -> int:
        """Number K of tones."""
        return self.coefficients.shape[-1]

    def _values(self) -> Tensor:
        """(A, M, P) parameters."""
        parts = torch.stack(
            [self.coefficients.real, self.coefficients.imag, self.rates.real, self.rates.imag], -1
        ).flatten(-2)
        return torch.cat([parts, self.drift], -1)

    def _with_values(self, values: Tensor, covariance: Tensor, probability: Tensor) -> Self:
        tones = values[..., :-2].unflatten(-1, (-1, 4))
        return replace(
            self,
            coefficients=torch.complex(tones[..., 0], tones[..., 1]),
            rates=torch.complex(tones[..., 2], tones[..., 3].abs()),
            drift=values[..., -2:],
            covariance=covariance,
            probability=probability,
        )

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
        tones, size = self.tones, before.covariance.shape[-1]
        transition = torch.eye(size, dtype=torch.float64, device=moved.device).expand_as(before.covariance).clone()
        noise = torch.zeros_like(transition)
        walk, jerk = torch.tensor(PROCESS_NOISE, dtype=torch.float64, device=moved.device).square().unbind(-1)
        for tone in range(tones):
            place = slice(4 * tone, 4 * tone + 2), slice(4 * tone + 2, 4 * tone + 4)
            turned, by_rate = _as_matrix(factor[..., tone]), _as_matrix(moved[..., tone])
            transition[..., place[0], place[0]] = turned
            transition[..., place[0], place[1]] = step * by_rate
            exists = (moved[..., tone].abs() > 0)[..., None, None] * walk[:, None, None]
            noise[..., place[0], place[0]] = exists * (step**3 / 3) * (by_rate @ by_rate.mT)
            of_both = exists * (step**2 / 2) * by_rate
            noise[..., place[0], place[1]] = of_both
            noise[..., place[1], place[0]] = of_both.mT
            noise[..., place[1], place[1]] = exists * step * torch.eye(2, dtype=torch.float64, device=moved.device)
        transition[..., -2, -1] = step
        of_drift = noise.new_tensor([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        noise[..., -2:, -2:] = jerk[:, None, None] * of_drift
        velocity, acceleration = before.drift.unbind(-1)
        return replace(
            before,
            time=time,
            coefficients=moved,
            drift=torch.stack([velocity + step * acceleration, acceleration], -1),
            covariance=transition @ before.covariance @ transition.mT + noise,
        )

    def _mixed(self) -> Self:
        """Every filter starts from the mean of all, weighted by how probable a change to its process noise is."""
        models = self.probability.shape[-1]
        change = torch.full((models, models), (1 - _STAY) / (models - 1), dtype=torch.float64, device="cpu")
        change = change.fill_diagonal_(_STAY).to(self.probability)
        joint = self.probability[..., None] * change  # (A, from, to)
        probability = joint.sum(1)
        values, covariance = self._moments(joint / probability[:, None])
        return self._with_values(values, covariance, probability)

    def _moments(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Means (A, N, P) and covariances (A, N, P, P) of mixtures with weights (A, M, N) of the filters."""
        # as products of matrices: einsum takes five times as many operations
        values, share = self._values(), weight.mT
        mean = share @ values
        apart = values[:, None] - mean[:, :, None]  # (A, N, M, P)
        spread = (apart * share[..., None]).mT @ apart
        covariance = (share @ self.covariance.flatten(-2)).unflatten(-1, self.covariance.shape[-2:])
        return mean, covariance + spread

    # Update

    def updated(self, measurements: Measurements, origin: float, noise_factor: Tensor) -> Self:
        """The filter after the offsets between two frames, measured around the prediction.

        Args:
            measurements: Displacements (1, N, 2, 2) of the rows of two frames.
            origin: Time origin of the measurements in s.
            noise_factor: (A,) factor of the variance of the offsets, see ``VibrationTracker``.
        """
        jacobian, residual = self._linearised(measurements, origin)
        weights = 0.5 * measurements.weights[0].T * (measurements.num_differences[0] > 0)  # (A, N) of an offset
        weights = self._robust(jacobian, residual, weights) / noise_factor[:, None]
        weighted = jacobian * weights[:, None, :, None]
        normal, right = weighted.mT @ jacobian, (weighted.mT @ residual[..., None])[..., 0]
        scale = self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
        inverse_scale = torch.where(scale > 0, 1 / scale.clamp(min=1e-300), 0.0)
        correlation = self.covariance * inverse_scale[..., None] * inverse_scale[..., None, :]
        normal = normal * scale[..., None] * scale[..., None, :]
        eye = torch.eye(scale.shape[-1], dtype=torch.float64, device=scale.device)
        system = eye + correlation @ normal
        posterior = torch.linalg.solve(system, correlation)
        posterior = 0.5 * (posterior + posterior.mT) * scale[..., None] * scale[..., None, :]
        step = (posterior @ right[..., None])[..., 0]
        fit = (weights[:, None] * residual.square()).sum(-1) - (step * right).sum(-1)
        score = self.probability.log() - 0.5 * (fit + torch.linalg.slogdet(system).logabsdet)
        probability = score.softmax(-1).clamp(min=1e-6)  # a filter that failed must be able to return
        return self._with_values(self._values() + step, posterior, probability / probability.sum(-1, keepdim=True))

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
        size = jacobian.square().mean(1, keepdim=True).sqrt().clamp(min=1e-300)
        columns, root = jacobian / size, weights.sqrt()[..., None]
        eye = 1e-9 * weights.sum(-1)[:, None, None] * torch.eye(columns.shape[-1], dtype=torch.float64).to(columns)
        robust = weights
        for _ in range(2):
            weighted = columns * robust[..., None]
            solution = torch.linalg.solve(
                weighted.mT @ columns + eye + 1e-300 * torch.eye(len(eye[0])).to(eye), weighted.mT @ residual[..., None]
            )
            apart = (residual - (columns @ solution)[..., 0]) * root[..., 0]
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
        values, covariance = self._moments(self.probability[..., None])
        tones = values[:, 0, :-2].unflatten(-1, (-1, 4))
        place = torch.arange(values.shape[-1], device=values.device)
        keep = (place % 4 != 2) | (place >= 4 * self.tones)
        unit = torch.where((place % 4 == 3) & (place < 4 * self.tones), 0.5 / math.pi, 1.0).to(values)
        covariance = (covariance[:, 0] * unit[:, None] * unit)[:, keep][:, :, keep]
        coefficients = torch.complex(tones[..., 0], tones[..., 1])
        return ToneFit(
            coefficients[None],
            (tones[..., 3] / (2 * math.pi))[None],
            (coefficients.abs() > 0)[None],
            values[:, 0, -2:][None],
            torch.block_diag(*covariance)[None],
            values.new_tensor([self.time - origin]),
            MotionModel(1, 2),
        )


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
