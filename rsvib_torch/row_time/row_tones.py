"""Tones with independent frequencies per row and per frame: what frames determine without the row time.

The displacement of row r of frame g by a tone is ``Re C exp(2 pi i (nu r + phi g))`` with ``nu = f T_row`` cycles per
row and ``phi = f P`` cycles per frame of period P. Frames determine phi up to a whole number k. Each k is a candidate
``f = (phi + k) / P``, ``T_row = nu P / (phi + k)``; a negative row time means the opposite readout direction. Tones of
different frequencies have only some row times in common.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.detection.tones.fit import MIN_GAIN

F_THRESHOLD = 14.0  # decrease of chi-square per parameter, as for tones of known timing (tones/selection.py)
MAX_CHI_SQUARE = 30.0  # above that of the best row time, for another one that explains the frames as well
MIN_SHARE = 0.2  # of the residual sum of squares that a further tone must explain


@dataclass(frozen=True, eq=False)
class RowRecord:
    """Displacements of scene rows along one axis, with the frames and the frame rows that they were measured in."""

    rows: Tensor  # (N, G) frame rows, from the middle row
    frames: Tensor  # (N, G) indices of the frames, from the middle frame
    values: Tensor  # (N, G) px, displacements less their mean over the frames that contain the scene row
    visible: Tensor  # (N, G) 1 where a frame contains the row, else 0
    weights: Tensor  # (N,) px^-2
    independent: float  # fraction of the measurements that are independent
    row_part: float  # assumed ratio of row time to frame period, for the drift of rows within a frame

    def relative(self, values: Tensor) -> Tensor:
        """Values (N, G, ...) less their mean over the frames that contain the row; 0 in other frames."""
        seen = self.visible.reshape(*self.visible.shape, *(1,) * (values.ndim - 2))
        mean = (seen * values).sum(1, keepdim=True) / seen.sum(1, keepdim=True).clamp(min=1.0)
        return seen * (values - mean)

    @property
    def num_measurements(self) -> float:
        """Number of independent differences."""
        differences = (self.visible.sum(1) - 1).clamp(min=0.0)
        return float(((self.weights > 0) * differences).sum()) * float(self.independent)


@dataclass(frozen=True, eq=False)
class RowTones:
    """Fitted tones of one axis."""

    values: Tensor  # (4 K + 1,) parameters: Re C, Im C in px, nu, phi of each tone, and the drift in px per frame
    covariance: Tensor  # (4 K + 1, 4 K + 1)
    residual: Tensor  # (N, G) px
    cost: float  # weighted square of the residual

    @property
    def tones(self) -> Tensor:
        """(K, 4) parameters of the tones."""
        tones: Tensor = self.values[:-1].unflatten(0, (-1, 4))
        return tones

    def frequencies(self) -> tuple[Tensor, Tensor]:
        """(K, 2) cycles per row and per frame, and their covariances (K, 2, 2)."""
        blocks = [self.covariance[4 * k + 2 : 4 * k + 4, 4 * k + 2 : 4 * k + 4] for k in range(len(self.tones))]
        return self.tones[:, 2:], torch.stack(blocks) if blocks else self.covariance.new_zeros(0, 2, 2)


def _model(record: RowRecord, values: Tensor) -> tuple[Tensor, Tensor]:
    """Displacements (N, G) of parameters (4 K + 1,), and their derivatives (N, G, 4 K + 1)."""
    tones = values[:-1].unflatten(0, (-1, 4))
    angle = 2 * math.pi * (tones[:, 2] * record.rows[..., None] + tones[:, 3] * record.frames[..., None])
    cosine, sine = angle.cos(), angle.sin()
    by_angle = -2 * math.pi * (tones[:, 0] * sine + tones[:, 1] * cosine)
    columns = torch.stack(
        [cosine, -sine, by_angle * record.rows[..., None], by_angle * record.frames[..., None]], -1
    ).flatten(-2)
    drift = record.frames + record.row_part * record.rows
    value = (tones[:, 0] * cosine - tones[:, 1] * sine).sum(-1) + values[-1] * drift
    return record.relative(value), record.relative(torch.cat([columns, drift[..., None]], -1))


def fit_row_tones(record: RowRecord, start: Tensor, *, iterations: int = 20) -> RowTones:
    """Weighted least squares (Levenberg-Marquardt) from start parameters (4 K + 1,)."""
    root = record.weights.sqrt()[:, None]

    def evaluate(values: Tensor) -> tuple[Tensor, Tensor, Tensor, float]:
        value, columns = _model(record, values)
        residual = record.values - value
        columns = (root[..., None] * columns).flatten(0, 1)
        cost = float((root * residual).square().sum())
        return residual, columns.mT @ columns, columns.mT @ (root * residual).flatten(), cost

    values, damping = start.clone(), 1e-3
    residual, matrix, right, cost = evaluate(values)
    eye = torch.eye(len(values), dtype=values.dtype, device=values.device)

    def solved(damped: float) -> tuple[Tensor, Tensor]:
        scale = matrix.diagonal().clamp(min=1e-200).rsqrt()
        inverse = torch.linalg.inv(matrix * scale[:, None] * scale + (1e-12 + damped) * eye) * scale[:, None] * scale
        return inverse @ right, inverse

    for _ in range(iterations):
        step, _ = solved(damping)
        if float(step @ right) <= 1e-9 * cost:
            break
        trial = evaluate(values + step)
        if trial[3] <= cost:
            values = values + step
            residual, matrix, right, cost = trial
            damping = max(0.1 * damping, 1e-12)
        else:
            damping *= 10.0
    spare = max(1.0, record.num_measurements - len(values))
    return RowTones(values, solved(0.0)[1] * (cost / spare), residual, cost)


def _linear(record: RowRecord, values: Tensor, nu: float, phi: float) -> Tensor:
    """Parameters with a further tone of given frequencies, whose coefficient is fitted to the residual."""
    extended = torch.cat([values[:-1], values.new_tensor([0.0, 0.0, nu, phi]), values[-1:]])
    value, columns = _model(record, extended)
    columns = columns[..., -5:-3].flatten(0, 1)
    weight = record.weights[:, None].expand_as(value).flatten()[:, None]
    gram = columns.mT @ (weight * columns)
    gram = gram + 1e-9 * gram.diagonal().mean() * torch.eye(2).to(gram)
    extended[-5:-3] = torch.linalg.solve(gram, columns.mT @ (weight[:, 0] * (record.values - value).flatten()))
    return extended


def _peaks(record: RowRecord, residual: Tensor, highest: float, count: int) -> list[tuple[float, float]]:
    """The strongest peaks (nu, phi) of the periodogram of the differences between neighbouring frames.

    A difference of a tone between neighbouring frames is a tone with the same nu and phi, of another amplitude.
    """
    both = record.visible[:, 1:] * record.visible[:, :-1]
    weight = (record.weights[:, None] * both).flatten()
    difference = (residual[:, 1:] - residual[:, :-1]).flatten()
    difference = difference - (weight * difference).sum() / weight.sum().clamp(min=1e-300)
    rows, frames = record.rows[:, :-1].flatten(), record.frames[:, :-1].flatten()
    num_rows = float(record.rows.amax() - record.rows.amin()) + 1.0
    num_frames = round(float(record.frames.amax() - record.frames.amin())) + 1
    nu = torch.arange(0.0, highest, 1 / (4 * num_rows), dtype=rows.dtype, device=rows.device)
    phi = torch.arange(0.0, 1.0, 1 / (8 * num_frames), dtype=rows.dtype, device=rows.device)
    along = torch.polar(weight * difference, -2 * math.pi * nu[:, None] * rows)  # (V, S)
    across = torch.polar(torch.ones_like(frames), -2 * math.pi * phi[:, None] * frames)  # (F, S)
    power = (along @ across.mT).abs()
    padded = torch.nn.functional.pad(power[None], (1, 1), mode="circular")
    padded = torch.nn.functional.pad(padded, (0, 0, 1, 1), value=-1.0)
    largest = torch.nn.functional.max_pool2d(padded, 3, stride=1)[0]
    best = torch.where(power == largest, power, -1.0).flatten().topk(count).indices.tolist()
    return [(float(nu[i // len(phi)]), float(phi[i % len(phi)])) for i in best]


def find_row_tones(record: RowRecord, highest: float, *, max_tones: int = 4) -> RowTones:
    """Find and fit the tones of one axis, strongest first, until the next one is not significant.

    The search ends at ``highest`` cycles per row.
    """
    found = fit_row_tones(record, record.values.new_zeros(1))
    for _ in range(max_tones):
        tried = [
            fit_row_tones(record, _linear(record, found.values, nu, phi), iterations=40)
            for nu, phi in _peaks(record, found.residual, highest, 4)
        ]
        # nearly blind tones have arbitrary amplitudes, and explain nothing that others do not
        tried = [fit for fit in tried if bool((2 * (math.pi * fit.tones[:, 3]).sin().abs() > MIN_GAIN).all())]
        if not tried:
            break
        trial = min(tried, key=lambda fit: fit.cost)
        spare = record.num_measurements - len(trial.values)
        if spare < len(trial.values) or found.cost - trial.cost <= max(
            F_THRESHOLD * 4 * trial.cost / spare, MIN_SHARE * found.cost
        ):
            break
        found = trial
    return found


# Candidates


@dataclass(frozen=True)
class Candidate:
    """A row time that agrees with the tones."""

    row_time: float  # seconds, negative for a reverse readout
    std: float  # its standard deviation
    # sum over the tones of the squared distance of ``nu P / T_row - phi`` from a whole number, over its variance
    chi_square: float


def candidates(
    frequencies: Tensor, covariances: Tensor, period: float, low: float, high: float, *, floor: float = 1e-5
) -> list[Candidate]:
    """All row times with ``low <= |T_row| <= high`` that are a local minimum of chi-square, the best first.

    Frequencies (K, 2) are in cycles per row and per frame, with covariances (K, 2, 2); times are in s. ``floor`` is an
    error of phi in cycles that is assumed in addition.
    """
    nu, phi = frequencies.unbind(-1)

    def misfit(inverse: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (K,) from a whole number in cycles and its variance, for ``P / T_row`` (..., 1)."""
        value = nu * inverse - phi
        variance = inverse.square() * covariances[:, 0, 0] - 2 * inverse * covariances[:, 0, 1] + covariances[:, 1, 1]
        return value - value.round(), variance + floor**2

    found: list[Candidate] = []
    for tone in range(len(nu)):
        near, far = float(nu[tone]) * period / high, float(nu[tone]) * period / low
        for sign in (1.0, -1.0):
            bounds = sorted((sign * near, sign * far))
            first, last = (math.ceil(bounds[0] - float(phi[tone])), math.floor(bounds[1] - float(phi[tone])))
            for k in range(first, last + 1):
                inverse = (phi[tone] + k) / nu[tone].clamp(min=1e-12)
                for _ in range(5):
                    distance, variance = misfit(inverse)
                    information = (nu.square() / variance).sum()
                    inverse = inverse - (nu * distance / variance).sum() / information
                distance, variance = misfit(inverse)
                row_time = period / float(inverse)
                std = abs(row_time) * float((nu.square() / variance).sum().rsqrt() / inverse.abs())
                if not low <= abs(row_time) <= high or any(
                    abs(row_time - other.row_time) < 1e-3 * std + 1e-9 * high for other in found
                ):
                    continue
                found.append(Candidate(row_time, std, float((distance.square() / variance).sum())))
    return sorted(found, key=lambda candidate: candidate.chi_square)
