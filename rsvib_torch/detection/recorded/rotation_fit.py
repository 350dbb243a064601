"""Least-squares fit of a gyroscope's rates to the displacements between consecutive frames.

The rotation of the camera between the exposures of a part of a band in two frames displaces it by

    ``d = displacement(w),  w = A [rotation(tau1, tau2) - b (tau2 - tau1)],  tau = at + scale (t - middle)``

with the assignment A of the axes and the bias b. The covariance of the residuals has three parts, whose sizes are
estimated from the residuals:

* sigma: independent errors of the parts;
* spread: one displacement (X, Y, theta) of every pair of frames (errors of the gyroscope, a scene that sways);
* parallax: a camera that translates along (tx, ty, tz) displaces content at distance Z by ``m s`` with
  ``s = tz (x - c) - f (tx, ty)`` and ``m = translation / Z``, a different one for every part. Displacements along s
  therefore determine the rotation less than those across s. The direction of the translation is the same in all frames
  (a vehicle, a platform), and is found by a search.

Invariant: the displacement depends on the row only (docs/architecture.md), in parts of the columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.core.splines import gauss_legendre
from rsvib_torch.detection.recorded.band_vectors import BandVectors
from rsvib_torch.detection.recorded.rotation_search import MIN_FOCAL_LENGTH, orientation_matrix
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.gyroscope_rates import AngularRates

NAMES = ("bias x", "bias y", "bias z", "at", "scale", "focal length", "row time")
_STEPS = 8  # of Gauss-Newton in a round of weighting; it converges within 4 and stops when no parameter changes


def components_of(rates: AngularRates, orientation: str, parameters: Tensor, times: Tensor, middle: float) -> Tensor:
    """(M, 3) X and Y in px and theta in rad between two times (M, 2) in s on the clock of the frames."""
    first, last = (parameters[3] + parameters[4] * (times - middle)).unbind(-1)
    turned = rates.rotation(first, last) - (last - first)[:, None] * parameters[:3]
    pitch, yaw, roll = (turned @ orientation_matrix(orientation).T).unbind(-1)
    return torch.stack([-parameters[5] * yaw, parameters[5] * pitch, -roll], -1)


@dataclass(frozen=True, eq=False)
class RotationModel:
    """What the displacements depend on besides the parameters of the fit."""

    vectors: BandVectors  # the measurements
    rates: AngularRates  # the recording
    orientation: str  # name of the assignment of the axes
    camera: Camera  # principal point and lens; its focal length is a parameter of the fit
    exposure_time: float  # s
    middle: float  # s, mid-time of the frames

    def predicted(self, parameters: Tensor) -> Tensor:
        """Displacements (M, 2) in px for parameters (7,) in the order of ``NAMES``."""
        mean = torch.zeros_like(self.vectors.offsets)
        x, y = self.vectors.place.unbind(-1)
        camera = replace(self.camera, focal_length=float(parameters[5]))
        nodes, weights = gauss_legendre(2)  # exact for a motion of third order within an exposure
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            mean += weight * camera.displacement(self.components(parameters, node), x, y)
        return mean

    def components(self, parameters: Tensor, node: float) -> Tensor:
        """(M, 3) X and Y in px and theta in rad, at a fraction ``node`` of the exposure."""
        times = self.vectors.times(float(parameters[6])) + node * self.exposure_time
        return components_of(self.rates, self.orientation, parameters, times, self.middle)

    def slopes(self, parameters: Tensor, free: Sequence[bool]) -> Tensor:
        """(M, 2, 7) derivatives of ``predicted``, by central differences; 0 for parameters that are not free."""
        steps = [1e-4] * 3 + [1e-5, 1e-6, 1e-4 * float(parameters[5]), 1e-3 * float(parameters[6])]
        columns = []
        for index, step in enumerate(steps):
            if not free[index]:
                columns.append(torch.zeros_like(self.vectors.offsets))
                continue
            change = torch.zeros_like(parameters)
            change[index] = step
            columns.append((self.predicted(parameters + change) - self.predicted(parameters - change)) / (2 * step))
        return torch.stack(columns, -1)


@dataclass(frozen=True, eq=False)
class _Errors:
    """Covariance of the displacements."""

    weight: Tensor  # (M,) weights of the parts, 0 for those that do not follow the gyroscope
    shape: Tensor  # (M, 2, 2) structure of the detail of the parts, with trace 2
    sigma: float  # px, standard deviation of a part of weight 1
    spread: Tensor  # (3,) px, standard deviation of X, Y and radius theta of the pairs
    parallax: float  # standard deviation of m
    direction: Tensor  # (3,) unit vector of the translation
    lines: Tensor  # (M, 2) px, s
    turned: Tensor  # (M, 2, 2) px, s for the two unit vectors perpendicular to the direction

    @property
    def information(self) -> Tensor:
        """(M, 2, 2) px^-2, inverse covariance of the parts without that of the pairs."""
        inner = (self.weight / self.sigma**2)[:, None, None] * self.shape
        along = inner @ self.lines[..., None]
        share = self.parallax**2 / (1 + self.parallax**2 * (self.lines * along[..., 0]).sum(-1))
        return inner - share[:, None, None] * along @ along.mT


@dataclass(frozen=True, eq=False)
class RotationFit:
    """Result of a fit."""

    model: RotationModel  # what was fitted
    parameters: Tensor  # (7,) in the order of ``NAMES``
    covariance: Tensor  # (7, 7), 0 for parameters that were not free
    residual: Tensor  # (M, 2) px
    errors: _Errors  # their covariance
    wide: _Errors  # the same, larger by the correlation of neighbours, from which ``covariance`` and ``cost`` follow
    effects: Tensor  # (P, 3) px, X, Y and radius theta of every pair that the gyroscope does not explain
    cost: float  # sum of squares over their variance

    def rows_rms(self) -> Tensor:
        """(3,) px, rms X, Y and radius theta of single bands that the gyroscope does not explain."""
        vectors = self.model.vectors
        bands = replace(
            vectors, pair=vectors.pair * vectors.num_rows + vectors.row, num_pairs=vectors.num_pairs * vectors.num_rows
        )
        effects, covariance = _pair_effects(bands, self.errors.information, self.residual)
        known = covariance.diagonal(dim1=-2, dim2=-1)[:, :2].amax(-1) < 1.0  # px^2; fewer parts determine no roll
        return effects[known].square().mean(0).sqrt()

    def cost_with(self, orientation: str, start: Tensor, free: Sequence[bool]) -> float:
        """Sum of squares of the best fit with other axes and the same covariance of the displacements."""
        *_, cost = _converged(replace(self.model, orientation=orientation), self.wide, start, free)
        return cost


def _summed(vectors: BandVectors, values: Tensor) -> Tensor:
    """Sums (P, ...) over the parts of every pair of frames."""
    return values.new_zeros(vectors.num_pairs, *values.shape[1:]).index_add(0, vectors.pair, values)


def _pair_effects(vectors: BandVectors, information: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Effects (P, 3) in px of every pair by least squares, and their covariances (P, 3, 3)."""
    factors = vectors.factors()
    normal = _summed(vectors, factors.mT @ information @ factors)
    right = _summed(vectors, (factors.mT @ (information @ residual[..., None]))[..., 0])
    size = normal.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=1e-300)
    covariance = torch.linalg.inv(normal + 1e-9 * size[:, None, None] * torch.eye(3, dtype=normal.dtype))
    return (covariance @ right[..., None])[..., 0], covariance


