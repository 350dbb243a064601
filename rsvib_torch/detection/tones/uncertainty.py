"""Uncertainty of a fit that its residual does not contain: aliasing, slow errors, further tones.

Each effect of response Z and size v changes the parameters of the fit by ``-X^+ Z v`` to first order, X being the
whitened Jacobian of the free parameters. An uncertainty C of v therefore adds ``X^+ Z C (X^+ Z)^T`` to their covariance
(``LinearisedFit``).

*Aliasing.* Frames contain an aliased part of the scene, which a displacement d multiplies by ``exp(2 pi i d)`` along
its axis whatever its frequency. It biases the displacement of a row in frame p, relative to the mean over the G
frames, by

    b / G sum_q sin(2 pi (d_p - d_q))

with one size b for each axis. With four frames, b is 2e-3 px for optics of 0.3 px (Gaussian, standard deviation) and
below 3e-5 px for 0.7 px. The phase of the bias turns with every pixel of displacement, so that motions of more than
about 1 px determine b from the residuals.

*Further tones.* A record of few frames often agrees with several numbers of tones. The covariance of a fit holds for
its number only. It is extended by the mean over models with a further tone of any frequency, each weighted with its
probability (Bayesian model averaging: Hoeting et al., Statistical Science 14, 382, 1999). With the response Z of the
further tone without the part that X explains, and the prior covariance ``s^2 I`` of its two quadratures v, the residual
r gives

    C = (Z^T Z + I / s^2)^-1,    v = C Z^T r,    ln B = -1/2 ln |I + s^2 Z^T Z| + 1/2 v^T C^-1 v

with the ratio B of the evidences with and without the tone, whose uncertainty is ``C + v v^T``.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.measurements import Measurements, cholesky_root
from rsvib_torch.detection.tones.fit import (
    ToneFit,
    axis_jacobian,
    displacement_jacobian,
    displacement_std,
    model_displacements,
    residual_of,
    tone_response,
)

__all__ = ["with_further_tones", "without_aliasing"]

# standard deviation of the quadratures of the further tone over the norm of the amplitudes; 95 to 96 % of the 95 %
# intervals of 150 simulated recordings with random tones contain the truth, with 0.2 fewer
_PRIOR_SIZE = 0.5
# Standard deviation of the quadratures of slow errors over the rms offset. An error of a few thousandths of a pixel
# changes the amplitude of a tone of less than a period by a tenth: of 46 axes with 0.58 periods, one had 5.6 standard
# deviations without this term, and 3.7 with it. The intervals of faster tones contain the truth without it.
_SLOW_ERROR, _MAX_SLOW_ERROR = 5e-4, 2e-3  # -, px
_SLOW = 2.0  # periods in the record
_POINTS = 4  # frequencies per 1 / duration of the record
_REACH = 8  # distance of the frequencies from those of the tones, and from 0, times the duration
_CHUNK = 2**22  # values at a time


# --- Linearised fit ---


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """A fit linearised at its parameters, for errors of variance 1: of one axis, or of all axes together.

    x and y of a row are nearly independent, and each axis is a problem of its own. With roll and zoom, the components
    of a row are strongly correlated, and X contains the parameters of all axes: the displacement along x of all rows
    determines roll as well.

    Attributes:
        axes: The A axes of the problem.
        root: (B, N, A, A) from px to standard deviations.
        jacobian: X (B, D, A M), D = N G A.
        inverse: X^+ (B, A M, D).
        residual: (B, D) of the fit.
        to_all: (P, M), from the free parameters of an axis to all.
    """

    axes: list[int]
    root: Tensor
    jacobian: Tensor
    inverse: Tensor
    residual: Tensor
    to_all: Tensor

    @classmethod
    def of_axes(cls, measurements: Measurements, fit: ToneFit, axes: list[int]) -> "LinearisedFit":
        """The problem of one axis, or of all."""
        residual = residual_of(measurements, fit)[..., axes]
        jacobians, constraints = zip(*(axis_jacobian(measurements, fit, one) for one in axes), strict=True)
        jacobian = torch.stack(jacobians, 3)  # (B, N, G, A, M)
        spent = (jacobian.square().amax((1, 2)) > 0).sum((1, 2))
        spare = (measurements.num_measurements[:, axes].sum(1) - spent).clamp(min=1.0)
        one = measurements.inverse_variances[..., axes, None] if len(axes) == 1 else measurements.information
        root = cholesky_root(one)
        whitened = (root[:, :, None] @ residual[..., None]).flatten(1)
        deviation = (whitened.square().sum(1) / spare).clamp(min=1e-300).sqrt()[:, None, None, None]
        root = root / deviation
        X = (root[:, :, None, :, :, None] * jacobian[..., None, :, :]).flatten(-2).flatten(1, 3)
        return cls(axes, root, X, torch.linalg.pinv(X), whitened / deviation[:, :, 0, 0], constraints[0])

    def rounding(self, axis: int) -> Tensor:
        """(B,) error of the squared norm of whitened responses of about 1 px, for displacements without noise."""
        return 1e-12 * self.root[..., self.axes.index(axis)].square().sum((1, 2))

    def unexplained(self, response: Tensor, axis: int) -> tuple[Tensor, Tensor]:
        """Part of a response that the parameters do not explain, and the change of the parameters by it.

        Args:
            response: (B, N, G, Q) displacements of an axis in px by unit effects.
            axis: The axis.

        Returns:
            Whitened responses (B, D, Q) and ``X^+ Z`` (B, A M, Q).
        """
        root = self.root[..., self.axes.index(axis)]
        Z = (root[:, :, None, :, None] * response[:, :, :, None]).flatten(1, 3)
        change = self.inverse @ Z
        return Z - self.jacobian @ change, change

    def add_covariance(self, total: Tensor, added: Tensor) -> None:
        """Add a covariance (B, A M, A M) of the free parameters to that of all of a fit (B, A' P, A' P), in place."""
        count = len(self.axes)
        blocks = added.unflatten(-1, (count, -1)).unflatten(1, (count, -1))
        # from the free parameters m, n of axes i, j to all parameters p, q of these axes
        blocks = torch.einsum("pm,bimjn,qn->bipjq", self.to_all, blocks, self.to_all)
        size = len(self.to_all)
        of_parameters = total.view(len(total), total.shape[-1] // size, size, -1, size)
        for row, first in enumerate(self.axes):
            for column, second in enumerate(self.axes):
                of_parameters[:, first, :, second] += blocks[:, row, :, column]

    def add_change(self, total: Tensor, change: Tensor) -> None:
        """Add a change (B, A M) of the free parameters to that of all of a fit (B, A', P), in place."""
        total[:, self.axes] += change.unflatten(-1, (len(self.axes), -1)) @ self.to_all.T


def _problems(measurements: Measurements, fit: ToneFit) -> list[tuple[int, LinearisedFit]]:
    """Each axis with the problem that contains it."""
    axes = list(range(fit.coefficients.shape[1]))
    if len(axes) == 2:
        return [(axis, LinearisedFit.of_axes(measurements, fit, [axis])) for axis in axes]
    together = LinearisedFit.of_axes(measurements, fit, axes)
    return [(axis, together) for axis in axes]


# --- Aliasing ---


def without_aliasing(measurements: Measurements, fit: ToneFit, size: Tensor) -> ToneFit:
    """The fit without the error by aliasing of x and y, and with its remaining uncertainty in the covariance.

    Args:
        measurements: The measurements of the fit, with its weights.
        fit: With its covariance.
        size: (B,) px, prior standard deviation of b.
    """
    precision = size.clamp(min=1e-9).square().reciprocal()[:, None]
    covariance, axes = fit.covariance.clone(), fit.drift.shape[1]
    change = fit.drift.new_zeros(len(covariance), axes, covariance.shape[-1] // axes)
    bias = _unit_bias(measurements, model_displacements(measurements, fit))
    for axis, problem in _problems(measurements, fit)[:2]:
        Z, by_unit = problem.unexplained(bias[..., axis, None], axis)
        variance = 1 / (Z.square().sum(1) + problem.rounding(axis)[:, None] + precision)  # (B, 1), of b
        b = variance * (Z[..., 0] * problem.residual).sum(1, keepdim=True)
        problem.add_covariance(covariance, by_unit * variance[..., None] @ by_unit.mT)
        problem.add_change(change, -b * by_unit[..., 0])
    tones, drift = change.split((3 * fit.frequencies.shape[-1], fit.drift.shape[-1]), dim=-1)
    real, imaginary, frequency = tones.unflatten(-1, (-1, 3)).unbind(-1)
    return replace(
        fit,
        coefficients=fit.coefficients + torch.complex(real, imaginary),
        frequencies=(fit.frequencies + frequency).clamp(min=0.0),
        drift=fit.drift + drift,
        covariance=covariance,
    )


def _unit_bias(measurements: Measurements, displacements: Tensor) -> Tensor:
    """Bias (B, N, G, A) of relative displacements of that shape, for b = 1."""
    angle = 2 * math.pi * displacements
    turn = torch.polar(torch.ones_like(angle), angle)
    visible = measurements.visible[..., None]
    mean = (visible * turn).sum(2, keepdim=True) / visible.sum(2, keepdim=True).clamp(min=1.0)
    return measurements.relative((turn * mean.conj()).imag)


# --- Further tones and slow errors ---


def with_further_tones(
    measurements: Measurements, fit: ToneFit, exposure_starts: Tensor, *, number_is_known: bool = False
) -> tuple[ToneFit, Tensor]:
    """The fit with a covariance that allows for a further tone, and the uncertainty of the displacement of the rows.

    Args:
        measurements: The measurements of the fit, with its weights.
        fit: With the covariance of its own parameters.
        exposure_starts: (N,) s, exposure starts of the rows.
        number_is_known: Whether there are no further tones; slow errors remain.

    Returns:
        The fit, and the standard deviation (B, A) in px of the displacement of rows without their mean, rms over the
        rows; the effect of a further tone is that without linear trend, which the image motion contains.
    """
    covariance, rows = fit.covariance.clone(), exposure_starts.expand(len(fit.centre), -1)
    variance = displacement_std(fit, exposure_starts, measurements.exposure_time).square()
    jacobian = displacement_jacobian(fit, rows, measurements.exposure_time)
    slow_errors = _slow_errors(measurements, fit)
    for axis, problem in _problems(measurements, fit):
        added, moved = _added(measurements, fit, axis, problem, rows, jacobian, slow_errors[:, axis], number_is_known)
        problem.add_covariance(covariance, added)
        variance[:, problem.axes] += moved
    return replace(fit, covariance=covariance), variance.sqrt()


def _grid(measurements: Measurements, fit: ToneFit, axis: int) -> tuple[Tensor, Tensor]:
    """Frequencies (B, F) in Hz of the further tone of an axis, and those that count (bool): near its tones, or low."""
    duration = measurements.span[:, None]
    tones = torch.where(fit.active, fit.frequencies, 0.0)[:, axis]  # (B, K)
    centres = torch.cat([torch.zeros_like(tones[:, :1]), tones], 1)
    # only places near a tone: fits of frames with a wrong timing may have frequencies of any size
    reach = torch.arange(-_REACH * _POINTS - 1, _REACH * _POINTS + 2, dtype=torch.float64, device=tones.device)
    places = ((centres * duration * _POINTS).round()[..., None] + reach).unique()
    frequencies = places[places >= 1] / (_POINTS * duration)
    near = ((frequencies[..., None] - centres[:, None]).abs() * duration[..., None] <= _REACH).any(-1)
    used = near.any(0)
    return frequencies[:, used], near[:, used]


def _added(
    measurements: Measurements,
    fit: ToneFit,
    axis: int,
    problem: LinearisedFit,
    rows: Tensor,
    jacobian: Tensor,
    slow_error: Tensor,
    number_is_known: bool,
) -> tuple[Tensor, Tensor]:
    """Covariance (B, A M, A M) of the free parameters and variance (B, A) of the displacement, by tones of an axis.

    Args:
        measurements: As in ``with_further_tones``.
        fit: As in ``with_further_tones``.
        axis: Axis of the tones.
        problem: The problem that contains the axis.
        rows: (B, n) s, exposure starts of the rows.
        jacobian: (B, n, A', P) derivatives of their displacements by the parameters of each axis.
        slow_error: (B,) px, as from ``_slow_errors``.
        number_is_known: As in ``with_further_tones``.
    """
    axes = problem.axes
    of_displacement = _without_trend(jacobian[:, :, axes] @ problem.to_all, rows)
    of_tone = torch.eye(len(axes), dtype=rows.dtype, device=rows.device)[axes.index(axis)][:, None, None]
    # 1. Prior of the quadratures: their precision, and the least precision that rounding leaves.
    size = _PRIOR_SIZE * fit.amplitude[:, axis].square().sum(-1).sqrt()  # (B,) px
    precision = torch.where(size > 0, size, 1.0).square().reciprocal()[:, None, None, None]
    eye = torch.eye(2, dtype=rows.dtype, device=rows.device)
    limit = precision + problem.rounding(axis)[:, None, None, None]
    frequencies, counted = _grid(measurements, fit, axis)
    parts = []
    for chunk in frequencies.split(max(1, _CHUNK // (4 * problem.residual.numel())), dim=1):
        # 2. Posterior of the quadratures v of a tone of each frequency f, and its evidence; sums over measurements d.
        response = tone_response(measurements, chunk[:, None].expand(-1, fit.coefficients.shape[1], -1))[..., axis, :]
        unexplained = problem.unexplained(_quadratures(response).flatten(-2), axis)
        Z, back = (part.unflatten(-1, (-1, 2)) for part in unexplained)
        information = torch.einsum("bdfp,bdfq->bfpq", Z, Z)
        right = torch.einsum("bdfq,bd->bfq", Z, problem.residual)
        C = torch.linalg.inv(information + limit * eye)
        v = (C @ right[..., None])[..., 0]
        evidence = 0.5 * (right * v).sum(-1) - 0.5 * torch.logdet(eye + information / precision)
        # 3. Displacement S of the rows by unit tones, and by the change of the parameters m that they cause: mean
        # product over the rows n for each frequency f and axis a.
        S = _without_trend(_wave(fit, rows, chunk, measurements.exposure_time), rows)
        changes = back.unflatten(1, (len(axes), -1))  # (B, A, M, F, 2)
        S = S[:, :, None] * of_tone - torch.einsum("bnam,bamfq->bnafq", of_displacement, changes)
        moved = torch.einsum("bnafp,bnafq->bfapq", S, S) / S.shape[1]
        parts.append((evidence, C + v[..., :, None] * v[..., None, :], back.movedim(1, 2), moved))
    evidence, second, back, moved = (torch.cat(values, 1) for values in zip(*parts, strict=True))
    # 4. Probability of a tone of each frequency. One tone more, of any frequency, has the prior probability of none.
    counted = counted & (size > 0)[:, None]
    prior = torch.where(counted, -counted.sum(1, keepdim=True).to(evidence.dtype).log(), -math.inf)
    probability = functional.pad(evidence + prior, (1, 0)).softmax(-1)[:, 1:]
    if number_is_known:
        probability = torch.zeros_like(probability)
    # 5. Mean over all frequencies, and slow errors with equal variances at the low frequencies.
    slow = frequencies * measurements.span[:, None] <= _SLOW
    slow_variance = slow * (slow_error.square() / slow.sum(1).clamp(min=1))[:, None]
    second = probability[..., None, None] * second + slow_variance[..., None, None] * eye
    return (back @ second @ back.mT).sum(1), (moved * second[:, :, None]).sum((1, 3, 4))


def _slow_errors(measurements: Measurements, fit: ToneFit) -> Tensor:
    """(B, A) px, standard deviation of errors that all rows of an axis have in common; 0 without a slow tone."""
    slow = (fit.active & (fit.frequencies * measurements.span[:, None, None] <= _SLOW)).any(-1)
    offset = math.sqrt(2) * measurements.distances(model_displacements(measurements, fit))
    return slow * (_SLOW_ERROR * offset.square().nanmean(1).nan_to_num(0.0).sqrt()).clamp(max=_MAX_SLOW_ERROR)


def _quadratures(response: Tensor) -> Tensor:
    """Real response (..., 2) to the real and the imaginary part of a coefficient."""
    return torch.view_as_real(response.conj_physical().resolve_conj())


def _wave(fit: ToneFit, exposure_starts: Tensor, frequencies: Tensor, exposure_time: float) -> Tensor:
    """(B, N, F, 2) mean displacements of exposures by unit tones."""
    time = exposure_starts + 0.5 * exposure_time - fit.centre[:, None]
    angle = 2 * math.pi * frequencies[:, None] * time[..., None]
    attenuation = torch.sinc(frequencies * exposure_time)[:, None]
    return _quadratures(torch.polar(attenuation.expand_as(angle), angle))


def _without_trend(values: Tensor, times: Tensor) -> Tensor:
    """Values (B, N, ...) at times (B, N) without their mean and linear trend."""
    values = values - values.mean(1, keepdim=True)
    t = (times - times.mean(1, keepdim=True)).reshape(*times.shape, *(1,) * (values.ndim - 2))
    trend: Tensor = (t * values).sum(1, keepdim=True) / t.square().sum(1, keepdim=True)
    return values - trend * t
