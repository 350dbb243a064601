"""Weighted fit of tones and an image motion to measured displacements (Eqs. 5-8, generalised)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones import MotionModel, ToneFit, drift_response, tone_response_and_slope

__all__ = ["fit_tones"]

_ITERATIONS = 30
_TOLERANCE = 1e-8  # of the cost: steps that promise less are not worth taking
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

    def moved(self, values: Tensor, step: Tensor) -> Tensor:
        """Parameters after a step (B, M) of the free ones; frequencies stay positive."""
        values = values + (step @ self.tie.T).unflatten(1, (2, -1))
        return torch.where(self.is_frequency, values.abs(), values)


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
    """Parameters with what they leave: cost (B,), normal matrix (B, M, M), right-hand side (B, M), residual."""

    values: Tensor
    cost: Tensor
    matrix: Tensor
    right: Tensor
    residual: Tensor

    def improved(self, trial: "_State") -> tuple["_State", Tensor]:
        """The better of two states, stack by stack, and where it is the trial."""
        better = trial.cost <= self.cost

        def pick(name: str) -> Tensor:
            new, old = getattr(trial, name), getattr(self, name)
            return torch.where(better.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

        return _State(*(pick(name) for name in self.__dataclass_fields__)), better


def _evaluate(measurements: Measurements, unknowns: _Unknowns, drift_columns: Tensor, values: Tensor) -> _State:
    coefficients, hertz, drift = unknowns.unpack(values)
    response, derivative = tone_response_and_slope(measurements, hertz)
    predicted = (coefficients[:, None, None] * response).real.sum(-1)
    predicted = predicted + torch.einsum("bngj,baj->bnga", drift_columns, drift)
    residual = measurements.relative(measurements.displacements - predicted)
    slope = (coefficients[:, None, None] * derivative).real
    columns = torch.stack([response.real, -response.imag, slope], dim=-1).flatten(-2)
    drifts = drift_columns[..., None, :].expand(*columns.shape[:-1], drift.shape[-1])
    jacobian = torch.cat([columns, drifts], dim=-1)
    # one matrix weighs both axes of a row: (B, N, G, axis, axis and parameter)
    information = measurements.information[:, :, None, :, :, None]
    weighted = (jacobian[:, :, :, None] * information).flatten(4)
    matrix = torch.einsum("bngcp,bngcj->bpcj", weighted, jacobian).flatten(2)
    right = torch.einsum("bngcp,bngc->bp", weighted, residual)
    cost = measurements.square(residual).sum(-1)
    return _State(values, cost, unknowns.tie.T @ matrix @ unknowns.tie, right @ unknowns.tie, residual)


def _step(state: _State, keep: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Step (B, M) of the parameters to ``keep`` (B, M), and the inverse of the damped normal matrix."""
    size = state.matrix.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(keep & (size > 1e-200), size.clamp(min=1e-200).rsqrt(), 0.0)
    matrix = state.matrix * scale[:, :, None] * scale[:, None]
    matrix = matrix + torch.diag_embed(torch.where(keep, 1e-12 + damping[:, None], 1.0))
    inverse = torch.linalg.inv(matrix) * scale[:, :, None] * scale[:, None]
    return (inverse @ state.right[..., None])[..., 0], inverse


def fit_tones(
    measurements: Measurements,
    frequencies: Tensor,
    active: Tensor,
    model: MotionModel | None = None,
    iterations: int = _ITERATIONS,
) -> ToneFit:
    """Fit all tones of both axes and the image motion from start frequencies (weighted Levenberg-Marquardt).

    Amplitudes and phases need no start: they are linear once the frequencies are given. Inverting the offsets to the
    vibration (Eqs. 6-8 with the sign rule) is part of the model, so that a negative gain needs no special case.

    Args:
        measurements: The displacements.
        frequencies: (B, 2, K) start frequencies in Hz; with harmonics, K a multiple of their number, each family
            base first.
        active: (B, 2, K) bool, tones to fit; the others stay at zero.
        model: What is fitted beside the tones.
        iterations: Steps at most.

    Returns:
        The fit with its covariance, scaled by the observed residual.
    """
    model = model or MotionModel()
    unknowns = _Unknowns.of(active, model)
    drift_columns = drift_response(measurements, model.drift_order)
    values = frequencies.new_zeros(len(frequencies), 2, len(unknowns.is_frequency))
    values[..., unknowns.is_frequency] = torch.where(active, frequencies, 0.0)

    state = _evaluate(measurements, unknowns, drift_columns, values)
    none = torch.zeros_like(state.cost)
    step, _ = _step(state, unknowns.linear, none)
    state = _evaluate(measurements, unknowns, drift_columns, unknowns.moved(values, step))
    damping = torch.full_like(state.cost, 1e-3)
    for _ in range(iterations):
        step, _ = _step(state, unknowns.free, damping)
        done = (step * state.right).sum(-1) <= _TOLERANCE * state.cost  # what the step promises
        trial = _evaluate(measurements, unknowns, drift_columns, unknowns.moved(state.values, step))
        state, better = state.improved(trial)
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp(1e-12, 1e6)
        if bool(done.all()):
            break
    _, inverse = _step(state, unknowns.free, none)
    spent = unknowns.free.unflatten(1, (2, -1)).sum(-1)
    # overlapping bands repeat themselves: the information is that of the independent ones
    variance = measurements.square(state.residual).clamp(min=0.0) / (measurements.known - spent).clamp(min=1.0)
    deviation = variance.sqrt().repeat_interleave(values.shape[-1], dim=1)
    covariance = (unknowns.tie @ inverse @ unknowns.tie.T) * deviation[:, :, None] * deviation[:, None]
    coefficients, hertz, drift = unknowns.unpack(state.values)
    return ToneFit(coefficients, hertz, active, drift, covariance, measurements.centre, model)
