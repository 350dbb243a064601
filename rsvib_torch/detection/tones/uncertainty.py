"""Uncertainty of a fit that its residual does not contain: aliasing, further tones.

Each effect of response Z and size v changes the parameters of the fit by ``-X^+ Z v`` to first order, X being the
whitened Jacobian of the free parameters. An uncertainty C of v therefore adds ``X^+ Z C (X^+ Z)^T`` to their covariance
(``LinearisedFit``).

*Aliasing.* A displacement d multiplies the aliased part of the scene by ``exp(2 pi i d)`` along its axis, whatever its
frequency. Products of this part with itself and with the scene bias the displacement in frame p by

    b Im(exp(2 pi i d_p) conj(m)) + c cos(2 pi d_p) + s sin(2 pi d_p)

less its mean over the G frames, with the mean m of ``exp(2 pi i d_q)`` over the frames q. Along rows, b is negative and
has about the size that follows from the spectrum of the frames: 2e-3 px for optics of 0.4 px (Gaussian, standard
deviation). c and s are small, unless many edges have the same place within a pixel. The phase of the bias turns with
every pixel of displacement, so that motions of more than about 1 px determine all three from the residuals.

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

import numpy as np
from scipy import special

from rsvib_torch.detection.measurements import Measurements, cholesky_root
from rsvib_torch.detection.tones.fit import (
    ToneFit,
    displacement_jacobian,
    displacement_std,
    displacements,
    free_jacobian,
    offset_gain,
    residual_of,
    tone_response,
    vibration_of_fit,
)
from rsvib_torch.execution.parallel import runs
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import Array, pseudo_inverse, split_axis, tensor, unit_wave, without_nan

# Mean, and standard deviations of b, c and s, of x and of y over the expected size of b; chosen with 220 recordings of
# drawn and real scenes. In 60 others each behind optics of 0.4 and 0.55 px, with one tone in 2 to 8 frames, the rms
# error of the amplitude along x over its standard deviation was 1.24 and 1.26 with b alone, of mean 0, and is 1.06 and
# 1.07; its median error fell by a quarter and a tenth
_MEAN_BIAS = (-0.7, 0.0, 0.0), (0.0, 0.0, 0.0)
_BIAS_STD = (0.7, 0.7, 0.7), (0.5, 0.3, 0.3)
# Errors of amplitudes A in px of a tracker, and of roll and zoom, over the expected size of b: at most 3 A, and
# 1.2 / (1 + 2 A). In 60 axes with one tone that was tracked for 12 frames behind optics of 0.4 px, the rms error over
# the standard deviation was 2.1 (largest 12) without this term, and is 1.0 (3.7); in 57 others it is 1.0 (3.4). Of 24
# tones of roll it was 1.6 and is 1.3
_UNKNOWN_ALIASING = 3.0, 1.2
# px^-2, relative, per square of the path within an exposure, of x, y, roll and zoom: with paths of 4 to 7 px, errors
# were 2e-4 to 8e-4 in textures and cities and up to 6e-3 in charts (29 tones, rms 2.2 standard deviations with half of
# the value); of roll with paths of 1.5 and 2.8 px at half the width 2.2e-3 and 8e-3, 3.4 and 5.8 standard
# deviations with the value of x and y
_UNKNOWN_BLUR = 3e-5, 3e-5, 1e-3, 1e-3
# px^-1 per frame, of the image motion along x and y, per square of the same path: with paths of 4 to 6 px, errors
# along y were 3 to 31 thousandths of a pixel per frame (3 to 32 frames), up to 13 standard deviations without this
# term, and are at most 2.6 (29 tones); along x 8 thousandths and less
_DRIFT_BY_BLUR = 1e-4, 3e-4, 0.0, 0.0
# Standard deviation of the errors of amplitudes that all rows have in common over the rms displacement of the rows that
# nothing explains. Encoders predict blocks of a frame from others, with one displacement for all rows of a block. The
# rms error of 26 to 35 amplitudes over their standard deviation, without and with it: H.264 of CRF 17, 20, 23, 28 in
# eight frames 2.3, 2.6, 2.1, 2.1 and 1.1, 1.2, 0.9, 0.9 (of the frequency 2.0, 4.2, 1.6, 1.4 and 1.0, 1.5, 0.7, 0.6);
# four frames 1.8 and 1.1. Half of the standard deviations of frames without encoding do not change
_UNEXPLAINED_IN_COMMON = 0.25
# standard deviation of the quadratures of the further tone over the norm of the amplitudes; 95 to 96 % of the 95 %
# intervals of 150 simulated recordings with random tones contain the truth, with 0.2 fewer
_PRIOR_SIZE = 0.5
_POINTS = 4  # frequencies per 1 / duration of the record
_REACH = 8  # distance of the frequencies from those of the tones, and from 0, times the duration
_CHUNK = 2**22  # values at a time


# --- Linearised fit ---


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """A fit linearised at its parameters, for errors of variance 1: of one axis, or of all axes together.

    x and y of a row are nearly independent, and each axis is a problem of its own. With roll and zoom, the components
    of a row are strongly correlated, and X contains the parameters of all axes.
    """

    axes: list[int]  # the A axes of the problem
    root: Array  # (B, N, A, A) from px to standard deviations
    jacobian: Array  # X (B, D, A P), D = N G A
    inverse: Array  # X^+ (B, A P, D)
    residual: Array  # (B, D) of the fit

    @classmethod
    def of_axes(cls, measurements: Measurements, axes: list[int], jacobian: Array, residual: Array) -> "LinearisedFit":
        """The problem of one axis, or of all, from the ``free_jacobian`` and the residual (B, N, G, A') of a fit."""
        jacobian, residual = jacobian[..., axes, :], residual[..., axes]
        spent = (np.square(jacobian).max((1, 2)) > 0).sum((1, 2))
        spare = np.maximum(measurements.num_measurements[:, axes].sum(1) - spent, 1.0)
        information = measurements.inverse_variances[..., axes, None] if len(axes) == 1 else measurements.information
        root = cholesky_root(information)
        whitened = (root[:, :, None] @ residual[..., None]).reshape(len(residual), -1)
        deviation = np.sqrt(np.maximum(np.square(whitened).sum(1) / spare, 1e-300))[:, None, None, None]
        root = root / deviation
        X = root[:, :, None, :, :, None] * jacobian[..., None, :, :]  # (B, N, G, A, A, P)
        X = X.reshape(*whitened.shape, -1)
        return cls(axes, root, X, pseudo_inverse(X), whitened / deviation[:, :, 0, 0])

    def rounding(self, axis: int) -> Array:
        """(B,) error of the squared norm of whitened responses of about 1 px, for displacements without noise."""
        return 1e-12 * np.square(self.root[..., self.axes.index(axis)]).sum((1, 2))

    def unexplained(self, response: Array, axis: int) -> tuple[Array, Array]:
        """Whitened part (B, D, Q) of a response that the parameters do not explain, and their change (B, A P, Q) by it.

        The response (B, N, G, Q) consists of displacements of an axis in px by unit effects.
        """
        root = self.root[..., self.axes.index(axis)]
        Z = root[:, :, None, :, None] * response[:, :, :, None]  # (B, N, G, A, Q)
        Z = Z.reshape(*self.residual.shape, -1)
        change = self.inverse @ Z
        return Z - self.jacobian @ change, change

    def add_covariance(self, total: Array, added: Array) -> None:
        """Add a covariance (B, A P, A P) of the parameters of these axes to that (B, A' P, A' P) of a fit, in place."""
        size = added.shape[-1]  # of one axis, or of all
        part = slice(self.axes[0] * size, (self.axes[0] + 1) * size)
        total[:, part, part] += added

    def add_change(self, total: Array, change: Array) -> None:
        """Add a change (B, A P) of the parameters of these axes to that (B, A', P) of a fit, in place."""
        total[:, self.axes] += split_axis(change, -1, len(self.axes), -1)


def linearised(measurements: Measurements, fit: ToneFit) -> list[tuple[int, LinearisedFit]]:
    """Each axis of a fit with the problem that contains it."""
    jacobian, residual = free_jacobian(measurements, fit), residual_of(measurements, fit)
    axes = range(fit.coefficients.shape[1])
    parts = [[axis] for axis in axes] if len(axes) == 2 else [list(axes)]
    problems = [LinearisedFit.of_axes(measurements, axes_of_problem, jacobian, residual) for axes_of_problem in parts]
    return [(axis, problem) for problem in problems for axis in problem.axes]


# --- Aliasing ---


def without_aliasing(measurements: Measurements, fit: ToneFit, size: Array) -> ToneFit:
    """The fit corrected for aliasing of x and y, of expected size (B,) px; the covariance has the remaining error."""
    size = np.maximum(size, 1e-9)[:, None]
    covariance, axes = fit.covariance.copy(), fit.drift.shape[1]
    change = np.zeros((len(covariance), axes, covariance.shape[-1] // axes))
    # bias (B, N, G, A, 3) of the relative displacements for b, c and s of 1
    turn, visible = unit_wave(2 * math.pi * displacements(measurements, fit)), measurements.visible[..., None]
    mean = (visible * turn).sum(2, keepdims=True) / np.maximum(visible.sum(2, keepdims=True), 1.0)
    bias = measurements.relative(np.stack([(turn * mean.conj()).imag, turn.real, turn.imag], -1))
    for axis, problem in linearised(measurements, fit)[:2]:
        Z, by_unit = problem.unexplained(bias[:, :, :, axis], axis)
        precision = 1 / np.square(size * _BIAS_STD[axis])  # (B, 3), of b, c and s before they are measured
        normal = Z.mT @ Z + (problem.rounding(axis)[:, None] + precision)[..., None] * np.eye(3)
        right_side = Z.mT @ problem.residual[..., None] + (precision * size * _MEAN_BIAS[axis])[..., None]
        inverse = np.linalg.inv(normal)
        problem.add_covariance(covariance, by_unit @ inverse @ by_unit.mT)
        problem.add_change(change, -(by_unit @ inverse @ right_side)[..., 0])
    tones, drift = np.split(change, [3 * fit.frequencies.shape[-1]], -1)
    real, imaginary, frequency = np.moveaxis(split_axis(tones, -1, -1, 3), -1, 0)
    return replace(
        fit,
        coefficients=fit.coefficients + real + 1j * imaginary,
        frequencies=np.maximum(fit.frequencies + frequency, 0.0),
        drift=fit.drift + drift,
        covariance=covariance,
    )


# --- Errors of the amplitudes ---


def with_unknown_amplitudes(
    fit: ToneFit,
    aliasing: Array,
    unexplained: Array,
    intervals: Array,
    exposure_time: float,
    *,
    known: int = 2,
    span: Array | float = math.inf,
) -> ToneFit:
    """The fit with errors of its tones that the models of noise, unequal blur and aliasing do not contain.

    ``aliasing`` (B,) px is the expected size of the bias, for which ``without_aliasing`` accounts on the first
    ``known`` axes, and ``unexplained`` (B, A) px the rms displacement of rows that nothing explains. A small gain
    between frames ``intervals`` (M,) s apart amplifies errors of offsets. ``span`` (B,) in s is the time over which
    errors of the phase change the frequency.
    """
    size = fit.amplitude  # (B, A, K)
    path = _path_within(fit, exposure_time)
    gain = np.maximum(offset_gain(fit.frequencies, intervals), 1e-3)
    error = np.array(_UNKNOWN_BLUR)[: size.shape[1], None] * np.square(path) * 2.0 / gain  # relative
    small, large = _UNKNOWN_ALIASING
    by_aliasing = aliasing[:, None, None] * np.minimum(small, large / (size + 2 * np.square(size) + 1e-300))
    error[:, known:] = np.hypot(error, by_aliasing)[:, known:]
    error_std = fit.tones * error[..., None] * [1.0, 1.0, 0.0]  # of Re C, Im C and f
    # the bounds of Re C, Im C and f of a tone that is sampled uniformly have these proportions
    common = np.broadcast_to(_UNEXPLAINED_IN_COMMON * without_nan(unexplained, 0.0)[..., None], size.shape)
    per_size = np.divide(common, size, out=np.zeros_like(size), where=fit.active & (size > 0))
    frequency_std = math.sqrt(12) * per_size / (2 * math.pi * np.reshape(span, (-1, 1, 1)))
    common_std = np.stack([common, common, frequency_std], -1) * fit.active[..., None]
    unknown, in_common = (
        np.pad(values.reshape(*size.shape[:2], -1), ((0, 0), (0, 0), (0, fit.drift.shape[-1])))  # (B, A, P)
        for values in (error_std, common_std)
    )
    covariance, (axes, parameters) = fit.covariance.copy(), unknown.shape[1:]
    diagonal = np.arange(axes * parameters)
    covariance[:, diagonal, diagonal] += np.square(in_common).reshape(len(covariance), -1)
    blocks = covariance.reshape(len(covariance), axes, parameters, axes, parameters)
    for axis in range(axes):
        blocks[:, axis, :, axis] += unknown[:, axis, :, None] * unknown[:, axis, None]
    return replace(fit, covariance=covariance)


def with_unknown_image_motion(reported: "ReportedFit", interval: float, exposure_time: float) -> "ReportedFit":
    """The fit with errors of its image motion by blur, which displaces frames ``interval`` s apart by unequal amounts.

    The standard deviation of the displacement does not change: it excludes the image motion.
    """
    fit, axes = reported.fit, reported.fit.amplitude.shape[1]
    error = np.array(_DRIFT_BY_BLUR)[:axes] * np.square(_path_within(fit, exposure_time)).sum(-1) / interval  # px/s
    covariance = fit.covariance.copy()
    parameters = covariance.shape[-1] // axes
    velocity = np.arange(axes) * parameters + parameters - fit.drift_order
    covariance[:, velocity, velocity] += np.square(error)
    return replace(reported, fit=replace(fit, covariance=covariance))


def _path_within(fit: ToneFit, exposure_time: float) -> Array:
    """(B, A, K) px, about how far each tone moves the rows within an exposure."""
    return np.asarray(fit.amplitude * np.minimum(2 * math.pi * fit.frequencies * exposure_time, 2.0))


# --- Further tones ---


@dataclass(frozen=True, eq=False)
class ReportedFit:
    """A fit with the uncertainty that results report."""

    fit: ToneFit  # the fit with its covariance
    # (B, A) px, standard deviation of the displacement of rows without their mean, rms over the rows; the effect of a
    # further tone is computed without linear trend, which the image motion contains
    displacement_std: Array

    def vibration(self) -> tuple[Vibration, VibrationStd]:
        """The vibration, and its standard deviations with that of the displacement."""
        vibration, std = vibration_of_fit(self.fit)
        return vibration, replace(std, displacement=tensor(self.displacement_std))


def with_further_tones(
    measurements: Measurements, fit: ToneFit, exposure_starts: Array, *, number_is_known: bool = False
) -> tuple[ReportedFit, ReportedFit]:
    """The fit as it is, and with an allowance for a further tone in its covariance; rows start at (N,) s."""
    rows = np.broadcast_to(exposure_starts, (len(fit.centre), len(exposure_starts)))
    reported = ReportedFit(fit, displacement_std(fit, exposure_starts, measurements.exposure_time))
    if number_is_known:
        return reported, reported
    covariance, variance = fit.covariance.copy(), np.square(reported.displacement_std)
    jacobian = displacement_jacobian(fit, rows, measurements.exposure_time)
    for axis, problem in linearised(measurements, fit):
        added, displacement_variance = _further_tone_effect(measurements, fit, axis, problem, rows, jacobian)
        problem.add_covariance(covariance, added)
        variance[:, problem.axes] += displacement_variance
    return reported, ReportedFit(replace(fit, covariance=covariance), np.sqrt(variance))


def _grid(measurements: Measurements, fit: ToneFit, axis: int) -> tuple[Array, Array]:
    """Frequencies (B, F) in Hz of the further tone of an axis, and whether each is near one of its tones, or low."""
    duration = measurements.span[:, None]
    tones = np.where(fit.active, fit.frequencies, 0.0)[:, axis]  # (B, K)
    centres = np.concatenate([np.zeros_like(tones[:, :1]), tones], 1)
    # only places near a tone: fits of frames with a wrong timing may have frequencies of any size
    reach = np.arange(-_REACH * _POINTS - 1, _REACH * _POINTS + 2)
    places = np.unique((centres * duration * _POINTS).round()[..., None] + reach)
    frequencies = places[places >= 1] / (_POINTS * duration)
    is_near = (np.abs(frequencies[..., None] - centres[:, None]) * duration[..., None] <= _REACH).any(-1)
    is_used = is_near.any(0)
    return frequencies[:, is_used], is_near[:, is_used]


def _further_tone_effect(
    measurements: Measurements,
    fit: ToneFit,
    axis: int,
    problem: LinearisedFit,
    rows: Array,
    jacobian: Array,
) -> tuple[Array, Array]:
    """Covariance (B, A P, A P) of the parameters and variance (B, A) of the displacement, by a further tone of an axis.

    ``rows`` (B, n) are exposure starts in s, ``jacobian`` (B, n, A', P) the derivatives of their displacements by the
    parameters of each axis.
    """
    axes = problem.axes
    displacement_jacobian = _without_trend(jacobian[:, :, axes], rows)
    is_axis = np.eye(len(axes))[axes.index(axis)][:, None, None]
    # 1. Prior of the quadratures: their precision, and the least precision that rounding leaves.
    size = _PRIOR_SIZE * np.sqrt(np.square(fit.amplitude[:, axis]).sum(-1))  # (B,) px
    precision = (1 / np.square(np.where(size > 0, size, 1.0)))[:, None, None, None]
    eye = np.eye(2)
    limit = precision + problem.rounding(axis)[:, None, None, None]
    frequencies, counted = _grid(measurements, fit, axis)
    parts, along = [], measurements.of_axis(axis)
    for batch in runs(frequencies.shape[1], max(1, _CHUNK // (4 * problem.residual.size))):
        chunk = frequencies[:, batch]
        # 2. Posterior of the quadratures v of a tone of each frequency f, and its evidence; sums over measurements d.
        response = tone_response(along, chunk[:, None])[..., 0, :]
        unexplained = problem.unexplained(_quadratures(response).reshape(*response.shape[:-1], -1), axis)
        Z, back = (split_axis(values, -1, -1, 2) for values in unexplained)
        information = np.einsum("bdfp,bdfq->bfpq", Z, Z)
        right_side = np.einsum("bdfq,bd->bfq", Z, problem.residual)
        C = np.linalg.inv(information + limit * eye)
        v = (C @ right_side[..., None])[..., 0]
        evidence = 0.5 * (right_side * v).sum(-1) - 0.5 * np.linalg.slogdet(eye + information / precision)[1]
        # 3. Displacement S of the rows by unit tones, and by the change of the parameters p that they cause: mean
        # product over the rows n for each frequency f and axis a.
        time = rows + 0.5 * measurements.exposure_time - fit.centre[:, None]
        waves = unit_wave(2 * math.pi * chunk[:, None] * time[..., None])
        attenuation = np.sinc(chunk * measurements.exposure_time)[:, None]
        S = _without_trend(_quadratures(attenuation * waves), rows)
        changes = split_axis(back, 1, len(axes), -1)  # (B, A, P, F, 2)
        S = S[:, :, None] * is_axis - np.einsum("bnam,bamfq->bnafq", displacement_jacobian, changes, optimize=True)
        displacement_products = np.einsum("bnafp,bnafq->bfapq", S, S) / S.shape[1]
        parts.append((evidence, C + v[..., :, None] * v[..., None, :], np.moveaxis(back, 1, 2), displacement_products))
    evidence, second, back, displacement_products = (np.concatenate(values, 1) for values in zip(*parts, strict=True))
    # 4. Probability of a tone of each frequency. One tone more, of any frequency, has the prior probability of none.
    counted = counted & (size > 0)[:, None]
    prior = np.where(counted, -np.log(np.maximum(counted.sum(1, keepdims=True), 1.0)), -math.inf)
    probability = special.softmax(np.pad(evidence + prior, ((0, 0), (1, 0))), -1)[:, 1:]
    # 5. Mean over all frequencies.
    tone_moment = probability[..., None, None] * second
    return (back @ tone_moment @ back.mT).sum(1), (displacement_products * tone_moment[:, :, None]).sum((1, 3, 4))


def _quadratures(response: Array) -> Array:
    """Real response (..., 2) to the real and the imaginary part of a coefficient."""
    return np.stack([response.real, -response.imag], -1)


def _without_trend(values: Array, times: Array) -> Array:
    """Values (B, N, ...) at times (B, N) without their mean and linear trend."""
    values = values - values.mean(1, keepdims=True)
    t = (times - times.mean(1, keepdims=True)).reshape(*times.shape, *(1,) * (values.ndim - 2))
    trend: Array = (t * values).sum(1, keepdims=True) / np.square(t).sum(1, keepdims=True)
    return values - trend * t
