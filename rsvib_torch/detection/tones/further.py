"""Uncertainty of the number of tones: every fit is compared with fits that have one more tone.

A record of few frames often agrees with several numbers of tones. The covariance of a fit holds for its number only. It
is extended here by the mean over models with a further tone of any frequency, each weighted with its probability
(Bayesian model averaging: Hoeting et al., Statistical Science 14, 382, 1999).

With the whitened Jacobian X of the parameters, the response Z of the further tone without the part that X explains, and
the prior covariance ``s^2 I`` of its two quadratures v, the residual r gives

    C = (Z^T Z + I / s^2)^-1,    v = C Z^T r,    ln B = -1/2 ln |I + s^2 Z^T Z| + 1/2 v^T C^-1 v

with the ratio B of the evidences with and without the tone. A tone v changes the parameters by ``-X^+ Z v`` to first
order, so that its uncertainty adds ``X^+ Z (C + v v^T) (X^+ Z)^T`` to their covariance. Smooth errors of the
displacements add to it in the same way.

x and y of a row are nearly independent, and each axis is a problem of its own. With roll and zoom, the components of a
row are strongly correlated, and X contains the parameters of all axes: the displacement along x of all rows determines
roll as well, and a further tone of x would change it.
"""

import math
from dataclasses import replace

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

__all__ = ["with_further_tones"]