def _without_effects(vectors: BandVectors, residual: Tensor, effects: Tensor) -> Tensor:
    return residual - (vectors.factors() @ effects[vectors.pair][..., None])[..., 0]


def _split(errors: _Errors, rest: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Residuals (M,) in px across the lines of the parallax and along them, and the variances of both for sigma = 1."""
    unit = errors.lines / errors.lines.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    normal = torch.stack([-unit[:, 1], unit[:, 0]], -1)
    # 5 % of the mean information bound the variance along edges
    inverse = torch.linalg.inv(errors.shape + 0.05 * torch.eye(2, dtype=rest.dtype))
    inverse = inverse / errors.weight.clamp(min=1e-300)[:, None, None]
    variances = (torch.einsum("mi,mij,mj->m", one, inverse, one) for one in (normal, unit))
    return (normal * rest).sum(-1), (unit * rest).sum(-1), *variances


def _solve(vectors: BandVectors, errors: _Errors, slopes: Tensor, residual: Tensor) -> tuple[Tensor, Tensor, float]:
    """Change (7,) and covariance (7, 7) of the parameters, and the sum of squares, by generalised least squares.

    The inverse of the covariance of all residuals of a pair follows from the matrix inversion lemma. What all pairs
    have in common is eliminated: the mean of the parallax, and the error of its direction. In three pairs with a
    parallax of 3 px, the bias was wrong by up to 29 standard deviations without this.
    """
    count = slopes.shape[-1]
    if errors.parallax > 0:
        slopes = torch.cat([slopes, _common_parallax(errors, residual)], -1)
    factors = vectors.factors() * errors.spread  # (M, 2, 3)
    information = errors.information
    weighted = factors.mT @ information
    capacity = torch.eye(3, dtype=residual.dtype) + _summed(vectors, weighted @ factors)
    of_slopes = _summed(vectors, weighted @ slopes)  # (P, 3, 7)
    of_residual = _summed(vectors, (weighted @ residual[..., None])[..., 0])
    solved = torch.linalg.solve(capacity, of_residual)
    gram = torch.einsum("mia,mij,mjb->ab", slopes, information, slopes)
    gram = gram - (of_slopes.mT @ torch.linalg.solve(capacity, of_slopes)).sum(0)
    right = torch.einsum("mia,mij,mj->a", slopes, information, residual)
    right = right - torch.einsum("pij,pi->j", of_slopes, solved)
    cost = torch.einsum("mi,mij,mj->", residual, information, residual) - (of_residual * solved).sum()
    if errors.parallax > 0:
        prior = torch.tensor([errors.parallax**-2, 1.0, 1.0], dtype=gram.dtype)  # the direction is free
        common = gram[count:, count:] + torch.diag(prior)
        shared = torch.linalg.solve(common, torch.cat([gram[count:, :count], right[count:, None]], -1))
        cost = cost - right[count:] @ shared[:, -1]
        right = right[:count] - gram[:count, count:] @ shared[:, -1]
        gram = gram[:count, :count] - gram[:count, count:] @ shared[:, :-1]
    size = torch.where(gram.diagonal() > 0, gram.diagonal(), 1.0).sqrt()
    inverse = torch.linalg.pinv(gram / size / size[:, None], rtol=1e-12, hermitian=True) / size / size[:, None]
    return inverse @ right, inverse, float(cost)


def _common_parallax(errors: _Errors, residual: Tensor) -> Tensor:
    """(M, 2, 3) change of the displacements by a mean of m, and by the two components of an error of the direction.

    The latter is proportional to m of each part, which is estimated from its residual.
    """
    size = (errors.weight[:, None] * errors.lines.square()).sum(-1) * (errors.parallax / errors.sigma) ** 2
    along = (errors.lines * residual).sum(-1) / errors.lines.square().sum(-1).clamp(min=1e-300)
    parallax = (along * size / (1 + size)).clamp(-5 * errors.parallax, 5 * errors.parallax)
    return torch.cat([errors.lines[..., None], parallax[:, None, None] * errors.turned], -1)


def _converged(
    model: RotationModel, errors: _Errors, start: Tensor, free: Sequence[bool]
) -> tuple[Tensor, Tensor, Tensor, float]:
    """Parameters, covariance, residual and cost of Gauss-Newton with a fixed covariance of the displacements."""
    parameters = start
    for _ in range(_STEPS):
        residual = model.vectors.offsets - model.predicted(parameters)
        change, covariance, cost = _solve(model.vectors, errors, model.slopes(parameters, free), residual)
        limit = 0.25 * parameters[5:7]  # a step is at most a quarter of the focal length and of the row time
        change[5:7] = change[5:7].clamp(-limit, limit)
        change[4] = change[4].clamp(-0.01, 0.01)
        parameters = parameters + change
        parameters[5] = parameters[5].clamp(min=MIN_FOCAL_LENGTH)
        if bool((change.abs() <= 1e-2 * covariance.diagonal().sqrt()).all()):
            break
    return parameters, covariance, model.vectors.offsets - model.predicted(parameters), cost


def _lines(camera: Camera, place: Tensor, direction: Tensor, focal_length: float) -> Tensor:
    """(..., M, 2) px, lines of the parallax at places (M, 2) for unit vectors (..., 3) of the translation."""
    place = place - place.new_tensor(camera.principal_point)
    return direction[..., 2:, None] * place - focal_length * direction[..., None, :2]


def _direction(
    model: RotationModel, focal_length: float, weight: Tensor, rest: Tensor, scale: float, most: int = 2000
) -> Tensor:
    """(3,) direction of the translation for which the residuals (M, 2) lie along the lines of the parallax.

    Directions are compared on a grid of the half sphere, and on finer ones around the best. The cost of a residual is
    bounded: most residuals of the right direction are small, and outliers do not matter. At most ``most`` parts
    are used.
    """
    part = slice(None, None, max(1, len(rest) // most))
    weight, rest, place = weight[part], rest[part], model.vectors.place[part]
    inverse = torch.linalg.inv(model.vectors.shape[part] + 0.05 * torch.eye(2, dtype=rest.dtype))
    step, best = 0.1, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    grid = torch.linspace(-1.0, 1.0, 21, dtype=torch.float64)
    while step > 1e-3:
        first, second = torch.linalg.svd(best[None])[2][1:]
        tries = best + grid[:, None, None] * (10 * step) * first + grid[:, None] * (10 * step) * second
        tries = tries.reshape(-1, 3) if step < 0.1 else torch.cat([tries.reshape(-1, 3), _half_sphere()])
        tries = tries / tries.norm(dim=-1, keepdim=True)
        costs = []
        for some in tries.split(64):
            lines = _lines(model.camera, place, some, focal_length)
            lines = lines / lines.norm(dim=-1, keepdim=True).clamp(min=1e-9)
            normal = torch.stack([-lines[..., 1], lines[..., 0]], -1)
            off = (normal * rest).sum(-1).square() * weight / torch.einsum("dmi,mij,dmj->dm", normal, inverse, normal)
            costs.append((weight * off / (scale**2 + off)).sum(-1))
        best = tries[int(torch.cat(costs).argmin())]
        step *= 0.1
    return best


def _half_sphere(count: int = 400) -> Tensor:
    """(N, 3) unit vectors with z >= 0 at equal distances (Fibonacci lattice)."""
    z = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    angle = torch.arange(count, dtype=torch.float64) * 2.399963229728653  # golden angle, rad
    ring = (1 - z.square()).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], -1)


def _biweight(size: Tensor, cut: float) -> Tensor:
    return (1 - (size / cut).square().clamp(max=1.0)).square()


def _square(vectors: BandVectors, errors: _Errors, rest: Tensor) -> Tensor:
    """(M,) squared residuals in variances of a part, before robust weights; those along the parallax count less."""
    information = replace(errors, weight=vectors.weight).information
    return torch.einsum("mi,mij,mj->m", rest, information, rest)


def _following(vectors: BandVectors, predicted: Tensor) -> Tensor:
    """(M,) bool: parts at places whose displacements follow the predicted ones (M, 2) from pair to pair.

    The slope of the displacements over the predicted ones, less their means over the pairs, is 1 for a scene at rest,
    and 0 for what is fixed to the camera (a dashboard) and for places without detail. A parallax changes slowly.
    """
    places = vectors.num_rows * vectors.num_columns

    def of_places(values: Tensor) -> Tensor:
        total: Tensor = values.new_zeros(places, *values.shape[1:]).index_add(0, vectors.location, values)
        return total

    number = of_places(torch.ones_like(vectors.weight)).clamp(min=1.0)
    varying = predicted - (of_places(predicted) / number[:, None])[vectors.location]
    limit = 3.0 * varying.abs().amax()  # px, of wrong matches
    measured = vectors.offsets - vectors.offsets.median(0).values
    measured = measured - (of_places(measured) / number[:, None])[vectors.location]
    product = of_places((varying * measured.clamp(-limit, limit)).sum(-1))
    follows = (product > 0.5 * of_places(varying.square().sum(-1)))[vectors.location]
    return follows if float(follows.double().mean()) > 0.1 else torch.ones_like(follows)


def _robust_weights(vectors: BandVectors, square: Tensor, counted: Tensor) -> Tensor:
    """Weights (M,) of parts by their squared residuals, and of their places by those of all pairs.

    A place whose residuals are large in most pairs moves by itself; in pairs with little motion its displacement agrees
    with that of the scene nevertheless.
    """
    places = vectors.num_rows * vectors.num_columns
    number = torch.zeros(places, dtype=square.dtype).index_add(0, vectors.location, torch.ones_like(square))
    spread = float(square[counted].median()) / 1.386  # the median of the squares of two components is 1.386 variances
    limited = square.clamp(max=25 * spread)  # single outliers do not exclude their place
    of_place = limited.new_zeros(places).index_add(0, vectors.location, limited) / number.clamp(min=1.0)
    typical = float(of_place[vectors.location[counted]].median())
    place = _biweight((of_place / max(typical, 1e-300)).sqrt(), 3.0)[vectors.location]
    return vectors.weight * place * _biweight((square / max(spread, 1e-300)).sqrt(), 6.0)


def _estimated(
    model: RotationModel, errors: _Errors, residual: Tensor, parameters: Tensor, fitted: int, *, with_effects: bool
) -> tuple[_Errors, Tensor]:
    """Sizes of the errors from the residuals, and the effects (P, 3) of the pairs."""
    vectors, focal_length = model.vectors, float(parameters[5])
    effects, covariance = _pair_effects(vectors, errors.information, residual)
    if not with_effects:
        effects = torch.zeros_like(effects)
    rest = _without_effects(vectors, residual, effects)
    weight = errors.weight
    square = torch.einsum("mi,mij,mj->m", rest, vectors.weight[:, None, None] * vectors.shape, rest)
    scale = float(square[weight > 0].median() / 1.386) ** 0.5
    direction = _direction(model, focal_length, weight, rest, max(0.5 * scale, 1e-6))
    across = torch.linalg.svd(direction[None]).Vh[1:]  # (2, 3)
    lines, *turned = _lines(model.camera, vectors.place, torch.stack([direction, *across]), focal_length)
    errors = replace(errors, direction=direction, lines=lines, turned=torch.stack(turned, -1))
    off, along, off_variance, along_variance = _split(errors, rest)
    counted = float((weight > 0).sum())
    sigma = float((off.square() / off_variance).sum() / max(counted - 1.5 * vectors.num_pairs, 1.0)) ** 0.5
    length = errors.lines.square().sum(-1)
    excess = (along.square() / along_variance).sum() - counted * sigma**2
    parallax = float((excess / (length / along_variance).sum().clamp(min=1e-300)).clamp(min=0.0)) ** 0.5
    known = covariance.diagonal(dim1=-2, dim2=-1)
    used = _summed(vectors, (weight > 0).to(weight)) > 8
    # the fitted parameters take their part of the effects
    total = 3 * float(used.sum())
    spread = (
        (effects[used].square() * (total / max(total - fitted, 1.0)) - known[used])
        .mean(0)
        .clamp(min=0.0)
        .sqrt()
        .nan_to_num(0.0)
    )
    spread = spread if with_effects else torch.zeros_like(spread)
    return replace(errors, sigma=max(sigma, 1e-6), parallax=parallax, spread=spread), effects


def fit_robustly(model: RotationModel, start: Tensor, free: Sequence[bool], rounds: int = 8) -> RotationFit:
    """Fit the ``free`` of (7,) parameters; parts of bands that do not follow the gyroscope have no weight."""
    vectors, parameters = model.vectors, start
    residual = vectors.offsets - model.predicted(start)
    none = torch.zeros(3, dtype=torch.float64)
    errors = _Errors(
        vectors.weight,
        vectors.shape,
        1.0,
        none,
        0.0,
        none,
        torch.zeros_like(residual),
        torch.zeros(len(residual), 2, 2),
    )
    errors = replace(errors, weight=vectors.weight * _following(vectors, model.predicted(start)))
    errors, effects = _estimated(model, errors, residual, parameters, sum(free), with_effects=False)
    for number in range(rounds):
        square = _square(vectors, errors, _without_effects(vectors, residual, effects))
        follows = _following(vectors, vectors.offsets - residual)
        weight = follows * _robust_weights(vectors, square, (errors.weight > 0) & follows)
        errors = replace(errors, weight=weight)
        parameters, covariance, residual, cost = _converged(model, errors, parameters, free)
        # effects of pairs are known after the places that do not follow are
        errors, effects = _estimated(model, errors, residual, parameters, sum(free), with_effects=number > 0)
    fit = RotationFit(model, parameters, covariance, residual, errors, errors, effects, cost)
    return _with_correlated_errors(fit, free)


def _with_correlated_errors(fit: RotationFit, free: Sequence[bool]) -> RotationFit:
    """The fit with the covariance for residuals that are correlated between neighbours.

    Overlapping bands, detail at other distances and wrong models correlate residuals; those of a first-order process
    with the correlation rho of neighbours count as ``(1 - rho) / (1 + rho)`` of their number, along rows,
    columns and pairs.
    """
    vectors, errors = fit.model.vectors, fit.errors
    shape = (vectors.num_pairs, vectors.num_columns, vectors.num_rows)
    scaled = torch.full(shape, torch.nan, dtype=torch.float64)
    column, used = vectors.location // vectors.num_rows, errors.weight > 0
    off, _, variance, _ = _split(errors, _without_effects(vectors, fit.residual, fit.effects))
    scaled[vectors.pair[used], column[used], vectors.row[used]] = (off / variance.sqrt())[used]
    inflation = _inflation(scaled, 0) * _inflation(scaled, 1) * max(_inflation(scaled, 2), vectors.overlap)
    of_pairs = fit.effects if vectors.num_pairs > 8 else fit.effects[:0]  # fewer pairs have no known correlation
    # the effects themselves bound their standard deviation, of which noise of the same size hides the true one
    total = 3 * len(fit.effects)
    upper = (fit.effects.square().mean(0) * (total / max(total - sum(free), 1.0))).sqrt()
    wide = replace(
        errors,
        sigma=errors.sigma * inflation**0.5,
        parallax=errors.parallax * inflation**0.5,
        spread=torch.maximum(errors.spread, upper) * _inflation(of_pairs, 0) ** 0.5,
    )
    _, covariance, cost = _solve(vectors, wide, fit.model.slopes(fit.parameters, free), fit.residual)
    return replace(fit, wide=wide, covariance=covariance, cost=cost)


def _inflation(values: Tensor, axis: int) -> float:
    """Factor of the variance of a mean of values that are correlated along an axis; NaN marks missing values."""
    if values.shape[axis] < 2:
        return 1.0
    first, later = values.narrow(axis, 0, values.shape[axis] - 1), values.narrow(axis, 1, values.shape[axis] - 1)
    both = torch.isfinite(first) & torch.isfinite(later)
    energy = 0.5 * (first[both].square().sum() + later[both].square().sum())
    rho = float((first[both] * later[both]).sum() / energy.clamp(min=1e-300))
    rho = min(max(rho, 0.0), 0.95)
    return (1 + rho) / (1 - rho)
