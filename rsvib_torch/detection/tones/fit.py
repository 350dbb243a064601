"""Weighted fit of tones and an image motion to measured displacements (Eqs. 5-8, generalised)."""

from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.tone_model import MotionModel, ToneFit, drift_response, tone_columns

__all__ = ["fit_roughly", "fit_tones"]

_ITERATIONS, _FEW_ITERATIONS = 30, 5  # of a fit, and of one that another follows
_TOLERANCE, _ROUGH_TOLERANCE = 1e-7, 1e-4  # of the cost, of either: steps that promise less are not worth taking
_PARAMETERS = 3  # of a tone: real and imaginary part of its amplitude, and its frequency


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """How parameters are laid out: (B, 2, 3 K + J) of all tones and drifts, (B, M) of those that are free.

    Attributes:
        tones: K.
        model: What is fitted beside the tones.
        tie: (2 (3 K + J), M) matrix from free parameters to all.
        free: (B, M) bool, parameters of tones that exist.
        linear: (B, M) bool, those of them that are no frequencies.
        is_frequency: (3 K + J,) bool.
    """

    tones: int
    model: MotionModel
    tie: Tensor
    free: Tensor
    linear: Tensor
    is_frequency: Tensor

    @classmethod
    def of(cls, active: Tensor, model: MotionModel) -> "_Unknowns":
        """Layout for tones that are ``active`` (B, 2, K)."""
        tones, order = active.shape[-1], model.drift_order
        tie = torch.block_diag(*[_tie(model, tones, active.device)] * 2)
        of_tones = active[..., None].expand(-1, -1, -1, _PARAMETERS).flatten(-2)
        exist = torch.cat([of_tones, torch.ones_like(of_tones[..., :1]).expand(-1, -1, order)], -1)
        place = torch.arange(exist.shape[-1], device=active.device)
        is_frequency = (place < _PARAMETERS * tones) & (place % _PARAMETERS == _PARAMETERS - 1)
        free = exist.flatten(1).double() @ tie > 0
        linear = (exist & ~is_frequency).flatten(1).double() @ tie > 0
        return cls(tones, model, tie, free, linear, is_frequency)

    def unpack(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients (B, 2, K), frequencies (B, 2, K) and drifts (B, 2, J)."""
        end = _PARAMETERS * self.tones
        parts = values[..., :end].unflatten(-1, (self.tones, _PARAMETERS))
        return torch.complex(parts[..., 0], parts[..., 1]), parts[..., 2], values[..., end:]

    def pack(self, fit: ToneFit) -> Tensor:
        """The parameters (B, 2, 3 K + J) of a fit, of which ``unpack`` makes three."""
        tones = torch.stack([fit.coefficients.real, fit.coefficients.imag, fit.frequencies], -1).flatten(-2)
        return torch.cat([tones, fit.drift], -1)

    def moved(self, values: Tensor, step: Tensor) -> Tensor:
        """Parameters after a step (B, M) of the free ones; frequencies stay positive."""
        values = values + (step @ self.tie.T).unflatten(1, (2, -1))
        return torch.where(self.is_frequency, values.abs(), values)


@cache
def _tie(model: MotionModel, tones: int, device: torch.device) -> Tensor:
    """Matrix (3 K + J, M) from free parameters of an axis to all: harmonics share a frequency."""
    families = tones // model.harmonics
    size = _PARAMETERS * tones + model.drift_order
    matrix = torch.zeros(size, 2 * tones + families + model.drift_order, dtype=torch.float64, device=device)
    for tone in range(tones):
        matrix[_PARAMETERS * tone, 2 * tone] = matrix[_PARAMETERS * tone + 1, 2 * tone + 1] = 1.0
        family, harmonic = divmod(tone, model.harmonics)
        matrix[_PARAMETERS * tone + 2, 2 * tones + family] = harmonic + 1.0
    for power in range(model.drift_order):
        matrix[_PARAMETERS * tones + power, 2 * tones + families + power] = 1.0
    return matrix


@dataclass(frozen=True, eq=False)
class _State:
    """Parameters with what they leave.

    Attributes:
        values: (B, 2, 3 K + J) parameters.
        residual: (B, N, G, 2) px, what they leave of the displacements.
        cost: (B,) its weighted square.
        matrix: (B, M, M), normal matrix of the free parameters.
        right: (B, M), their right-hand side.
    """

    values: Tensor
    residual: Tensor
    cost: Tensor
    matrix: Tensor
    right: Tensor

    def replaced(self, where: Tensor, other: "_State") -> "_State":
        """This state, but the other's for the stacks (B,) where that is told."""

        def pick(name: str) -> Tensor:
            new, old = getattr(other, name), getattr(self, name)
            return torch.where(where.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

        return _State(*(pick(name) for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class _Problem:
    """Measurements as least squares of unit variance.

    Attributes:
        measurements: The displacements.
        drift_columns: (B, N, G, 2, J), what they see of unit drifts.
        root: (B, N, 1, 2, 2), upper triangle U with U^T U the information of a row.
    """

    measurements: Measurements
    drift_columns: Tensor
    root: Tensor

    @classmethod
    def of(cls, measurements: Measurements, model: MotionModel) -> "_Problem":
        """The problem that measurements pose."""
        first, both, second = (measurements.information[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        size = first.clamp(min=0.0).sqrt()
        slant = torch.where(size > 0, both / torch.where(size > 0, size, 1.0), 0.0)
        rest = (second - slant.square()).clamp(min=0.0).sqrt()
        root = torch.stack([size, slant, torch.zeros_like(size), rest], -1).unflatten(-1, (2, 2))[:, :, None]
        drifts = drift_response(measurements, model.drift_order)[..., None, :]
        return cls(measurements, drifts.expand(-1, -1, -1, 2, -1), root)

    def evaluate(self, unknowns: _Unknowns, values: Tensor) -> _State:
        """The state at parameters ``values`` (B, 2, 3 K + J)."""
        coefficients, hertz, _ = unknowns.unpack(values)
        columns = self.measurements.relative(tone_columns(self.measurements, coefficients, hertz).flatten(-2))
        jacobian = torch.cat([columns, self.drift_columns], dim=-1)  # (B, N, G, axis, parameter of the axis)
        linear = torch.where(unknowns.is_frequency, 0.0, values)[:, None, None]
        residual = self.measurements.displacements - (jacobian * linear).sum(-1)
        # (B, 2 N G, parameter of any axis)
        whole = (self.root[..., None] * jacobian[..., None, :, :]).flatten(-2).flatten(1, 3)
        told = (self.root @ residual[..., None]).flatten(1)
        matrix = unknowns.tie.T @ (whole.mT @ whole) @ unknowns.tie
        right = (whole.mT @ told[..., None])[..., 0] @ unknowns.tie
        return _State(values, residual, told.square().sum(-1), matrix, right)


def _step(state: _State, keep: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Step (B, M) of the parameters to ``keep`` (B, M), and the inverse of the damped normal matrix."""
    size = state.matrix.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(keep & (size > 1e-200), size.clamp(min=1e-200).rsqrt(), 0.0)
    matrix = state.matrix * scale[:, :, None] * scale[:, None]
    matrix = matrix + torch.diag_embed(torch.where(keep, 1e-12 + damping[:, None], 1.0))
    inverse = torch.linalg.inv(matrix) * scale[:, :, None] * scale[:, None]
    return (inverse @ state.right[..., None])[..., 0], inverse


def _solved(
    measurements: Measurements, start: Tensor | ToneFit, active: Tensor, model: MotionModel, *, rough: bool
) -> tuple[_Unknowns, _State]:
    """The least squares solution from start frequencies, or from another solution, as in ``fit_tones``."""
    iterations, tolerance = (_FEW_ITERATIONS, _ROUGH_TOLERANCE) if rough else (_ITERATIONS, _TOLERANCE)
    unknowns = _Unknowns.of(active, model)
    problem = _Problem.of(measurements, model)
    if isinstance(start, ToneFit):
        state = problem.evaluate(unknowns, unknowns.pack(start))
    else:
        values = start.new_zeros(len(start), 2, len(unknowns.is_frequency))
        values[..., unknowns.is_frequency] = torch.where(active, start, 0.0)
        state = problem.evaluate(unknowns, values)
        step, _ = _step(state, unknowns.linear, torch.zeros_like(state.cost))
        state = problem.evaluate(unknowns, unknowns.moved(values, step))
    damping = torch.full_like(state.cost, 1e-3)
    done = torch.zeros_like(state.cost, dtype=torch.bool)  # each stack stops by itself, whatever it is in a batch with
    for _ in range(iterations):
        step, _ = _step(state, unknowns.free, damping)
        done = done | ((step * state.right).sum(-1) <= tolerance * state.cost)  # what the step promises
        if bool(done.all()):
            break
        trial = problem.evaluate(unknowns, unknowns.moved(state.values, step))
        better = trial.cost <= state.cost
        state = state.replaced(better & ~done, trial)
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp(1e-12, 1e6)
    return unknowns, state


def fit_roughly(
    measurements: Measurements, frequencies: Tensor, active: Tensor, model: MotionModel
) -> tuple[ToneFit, Tensor]:
    """A few steps of ``fit_tones``, which another fit will follow.

    Returns:
        The fit, whose covariance has no meaning, and what it leaves of the displacements, (B, N, G, 2).
    """
    unknowns, state = _solved(measurements, frequencies, active, model, rough=True)
    coefficients, hertz, drift = unknowns.unpack(state.values)
    fit = ToneFit(coefficients, hertz, active, drift, state.matrix, measurements.centre, model)
    return fit, state.residual


def fit_tones(
    measurements: Measurements, start: Tensor | ToneFit, active: Tensor, model: MotionModel | None = None
) -> ToneFit:
    """Fit all tones of both axes and the image motion from start frequencies (weighted Levenberg-Marquardt).

    Amplitudes and phases need no start: they are linear once the frequencies are given. Inverting the offsets to the
    vibration (Eqs. 6-8 with the sign rule) is part of the model, so that a negative gain needs no special case.

    Args:
        measurements: The displacements.
        start: (B, 2, K) start frequencies in Hz; with harmonics, K a multiple of their number, each family base
            first. Or a fit of the same tones to these measurements, weighted otherwise: this one lies near it.
        active: (B, 2, K) bool, tones to fit; the others stay at zero.
        model: What is fitted beside the tones.

    Returns:
        The fit with its covariance, scaled by the observed residual.
    """
    model = model or MotionModel()
    unknowns, state = _solved(measurements, start, active, model, rough=False)
    _, inverse = _step(state, unknowns.free, torch.zeros_like(state.cost))
    spent = unknowns.free.unflatten(1, (2, -1)).sum(-1)
    coefficients, hertz, drift = unknowns.unpack(state.values)
    fit = ToneFit(coefficients, hertz, active, drift, inverse, measurements.centre, model)
    # overlapping bands repeat themselves: the information is that of the independent ones
    variance = measurements.square(state.residual).clamp(min=0.0) / (measurements.known - spent).clamp(min=1.0)
    deviation = variance.sqrt().repeat_interleave(state.values.shape[-1], dim=1)
    covariance = (unknowns.tie @ inverse @ unknowns.tie.T) * deviation[:, :, None] * deviation[:, None]
    return replace(fit, covariance=covariance)
