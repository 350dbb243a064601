"""Least-squares fit of a gyroscope's rates to corners that are followed between consecutive frames.

The rotation of the camera between the exposures of a corner in two frames, and its translation, displace it by

    ``d = displacement(w) + m (tz (x - c) - f (tx, ty)),  w = A [rotation(tau1, tau2) - b (tau2 - tau1)]``

with ``tau = at + scale (t - middle)``, the assignment A of the axes and the bias b; t is the translation over the mean
distance of the content, and m the mean distance over that of the corner. Every pair of frames has a translation of
its own: the mean of all pairs, which has no prior that matters, and a deviation. m has the mean 1 and a standard
deviation that follows from the residuals: if the scene has depth, only displacements across the lines of the parallax
(epipolar lines) determine the rotation, and all if there is no parallax. Every pair also has a rotation of its own that
the gyroscope does not explain. Standard deviations of these random effects follow from the fit as well (type II
maximum likelihood).
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.gyroscope.corner_tracks import CELL_COLUMNS, CELL_ROWS, CornerTracks
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates, orientation_matrix
from rsvib_torch.gyroscope.rotation_search import MIN_FOCAL_LENGTH
from rsvib_torch.motion.camera import Camera, displacement_at
from rsvib_torch.numerics.interpolation import gauss_legendre
from rsvib_torch.numerics.tables import scaled_inverse, table, tensor

NAMES = ("bias x", "bias y", "bias z", "at", "scale", "focal length", "row time")
_ROUNDS = 12  # of weights and variances; the clock changes by less than 0.1 of its std after 8 on the phone
# Relative error of displacements by OpenCV, which interpolates linearly: of 20 simulated clips, the focal length was
# wrong by 0.09 % (rms), of one with 216 x 200 px by 0.8 %; the row time by 0.25 % (rms).
_GAIN_ERROR = 3e-3
_ROW_ERROR = 0.5  # rows, of all corners in common; of the same clips, the offset was wrong by 0.03 ms, 0.6 rows (rms)
# Relative standard deviations, about 1 / sqrt(M), of the median of the residuals of M corners, by which a fit with a
# translation must have smaller residuals.
_SIGNIFICANT = 8.0
_STEPS = 5  # of Gauss-Newton with fixed weights from the start values of a search; it converges within 4
_CUT = 4.7  # standard deviations beyond which a residual has no weight; efficiency of 95 % for normal errors (biweight)
_BIAS = 0.1  # rad/s, prior; the zero-rate offset of gyroscopes is at most 3 to 5 degrees/s by their data sheets
_START_ROTATION = 0.02  # px, start value of rotations that are not explained; of 5 px, they exchange with translations
_START_TRANSLATION = 0.3  # px, least start value of the deviations of the translation
_HELD_ROUNDS = 4  # at first, in which the effects keep these values, until the parameters are near
# of the noise of the rates. Of 32 alignments of 6 to 12 frames with 0.005 rad/s at 1000 Hz, 8 had errors of 4 to 11
# standard deviations without this part
_DRAWS = 16
_LEAST_STD = 1e-3  # px, of corners and of effects; below every error


def image_components(turned: Tensor, focal_length: Tensor | float) -> Tensor:
    """X and Y in px and theta in rad of rotation vectors (..., 3) of a camera."""
    pitch, yaw, roll = turned.unbind(-1)
    return torch.stack([-focal_length * yaw, focal_length * pitch, -roll], -1)


@dataclass(frozen=True, eq=False)
class RotationModel:
    """What the displacements depend on besides the parameters of the fit."""

    tracks: CornerTracks  # the measurements
    rates: AngularRates  # the recording
    orientation: str  # name of the assignment of the axes
    camera: Camera  # principal point and lens; its focal length is a parameter of the fit
    middle: float  # s, mid-time of the frames
    free: tuple[bool, ...]  # (7,) whether parameters are fitted

    def components(self, parameters: Tensor, times: Tensor) -> Tensor:
        """(M, 3) X and Y in px and theta in rad between two times (M, 2) in s on the clock of the frames."""
        first, last = (parameters[3] + parameters[4] * (times - self.middle)).unbind(-1)
        turned = self.rates.rotation(first, last) - (last - first)[:, None] * parameters[:3]
        return image_components(turned @ orientation_matrix(self.orientation).T, parameters[5])

    def predicted(self, parameters: Tensor) -> Tensor:
        """Displacements (M, 2) in px by the rotation, for parameters (7,) in the order of ``NAMES``."""
        nodes, weights = gauss_legendre(2)  # exact for a motion of third order within an exposure
        displaced = torch.stack([self._displaced(parameters, node) for node in nodes.tolist()], -1)
        return displaced @ weights.to(displaced)

    def _displaced(self, parameters: Tensor, node: float) -> Tensor:
        """Displacements (M, 2) in px at a place 0 ... 1 within the exposures."""
        components = self.components(parameters, self.tracks.times(float(parameters[6]), node))
        camera = replace(self.camera, focal_length=float(parameters[5]))
        x, y = self.tracks.place.unbind(-1)
        return displacement_at(components, x, y, camera)

    def slopes(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """(M, 2, 7) derivatives of ``predicted``, 0 for parameters that are not free, and (M, 2, 3) by components."""
        camera = replace(self.camera, focal_length=float(parameters[5]))
        x, y = self.tracks.place.unbind(-1)
        factors = camera.factors(x, y, 3)
        times = self.tracks.times(float(parameters[6]))
        clock = parameters[3] + parameters[4] * (times - self.middle)
        half = 0.5 / self.rates.sample_rate
        rates = (self.rates.rotation(clock - half, clock + half) / (2 * half)) - parameters[:3]  # (M, 2, 3) rad/s

        def difference(factor: Tensor) -> Tensor:  # of the rates at the two times, each with a factor (M, 2)
            return (factor[..., None] * rates).diff(dim=1)[:, 0]

        duration = clock.diff()
        turned = [-duration * axis for axis in torch.eye(3, dtype=duration.dtype)]
        turned += [difference(torch.ones_like(times)), difference(times - self.middle)]
        matrix = orientation_matrix(self.orientation).T
        columns = [factors @ image_components(one @ matrix, parameters[5])[..., None] for one in turned]
        # the focal length by a difference
        step = torch.zeros_like(parameters)
        step[5] = 1e-4 * parameters[5]
        longer, shorter = self._displaced(parameters + step, 0.5), self._displaced(parameters - step, 0.5)
        columns.append(((longer - shorter) / (2 * step[5]))[..., None])
        row = difference(parameters[4] * self.tracks.rows)
        columns.append(factors @ image_components(row @ matrix, parameters[5])[..., None])
        return torch.cat(columns, -1) * torch.tensor(self.free), factors


@dataclass(frozen=True, eq=False)
class Errors:
    """Standard deviations of corners and of the effects of the pairs."""

    weight: Tensor  # (M,) 1 for a corner that follows the camera to 0 for one that does not
    along_weight: Tensor  # (M,) the same for the displacement along the line of the parallax
    sigma: float  # px, standard deviation of a corner
    depth: float  # standard deviation of m
    effects: Tensor  # (6,) px, of X, Y, radius theta, and of the deviations of the translation
    mean_translation: float  # px, prior of the mean translation
    # factor on the variances of corners, whose errors are correlated in a cell of the frame and in a pair
    inflation: float = 1.0


@dataclass(frozen=True, eq=False)
class RotationFit:
    """Result of a fit. Translations are displacements of a corner at the mean distance, and at ``radius`` for z."""

    model: RotationModel  # what was fitted
    parameters: Tensor  # (7,) in the order of ``NAMES``
    covariance: Tensor  # (7, 7), 0 for parameters that were not free
    translation: Tensor  # (3,) px, mean of all pairs
    effects: Tensor  # (P, 6) px, X, Y, radius theta, and deviations of the translation, of every pair
    errors: Errors
    cost: float  # sum of squares over their variance
    inflation: float = 1.0  # variance of the parameters over that of independent corners

    def significance(self, orientation: str, start: Tensor) -> float:
        """Difference of the sums of squares of the best fit with other axes or another start, in correlated errors."""
        fit = replace(self, model=replace(self.model, orientation=orientation), parameters=start)
        for _ in range(_STEPS + 1):  # the cost is that before the last step
            fit = fit.stepped()
        return (fit.cost - self.cost) / self.inflation

    def unshrunk(self) -> Tensor:
        """(P, 3) px, X, Y and radius theta of every pair from its corners alone."""
        loose = torch.cat([torch.full((3,), 1e3, dtype=torch.float64), self.errors.effects[3:]])
        model = replace(self.model, free=(False,) * len(NAMES))
        return replace(self, model=model, errors=replace(self.errors, effects=loose)).stepped().effects[:, :3]

    def stepped(self) -> "RotationFit":
        """The fit after a step of Gauss-Newton with the same weights."""
        return _solved(self, _linear(self, *_residuals(self)))[0]

    def information(self) -> Tensor:
        """(M, 2, 2) px^-2, inverse covariances of the displacements of the corners."""
        line, errors = self.parallax(), self.errors
        spread = errors.depth**2 * line[..., None] * line[:, None]
        inverse = torch.linalg.inv(errors.sigma**2 * torch.eye(2).to(spread) + spread)
        return errors.weight[:, None, None] * inverse

    def parallax(self) -> Tensor:
        """(M, 2) px, displacement of a corner at the mean distance by the translation."""
        return _parallax(self, self.translation + self.effects[self.model.tracks.pair, 3:])


def _parallax(fit: RotationFit, translation: Tensor) -> Tensor:
    """(M, 2) px by the translation in a frame period, in proportion to the time between the exposures of a corner."""
    tracks = fit.model.tracks
    duration = tracks.times(float(fit.parameters[6])).diff() / tracks.starts[tracks.pair].diff()
    place = (tracks.place - torch.tensor(fit.model.camera.principal_point, dtype=torch.float64)) / tracks.radius
    return duration * (translation[..., :2] + translation[..., 2:] * place)


def _sums(tracks: CornerTracks, values: Tensor) -> Tensor:
    """Sums (P, ...) over the corners of every pair of frames."""
    return values.new_zeros(len(tracks.starts), *values.shape[1:]).index_add(0, tracks.pair, values)


def _residuals(fit: RotationFit) -> tuple[Tensor, Tensor, Tensor]:
    """Displacements (M, 2) px beside the rotation; the slopes (M, 2, 7), and those by X, Y, radius theta (M, 2, 3)."""
    tracks, (slopes, factors) = fit.model.tracks, fit.model.slopes(fit.parameters)
    turned = factors * factors.new_tensor([1.0, 1.0, 1 / tracks.radius])
    return tracks.offsets - fit.model.predicted(fit.parameters), slopes, turned


@dataclass(frozen=True, eq=False)
class _Linear:
    """Residuals and derivatives of a fit, across the lines of the parallax and along them: (M, 2, ...)."""

    residual: Tensor  # (M, 2) px
    variance: Tensor  # (M, 2) px^2
    weight: Tensor  # (M, 2)
    slopes: Tensor  # (M, 2, 10) by parameters and mean translation
    effects: Tensor  # (M, 2, 6) by effects
    line: Tensor  # (M,) px, length of the parallax of a corner at the mean distance


def _linear(fit: RotationFit, values: Tensor, slopes: Tensor, turned: Tensor) -> _Linear:
    """The arguments are ``_residuals``."""
    tracks, errors = fit.model.tracks, fit.errors
    by_translation = torch.stack([_parallax(fit, axis) for axis in torch.eye(3, dtype=torch.float64)], -1)
    residual = values - (turned @ fit.effects[tracks.pair, :3, None])[..., 0]

    # 1. Coordinates across and along the lines of the parallax.
    parallax = fit.parallax()
    line = parallax.norm(dim=-1)
    unit = parallax / line.clamp(min=1e-9)[:, None]
    unit = torch.where(line[:, None] > 1e-9, unit, unit.new_tensor([1.0, 0.0]))
    frame = torch.stack([torch.stack([-unit[:, 1], unit[:, 0]], -1), unit], 1)  # (M, 2, 2)
    residual = (frame @ residual[..., None])[..., 0]

    # 2. m by its mean 1 and by the residual along the line. A wrong direction displaces near corners more.
    spread = (errors.depth * line).square()
    share = spread / (spread + errors.sigma**2)
    nearness = 1 + share * (residual[:, 1] / line.clamp(min=1e-9) - 1)
    scale = torch.stack([nearness.clamp(0.0, 5.0), torch.ones_like(line)], -1)
    by_translation = scale[..., None] * (frame @ by_translation)
    residual = torch.stack([residual[:, 0], residual[:, 1] - line], -1)
    return _Linear(
        residual,
        errors.inflation * torch.stack([torch.full_like(line, errors.sigma**2), errors.sigma**2 + spread], -1),
        torch.stack([errors.weight, errors.weight * errors.along_weight], -1),
        torch.cat([frame @ slopes, by_translation], -1),
        torch.cat([frame @ turned, by_translation], -1),
        line,
    )


def _solved(fit: RotationFit, linear: _Linear) -> tuple[RotationFit, Tensor, Tensor]:
    """A step of Gauss-Newton on parameters and effects.

    Also returns the variances (P, 6) of the effects, and the influence (M, 7) of each corner on the parameters.
    """
    tracks, errors = fit.model.tracks, fit.errors
    information = linear.weight / linear.variance
    weighted = information[..., None] * linear.effects
    prior = errors.effects.clamp(min=_LEAST_STD) ** -2
    of_pairs = _sums(tracks, weighted.mT @ linear.effects) + torch.diag(prior)  # (P, 6, 6)
    mixed = _sums(tracks, weighted.mT @ linear.slopes)  # (P, 6, 10)
    of_own = _sums(tracks, (weighted * linear.residual[..., None]).sum(1)) - prior * fit.effects
    inverse = torch.linalg.inv(of_pairs)
    gram = torch.einsum("mi,mia,mib->ab", information, linear.slopes, linear.slopes)
    gram = gram - (mixed.mT @ inverse @ mixed).sum(0)
    right = torch.einsum("mi,mi,mia->a", information, linear.residual, linear.slopes)
    right = right - torch.einsum("pia,pij,pj->a", mixed, inverse, of_own)
    usual = torch.tensor([_BIAS] * 3 + [math.inf] * 4 + [errors.mean_translation] * 3, dtype=torch.float64) ** -2
    usual = usual * (gram.diagonal() > 0)
    gram = gram + torch.diag(usual)
    right = right - usual * torch.cat([fit.parameters, fit.translation])
    covariance = tensor(scaled_inverse(table(gram)))
    change = covariance @ right
    # a step is at most a quarter of the focal length and of the row time, and 1 % of the scale
    limit = 0.25 * fit.parameters[5:7]
    change[5:7] = change[5:7].clamp(-limit, limit)
    change[4] = change[4].clamp(-0.01, 0.01)
    effects = fit.effects + (inverse @ (of_own - mixed @ change)[..., None])[..., 0]
    parameters = fit.parameters + change[:7]
    parameters[5] = parameters[5].clamp(min=MIN_FOCAL_LENGTH)
    cost = (information * linear.residual.square()).sum() + (prior * fit.effects.square()).sum()
    solved = replace(
        fit,
        parameters=parameters,
        covariance=covariance[:7, :7],
        translation=fit.translation + change[7:],
        effects=effects,
        cost=float(cost),
    )
    by_parameters = inverse @ mixed
    variances = (inverse + by_parameters @ covariance @ by_parameters.mT).diagonal(dim1=-2, dim2=-1)
    reduced = linear.slopes - linear.effects @ by_parameters[tracks.pair]
    influence = torch.einsum("mi,mi,mia->ma", information, linear.residual, reduced) @ covariance[:, :7]
    return solved, variances, influence


def _weighed(fit: RotationFit, linear: _Linear, of_effects: Tensor, follows: Tensor) -> Errors:
    """Weights and standard deviations from the residuals."""
    off, along = linear.residual.unbind(-1)
    old, used, is_still = fit.errors, fit.errors.weight > 0, fit.errors.depth == 0  # still: without a translation
    # 1. Corners: the median is not sensitive to those that move by themselves.
    lengths = linear.residual[used].abs() if is_still else off[used].abs()
    sigma = max(1.4826 * float(lengths.median()), _LEAST_STD)
    weight = follows * _biweight(off / sigma)
    # 2. Depths, from what the residuals along the lines have beyond sigma.
    used = weight > 0
    excess = 0.0 if is_still else max((1.4826 * float(along[used].abs().median())) ** 2 - sigma**2, 0.0)
    depth = (excess / max(float(linear.line[used].square().median()), 1e-12)) ** 0.5
    along_weight = _biweight(along / (sigma**2 + (depth * linear.line).square()).sqrt())
    # 3. Effects: their mean square over the determined part of their number (MacKay 1992); EM takes 100 rounds.
    determined = (1 - of_effects / old.effects.square()).clamp(min=1e-2).sum(0)
    effects = (fit.effects.square().sum(0) / determined).sqrt()
    effects = torch.minimum(torch.maximum(effects, old.effects / 3), old.effects * 3).clamp(min=_LEAST_STD)
    effects = torch.cat([effects[:3], old.effects[3:]]) if is_still else effects
    mean_translation = old.mean_translation if is_still else max(3 * excess**0.5, _LEAST_STD)
    return Errors(weight, along_weight, sigma, depth, effects, mean_translation, old.inflation)


def _biweight(size: Tensor) -> Tensor:
    return (1 - (size / _CUT).square().clamp(max=1.0)).square()


def fit_robustly(model: RotationModel, start: Tensor) -> RotationFit:
    """Fit the free ones of (7,) parameters; corners that do not follow the gyroscope have no weight."""
    tracks = model.tracks
    residual = tracks.offsets - model.predicted(start)
    follows = _following(tracks, tracks.offsets - residual).double()
    # 1. Without a translation.
    none = torch.zeros(len(tracks.starts), 6, dtype=torch.float64)
    sigma = max(1.4826 * float(residual[follows > 0].abs().median()), _LEAST_STD)
    spread = torch.tensor([_START_ROTATION] * 3 + [_LEAST_STD] * 3, dtype=torch.float64)
    errors = Errors(follows, torch.ones_like(follows), sigma, 0.0, spread, _LEAST_STD)
    fit = RotationFit(model, start, torch.zeros(7, 7).double(), none[0, :3], none, errors, 0.0)
    still = _weighted(fit, follows)
    # 2. With one, from its direction with the least median of the displacements across its lines.
    sampled = (follows > 0).nonzero()[:, 0]
    sampled = sampled[:: max(1, len(sampled) // 2000)]
    lines = torch.stack([_parallax(fit, direction)[sampled] for direction in _half_sphere()])
    unit = lines / lines.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    off = (residual[sampled, 0] * unit[..., 1] - residual[sampled, 1] * unit[..., 0]).abs().median(-1).values
    best = int(off.argmin())
    size = ((residual[sampled] * lines[best]).sum(-1) / lines[best].square().sum(-1).clamp(min=1e-9)).median()
    spread[3:] = 0.2 * size.abs() + _START_TRANSLATION
    sigma = max(1.4826 * float(off[best]), _LEAST_STD)
    errors = replace(errors, sigma=sigma, depth=1.0, effects=spread, mean_translation=10 * abs(float(size)) + sigma)
    moving = _weighted(replace(fit, translation=size * _half_sphere()[best], errors=errors), follows)
    # 3. A translation must explain more than noise, as it has a part of every rotation: across its lines.
    line = moving.parallax()
    unexplained = tracks.offsets - model.predicted(still.parameters)
    unexplained = unexplained - (_residuals(still)[2] @ still.effects[tracks.pair, :3, None])[..., 0]
    off = (unexplained[:, 0] * line[:, 1] - unexplained[:, 1] * line[:, 0]) / line.norm(dim=-1).clamp(min=1e-9)
    across = 1.4826 * float(off[still.errors.weight > 0].abs().median())
    simpler = across < (1 + _SIGNIFICANT / len(off) ** 0.5) * moving.errors.sigma
    fit = still if simpler else moving
    # 4. Again with correlated errors of corners. Without this, the rows of a frame outweigh what they have in common:
    # halves of a phone's recording (docs/gyroscope.md) had focal lengths of 566 +- 7 and 521 +- 14 px, and have 565
    # +- 3 and 562 +- 5 px; 0.13 instead of 0.09 px along y were not explained
    errors = replace(fit.errors, inflation=_with_correlated_errors(fit).inflation)
    return _with_correlated_errors(_weighted(replace(fit, errors=errors), follows))


def _weighted(fit: RotationFit, follows: Tensor) -> RotationFit:
    """Rounds of Gauss-Newton, weights and variances."""
    for number in range(_ROUNDS):
        (values, slopes, turned), before = _residuals(fit), fit.parameters
        fit, of_effects, _ = _solved(fit, _linear(fit, values, slopes, turned))
        linear = _linear(fit, values - slopes @ (fit.parameters - before), slopes, turned)
        errors = _weighed(fit, linear, of_effects, follows)
        fit = replace(fit, errors=replace(errors, effects=fit.errors.effects) if number < _HELD_ROUNDS else errors)
    return fit


def _with_correlated_errors(fit: RotationFit) -> RotationFit:
    """The fit with the covariance for residuals that are correlated.

    Effects of consecutive pairs with the correlation rho count as ``(1 - rho) / (1 + rho)`` of their number, and the
    fitted parameters take their part of them. Corners of a cell of the frame have errors in common (a wrong lens,
    edges that slide), and those of a pair: the covariance follows from the sums of their influences (cluster-robust,
    Liang and Zeger 1986), where it is larger.
    """
    tracks, errors, free = fit.model.tracks, fit.errors, torch.tensor(fit.model.free)
    pairs = len(tracks.starts)
    first, later = fit.effects[:-1], fit.effects[1:]
    rho = (first * later).sum(0) / (0.5 * (first.square() + later.square()).sum(0)).clamp(min=1e-300)
    rho = rho.clamp(0.0, 0.9) if pairs > 8 else torch.zeros(6).to(rho)  # fewer pairs have no known correlation
    wide = errors.effects * ((1 + rho) / (1 - rho) * pairs / max(pairs - int(free.sum()) / 3, 1.0)).sqrt()
    values, slopes, turned = _residuals(fit)
    linear, wider = _linear(fit, values, slopes, turned), replace(fit, errors=replace(errors, effects=wide))
    refitted, _, influence = _solved(wider, linear)
    cells = influence.new_zeros(CELL_ROWS * CELL_COLUMNS, 7).index_add(0, tracks.cell, influence)
    occupied = max(int((cells.abs().sum(-1) > 0).sum()), 2)
    clustered = cells.square().sum(0) * occupied / (occupied - 1)
    if pairs > 1:
        clustered = torch.maximum(clustered, _sums(tracks, influence).square().sum(0) * pairs / (pairs - 1))
    ratio = (clustered / refitted.covariance.diagonal().clamp(min=1e-300)).clamp(min=1.0)
    inflation = float(ratio[free].mean())
    covariance = refitted.covariance * ratio.sqrt() * ratio.sqrt()[:, None]
    # Noise of the rates, which turns all corners of a row alike: the covariance of the parameters over random draws.
    rates, generator = fit.model.rates, torch.Generator().manual_seed(0)
    noise, predicted = rates.noise, fit.model.predicted(fit.parameters)
    for _ in range(_DRAWS):
        drawn = noise * torch.randn(rates.rates.shape, dtype=torch.float64, generator=generator)
        noisy = replace(fit.model, rates=replace(rates, rates=rates.rates + drawn))
        changed = values + predicted - noisy.predicted(fit.parameters)
        change = _linear(fit, changed, slopes, turned).residual - linear.residual
        by_noise = _solved(wider, replace(linear, residual=change))[2].sum(0)
        covariance = covariance + torch.outer(by_noise, by_noise) / _DRAWS
    # Errors in proportion to the displacements, which change neither the bias nor the time of the middle row.
    parameters, row = fit.parameters, float(tracks.rows.amax()) / 2
    gains = torch.zeros(3, 7, dtype=torch.float64)
    gains[0, 5] = _GAIN_ERROR * parameters[5] * free[5]
    gains[1, 6] = _GAIN_ERROR * parameters[6] * free[6]
    gains[1, 3] = -row * gains[1, 6]
    gains[2, 3] = _ROW_ERROR * parameters[6]
    covariance = (covariance + gains.mT @ gains) * torch.outer(free, free)
    return replace(refitted, errors=errors, covariance=covariance, inflation=inflation)


def _half_sphere(count: int = 400) -> Tensor:
    """(N, 3) unit vectors with z >= 0 at equal distances (Fibonacci lattice)."""
    z = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    angle = torch.arange(count, dtype=torch.float64) * 2.399963229728653  # golden angle, rad
    ring = (1 - z.square()).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], -1)


def _following(tracks: CornerTracks, predicted: Tensor) -> Tensor:
    """(M,) bool: corners in cells whose displacements follow the predicted ones (M, 2) from pair to pair.

    The slope of the displacements over the predicted ones, less their means over the pairs, is 1 for a scene at rest,
    and 0 for what is fixed to the camera (a dashboard) and for places without detail. A parallax changes slowly.
    """
    cells = CELL_ROWS * CELL_COLUMNS

    def of_cells(values: Tensor) -> Tensor:
        total: Tensor = values.new_zeros(cells, *values.shape[1:]).index_add(0, tracks.cell, values)
        return total[tracks.cell]

    number = of_cells(torch.ones_like(tracks.place[:, :1]))
    varying = predicted - of_cells(predicted) / number
    limit = 3.0 * varying.abs().amax()  # px, of wrong matches
    measured = tracks.offsets - tracks.offsets.median(0).values
    measured = measured - of_cells(measured) / number
    product = of_cells((varying * measured.clamp(-limit, limit)).sum(-1))
    follows = product > 0.5 * of_cells(varying.square().sum(-1))
    return follows if float(follows.double().mean()) > 0.1 else torch.ones_like(follows)
