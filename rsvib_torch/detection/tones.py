"""Weighted fit of tones and a uniform motion to measured offsets (Eqs. 5-8, generalised)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Measurements", "ToneFit", "fit_tones", "model_offsets"]

_ITERATIONS = 30
_PARAMETERS = 3  # of a tone: real and imaginary part of its amplitude, and its frequency


@dataclass(frozen=True, eq=False)
class Measurements:
    """Offsets of a batch of stacks, in row order; images and their registration are left behind here.

    Attributes:
        starts: (B, M) float64 s, exposure starts of the rows in the earlier frames.
        later_starts: (B, M) float64 s, exposure starts of the matching rows in the later frames.
        offsets: (B, M, 2) float64 px, axes (x, y); 0 where unknown.
        information: (B, M, 2, 2) float64 px^-2, inverse covariance of the offsets up to a common factor; 0 where
            unknown.
        exposure_time: T_e in seconds.
        average_times: Duration over which each offset (x, y) is an average: the rows of a band times the row time.
        independent: Fraction of the measurements that are independent (bands may overlap).
    """

    starts: Tensor
    later_starts: Tensor
    offsets: Tensor
    information: Tensor
    exposure_time: float
    average_times: tuple[float, float]
    independent: float = 1.0

    @property
    def centre(self) -> Tensor:
        """(B,) mid-time of the record in seconds: phases are fitted there, where they depend least on frequency."""
        return 0.5 * (self.starts.amin(1) + self.later_starts.amax(1) + self.exposure_time)

    @property
    def duration(self) -> Tensor:
        """(B,) seconds from the first to the last measurement."""
        return self.starts.amax(1) - self.starts.amin(1)

    @property
    def weights(self) -> Tensor:
        """(B, M, 2) information of each axis alone."""
        return self.information.diagonal(dim1=-2, dim2=-1)

    def grouped(self, size: int) -> "Measurements":
        """Weighted means of groups of ``size`` neighbouring measurements, each axis for itself."""
        if size <= 1:
            return self
        count = self.offsets.shape[1] // size * size
        weights = self.weights[:, :count].unflatten(1, (-1, size))
        total = weights.sum(2)
        values = (weights * self.offsets[:, :count].unflatten(1, (-1, size))).sum(2) / total.clamp(min=1e-300)
        starts, later = (t[:, :count].unflatten(1, (-1, size)).mean(2) for t in (self.starts, self.later_starts))
        return Measurements(starts, later, values, torch.diag_embed(total), self.exposure_time, self.average_times)


@dataclass(frozen=True, eq=False)
class ToneFit:
    """Tones and motion: ``D(t) = Re sum_k C_k exp(2 pi i f_k (t - centre)) + v t`` per axis.

    Attributes:
        coefficients: (B, 2, K) complex128 C in px.
        frequencies: (B, 2, K) float64 Hz.
        active: (B, 2, K) bool, tones that exist.
        motion: (B, 2) float64 v in px/s.
        covariance: (B, N, N) float64, N = 2 (3 K + 1), of [Re C, Im C, f of each tone, v] of x, then of y.
        chi_square: (B, 2) float64, weighted sum of squared residuals of each axis.
    """

    coefficients: Tensor
    frequencies: Tensor
    active: Tensor
    motion: Tensor
    covariance: Tensor
    chi_square: Tensor


def tone_response(measurements: Measurements, frequencies: Tensor) -> tuple[Tensor, Tensor]:
    """What an offset sees of unit tones, and its derivative by frequency.

    ``g(f) = S(f) [exp(2 pi i f (t' - c)) - exp(2 pi i f (t - c))]`` at mid-exposures t and t' of the matched rows, with
    ``S(f) = sinc(f T_e) sinc(f h T_row)``: exposure (Eq. 2), gain (Eq. 4) and band average in one, and the coupling of
    the scan with motion along it through t'.

    Args:
        measurements: The offsets.
        frequencies: (B, 2, K) Hz.

    Returns:
        Two complex128 tensors (B, M, 2, K).
    """
    middle = 0.5 * measurements.exposure_time - measurements.centre[:, None]
    f = frequencies[:, None]
    early, late = ((t + middle)[..., None, None] for t in (measurements.starts, measurements.later_starts))
    turn_early, turn_late = (torch.exp(2j * math.pi * f * t) for t in (early, late))
    average = torch.tensor(measurements.average_times, dtype=f.dtype, device=f.device)[:, None]
    exposure, exposure_slope = _sinc(f * measurements.exposure_time)
    band, band_slope = _sinc(f * average)
    attenuation = exposure * band
    slope = exposure_slope * measurements.exposure_time * band + exposure * band_slope * average
    difference = turn_late - turn_early
    derivative = slope * difference + attenuation * 2j * math.pi * (late * turn_late - early * turn_early)
    return attenuation * difference, derivative


def _sinc(x: Tensor) -> tuple[Tensor, Tensor]:
    """sin(pi x) / (pi x) and its derivative."""
    value = torch.sinc(x)
    small = x.abs() < 1e-4
    slope = (torch.cos(math.pi * x) - value) / torch.where(small, 1.0, x)
    return value, torch.where(small, -(math.pi**2) * x / 3, slope)


def model_offsets(measurements: Measurements, fit: ToneFit) -> Tensor:
    """Offsets (B, M, 2) in px that the fitted motion predicts at the measurements."""
    response, _ = tone_response(measurements, fit.frequencies)
    tones = (fit.coefficients[:, None] * response).real.sum(-1)
    interval = measurements.later_starts - measurements.starts
    return tones + fit.motion[:, None] * interval[..., None]


def _jacobian(measurements: Measurements, coefficients: Tensor, frequencies: Tensor) -> Tensor:
    """Derivatives (B, M, 2, 3 K + 1) of the offsets of each axis by the parameters of that axis."""
    response, derivative = tone_response(measurements, frequencies)
    tones = torch.stack([response.real, -response.imag, (coefficients[:, None] * derivative).real], dim=-1).flatten(-2)
    interval = (measurements.later_starts - measurements.starts)[..., None, None].expand(*tones.shape[:-1], 1)
    return torch.cat([tones, interval], dim=-1)


def _normal_equations(measurements: Measurements, jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Normal matrix (B, 2 n, 2 n) and right-hand side (B, 2 n) of both axes together."""
    count = jacobian.shape[-1]
    blocks = torch.einsum("bmai,bmac,bmcj->baicj", jacobian, measurements.information, jacobian)
    right = torch.einsum("bmai,bmac,bmc->bai", jacobian, measurements.information, residual)
    return blocks.reshape(len(blocks), 2 * count, 2 * count), right.flatten(1)


def _chi_square(measurements: Measurements, residual: Tensor) -> Tensor:
    return (residual * torch.einsum("bmac,bmc->bma", measurements.information, residual)).sum(1)


def fit_tones(
    measurements: Measurements, frequencies: Tensor, active: Tensor, iterations: int = _ITERATIONS
) -> ToneFit:
    """Fit all tones of both axes and the motion from start frequencies (weighted Levenberg-Marquardt).

    Amplitudes and phases need no start: they are linear once the frequencies are given. Inverting the offsets to the
    vibration (Eqs. 6-8 with the sign rule) is part of the model, so that a negative gain needs no special case.

    Args:
        measurements: The offsets.
        frequencies: (B, 2, K) start frequencies in Hz.
        active: (B, 2, K) bool, tones to fit; the others stay at zero.
        iterations: Steps at most.

    Returns:
        The fit with its covariance, scaled by the observed residual.
    """
    batch, _, tones = frequencies.shape
    size = _PARAMETERS * tones + 1
    free = torch.cat(
        [active[..., None].expand(-1, -1, -1, _PARAMETERS).flatten(-2), torch.ones_like(active[..., :1])], -1
    ).flatten(1)
    linear = free & (torch.arange(2 * size, device=free.device) % size % _PARAMETERS != _PARAMETERS - 1)
    frequencies = torch.where(active, frequencies, 0.0)
    parameters = frequencies.new_zeros(batch, 2, size)
    parameters[..., 2:-1:_PARAMETERS] = frequencies

    def unpack(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        parts = values[..., :-1].unflatten(-1, (tones, _PARAMETERS))
        return torch.complex(parts[..., 0], parts[..., 1]), parts[..., 2], values[..., -1]

    def residual_of(values: Tensor) -> Tensor:
        coefficients, hertz, motion = unpack(values)
        fit = ToneFit(coefficients, hertz, active, motion, values, values)
        return measurements.offsets - model_offsets(measurements, fit)

    def solve(values: Tensor, residual: Tensor, keep: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
        coefficients, hertz, _ = unpack(values)
        matrix, right = _normal_equations(measurements, _jacobian(measurements, coefficients, hertz), residual)
        scale = matrix.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
        scale = torch.where(keep, scale, 0.0)
        matrix = matrix * scale[:, :, None] * scale[:, None]
        lift = torch.where(keep, 1e-12 + damping[:, None], 1.0)
        matrix = matrix + torch.diag_embed(lift)
        step = torch.linalg.solve(matrix, (right * scale)[..., None])[..., 0] * scale
        return step.unflatten(1, (2, size)), torch.linalg.inv(matrix) * scale[:, :, None] * scale[:, None]

    none = parameters.new_zeros(batch)
    step, _ = solve(parameters, residual_of(parameters), linear, none)
    parameters = parameters + step
    residual = residual_of(parameters)
    cost = _chi_square(measurements, residual).sum(-1)
    damping = torch.full_like(cost, 1e-3)
    for _ in range(iterations):
        step, _ = solve(parameters, residual, free, damping)
        trial = parameters + step
        trial[..., 2:-1:_PARAMETERS] = trial[..., 2:-1:_PARAMETERS].abs()
        trial_residual = residual_of(trial)
        trial_cost = _chi_square(measurements, trial_residual).sum(-1)
        better = trial_cost <= cost
        parameters = torch.where(better[:, None, None], trial, parameters)
        residual = torch.where(better[:, None, None], trial_residual, residual)
        gained = torch.where(better, cost - trial_cost, cost)
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp(1e-12, 1e6)
        cost = torch.where(better, trial_cost, cost)
        if bool((better & (gained <= 1e-12 * cost)).all()):
            break
    _, covariance = solve(parameters, residual, free, none)
    chi_square = _chi_square(measurements, residual)
    known = (measurements.weights > 0).sum(1) * measurements.independent
    spent = free.unflatten(1, (2, size)).sum(-1)
    variance = chi_square / ((known - spent).clamp(min=1.0) / measurements.independent)
    # overlapping bands repeat themselves: the information is that of the independent ones
    deviation = (variance / measurements.independent).sqrt().repeat_interleave(size, dim=1)
    covariance = covariance * deviation[:, :, None] * deviation[:, None]
    coefficients, hertz, motion = unpack(parameters)
    return ToneFit(coefficients, hertz, active, motion, covariance, chi_square)
