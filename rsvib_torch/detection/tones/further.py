"""Uncertainty of the number of tones: every fit is compared with fits that have one more tone.

A record of few frames often agrees with several numbers of tones. The covariance of a fit holds for its number only. It
is extended here by the mean over models with a further tone of any frequency, each weighted with its probability
(Bayesian model averaging: Hoeting et al., Statistical Science 14, 382, 1999).

With the whitened Jacobian X of the parameters, the response Z of the further tone without the part that X explains, and
the prior covariance ``s^2 I`` of its two quadratures v, the residual r gives

    C = (Z^T Z + I / s^2)^-1,    v = C Z^T r,    ln B = -1/2 ln |I + s^2 Z^T Z| + 1/2 v^T C^-1 v

with the ratio B of the evidences with and without the tone. A tone v changes the parameters by ``-X^+ Z v`` to first
order, so that its uncertainty adds ``X^+ Z (C + v v^T) (X^+ Z)^T`` to their covariance. Slow errors of the
displacements add to it in the same way.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import (
    ToneFit,
    displacement_jacobian,
    displacement_std,
    model_displacements,
    tone_response,
)
from rsvib_torch.detection.tones.linearised import LinearisedFit

__all__ = ["with_further_tones"]

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
        The fit, and the standard deviation (B, 2) in px of the displacement of rows without mean and linear trend, rms
        over the rows.
    """
    covariance, rows = fit.covariance.clone(), exposure_starts.expand(len(fit.centre), -1)
    variance = displacement_std(fit, exposure_starts, measurements.exposure_time).square()
    jacobian = displacement_jacobian(fit, rows, measurements.exposure_time)
    slow_errors = _slow_errors(measurements, fit)
    for problem in LinearisedFit.of_each_axis(measurements, fit):
        slow_error = slow_errors[:, problem.axis]
        added, moved = _added(measurements, fit, problem, rows, jacobian, slow_error, number_is_known)
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
        problem: The problem that contains the axis.
        rows: (B, n) s, exposure starts of the rows.
        jacobian: (B, n, A', P) derivatives of their displacements by the parameters of each axis.
        slow_error: (B,) px, as from ``_slow_errors``.
        number_is_known: As in ``with_further_tones``.
    """
    axis, axes = problem.axis, problem.axes
    of_displacement = _without_trend(jacobian[:, :, axes] @ problem.to_all, rows)
    size = _PRIOR_SIZE * fit.amplitude[:, axis].square().sum(-1).sqrt()  # (B,) px
    precision = torch.where(size > 0, size, 1.0).square().reciprocal()[:, None, None, None]
    eye = torch.eye(2, dtype=rows.dtype, device=rows.device)
    limit = precision + problem.rounding[:, None, None, None]
    of_tone = torch.eye(len(axes), dtype=rows.dtype, device=rows.device)[problem.row][:, None, None]
    frequencies, counted = _grid(measurements, fit, axis)
    parts = []
    for chunk in frequencies.split(max(1, _CHUNK // (4 * problem.residual.numel())), dim=1):
        response = tone_response(measurements, chunk[:, None].expand(-1, fit.coefficients.shape[1], -1))[..., axis, :]
        Z, back = (part.unflatten(-1, (-1, 2)) for part in problem.unexplained(_quadratures(response).flatten(-2)))
        information = torch.einsum("bdfp,bdfq->bfpq", Z, Z)
        right = torch.einsum("bdfq,bd->bfq", Z, problem.residual)
        C = torch.linalg.inv(information + limit * eye)
        v = (C @ right[..., None])[..., 0]
        evidence = 0.5 * (right * v).sum(-1) - 0.5 * torch.logdet(eye + information / precision)
        # displacement of the rows by the tone and by the change of the parameters
        S = _without_trend(_wave(fit, rows, chunk, measurements.exposure_time), rows)
        changes = back.unflatten(1, (len(axes), -1))  # (B, A, M, F, 2)
        S = S[:, :, None] * of_tone - torch.einsum("bnam,bamfq->bnafq", of_displacement, changes)
        moved = torch.einsum("bnafp,bnafq->bfapq", S, S) / S.shape[1]
        parts.append((evidence, C + v[..., :, None] * v[..., None, :], back.movedim(1, 2), moved))
    evidence, second, back, moved = (torch.cat(values, 1) for values in zip(*parts, strict=True))
    # equal prior probabilities of one tone more, of any frequency, and of none
    counted = counted & (size > 0)[:, None]
    prior = torch.where(counted, -counted.sum(1, keepdim=True).to(evidence.dtype).log(), -math.inf)
    probability = functional.pad(evidence + prior, (1, 0)).softmax(-1)[:, 1:]
    if number_is_known:
        probability = torch.zeros_like(probability)
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