# standard deviation of the quadratures of the further tone over the norm of the amplitudes; 95 to 96 % of the 95 %
# intervals of 150 simulated recordings with random tones contain the truth, with 0.2 fewer
_PRIOR_SIZE = 0.5
# Aliasing biases the displacements of all rows alike. One of 46 axes with 0.58 periods in the record had an error of
# 5.8 standard deviations without this term; those of plain vibrations increase by 0 to 35 %.
_SMOOTH_ERROR, _MAX_SMOOTH_ERROR = 5e-4, 2e-3  # over the rms offset; px
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
        number_is_known: Whether there are no further tones; smooth errors remain.

    Returns:
        The fit, and the standard deviation (B, 2) in px of the displacement of rows without mean and linear trend, rms
        over the rows.
    """
    axes = fit.coefficients.shape[1]
    size = fit.covariance.shape[-1] // axes
    covariance = fit.covariance.clone()
    of_parameters = covariance.view(len(covariance), axes, size, axes, size)
    variance = displacement_std(fit, exposure_starts, measurements.exposure_time).square()
    for axis in range(axes):
        fitted = [axis] if axes == 2 else list(range(axes))
        added, moved = _added(measurements, fit, exposure_starts, axis, fitted, number_is_known)
        for row, first in enumerate(fitted):
            variance[:, first] += moved[:, row]
            for column, second in enumerate(fitted):
                of_parameters[:, first, :, second] += added[:, row, :, column]
    return replace(fit, covariance=covariance), variance.sqrt()


def _grid(measurements: Measurements, fit: ToneFit, axis: int) -> tuple[Tensor, Tensor]:
    """Frequencies (B, F) in Hz of the further tone of an axis, and those that count (bool): near its tones, or low."""
    starts = measurements.exposure_starts
    duration = (starts.amax((1, 2)) - starts.amin((1, 2)))[:, None]
    tones = torch.where(fit.active, fit.frequencies, 0.0)[:, axis]  # (B, K)
    centres = torch.cat([torch.zeros_like(tones[:, :1]), tones], 1)
    # only places near a tone: fits of frames with a wrong timing may have frequencies of any size
    reach = torch.arange(-_REACH * _POINTS - 1, _REACH * _POINTS + 2, dtype=torch.float64, device=starts.device)
    places = ((centres * duration * _POINTS).round()[..., None] + reach).unique()
    frequencies = places[places >= 1] / (_POINTS * duration)
    near = ((frequencies[..., None] - centres[:, None]).abs() * duration[..., None] <= _REACH).any(-1)
    used = near.any(0)
    return frequencies[:, used], near[:, used]


def _added(
    measurements: Measurements,
    fit: ToneFit,
    exposure_starts: Tensor,
    axis: int,
    fitted: list[int],
    number_is_known: bool,
) -> tuple[Tensor, Tensor]:
    """Covariance (B, A, P, A, P) of parameters and variance (B, A) of the displacement, by further tones of an axis.

    ``fitted`` are the A axes whose parameters the tone changes.
    """
    root, X, r, to_all = _whitened(measurements, fit, fitted)
    rows = exposure_starts.expand(len(r), -1)
    own = displacement_jacobian(fit, rows, measurements.exposure_time)[:, :, fitted]  # (B, n, A, P)
    of_displacement = _without_trend(torch.stack([own[:, :, i] @ to_all for i in range(len(fitted))], 2), rows)
    size = _PRIOR_SIZE * fit.amplitude[:, axis].square().sum(-1).sqrt()  # (B,) px
    precision = torch.where(size > 0, size, 1.0).square().reciprocal()[:, None, None, None]
    eye = torch.eye(2, dtype=r.dtype, device=r.device)
    frequencies, counted = _grid(measurements, fit, axis)
    inverse = torch.linalg.pinv(X)  # (B, M, D)
    parts = []
    for chunk in frequencies.split(max(1, _CHUNK // (4 * r.numel())), dim=1):
        response = tone_response(measurements, chunk[:, None].expand(-1, fit.coefficients.shape[1], -1))[..., axis, :]
        column = root[..., fitted.index(axis)][:, :, None, :, None]
        Z = _quadratures(column * response[:, :, :, None]).flatten(1, 3)  # (B, D, F, 2)
        rounding = 1e-12 * Z.square().sum((1, 3))[..., None, None]
        back = torch.einsum("bmd,bdfq->bfmq", inverse, Z)
        Z = Z - torch.einsum("bdm,bfmq->bdfq", X, back)
        information = torch.einsum("bdfp,bdfq->bfpq", Z, Z)
        right = torch.einsum("bdfq,bd->bfq", Z, r)
        C = torch.linalg.inv(information + (precision + rounding) * eye)
        v = (C @ right[..., None])[..., 0]
        evidence = 0.5 * (right * v).sum(-1) - 0.5 * torch.logdet(eye + information / precision)
        # displacement of the rows by the tone and by the change of the parameters
        S = _without_trend(_wave(fit, rows, chunk, measurements.exposure_time), rows)
        of_tone = torch.eye(len(fitted), dtype=S.dtype, device=S.device)[fitted.index(axis)][:, None, None]
        changes = back.unflatten(2, (len(fitted), -1))
        S = S[:, :, None] * of_tone - torch.einsum("bnam,bfamq->bnafq", of_displacement, changes)
        moved = torch.einsum("bnafp,bnafq->bfapq", S, S) / S.shape[1]
        parts.append((evidence, C + v[..., :, None] * v[..., None, :], back, moved))
    evidence, second, back, moved = (torch.cat(values, 1) for values in zip(*parts, strict=True))
    # equal prior probabilities of one tone more, of any frequency, and of none
    counted = counted & (size > 0)[:, None]
    prior = torch.where(counted, -counted.sum(1, keepdim=True).to(evidence.dtype).log(), -math.inf)
    probability = functional.pad(evidence + prior, (1, 0)).softmax(-1)[:, 1:]
    if number_is_known:
        probability = torch.zeros_like(probability)
    smooth = _smooth_error(measurements, fit)[:, axis].square()[:, None] * prior.exp()
    second = probability[..., None, None] * second + smooth[..., None, None] * eye
    covariance = (back @ second @ back.mT).sum(1).unflatten(-1, (len(fitted), -1)).unflatten(1, (len(fitted), -1))
    of_all = torch.einsum("pm,bimjn,qn->bipjq", to_all, covariance, to_all)
    return of_all, (moved * second[:, :, None]).sum((1, 3, 4))


def _whitened(measurements: Measurements, fit: ToneFit, axes: list[int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The linearised problem of one axis, or of all together, for errors of variance 1.

    Returns:
        Matrices (B, N, A, A) from px to standard deviations, the Jacobian (B, N G A, A M) of the free parameters, the
        residual (B, N G A), and the matrix (P, M) from the free parameters of an axis to all.
    """
    residual = residual_of(measurements, fit)[..., axes]
    jacobians, constraints = zip(*(axis_jacobian(measurements, fit, axis) for axis in axes), strict=True)
    jacobian = torch.stack(jacobians, 3)  # (B, N, G, A, M)
    spent = (jacobian.square().amax((1, 2)) > 0).sum((1, 2))
    spare = (measurements.num_measurements[:, axes].sum(1) - spent).clamp(min=1.0)
    one = measurements.inverse_variances[..., axes, None] if len(axes) == 1 else measurements.information
    root = cholesky_root(one)
    whitened = (root[:, :, None] @ residual[..., None]).flatten(1)
    deviation = (whitened.square().sum(1) / spare).clamp(min=1e-300).sqrt()[:, None, None, None]
    root = root / deviation
    X = (root[:, :, None, :, :, None] * jacobian[..., None, :, :]).flatten(-2).flatten(1, 3)
    return root, X, whitened / deviation[:, :, 0, 0], constraints[0]


def _smooth_error(measurements: Measurements, fit: ToneFit) -> Tensor:
    """(B, 2) px, standard deviation of the quadratures of smooth errors that all rows have in common."""
    offset = math.sqrt(2) * measurements.distances(model_displacements(measurements, fit))
    return (_SMOOTH_ERROR * offset.square().nanmean(1).nan_to_num(0.0).sqrt()).clamp(max=_MAX_SMOOTH_ERROR)


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
