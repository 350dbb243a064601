"""Edge spread function of any shape: Gaussian optics and square pixels, plus what the pixels say beyond that.

The departure from the Gaussian model is a smooth random function of the distance from the edge (a cubic B-spline with
a Gaussian-process prior) whose strength, smoothness and reach are weighted by how well each explains the pixels
(restricted likelihood). Where the pixels agree with the model, it shrinks to nothing and costs no noise; where they do
not, it follows them.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.evaluation.slanted_edge.curve import transfer
from rsvib_torch.evaluation.slanted_edge.geometry import EdgeFit, Scatter, linearised, moved
from rsvib_torch.evaluation.slanted_edge.model import edge_spread

__all__ = ["Spread", "fit_spread"]

_KNOT = 0.25  # px between knots of the spline at the edge
_STRETCH = 10.0  # px from the edge, where they are 1.4 times as far apart, and ever farther beyond
_MOST_KNOTS = 220
_REACH = 2.0  # knots that stay clear of the ROI's borders
_SMOOTHNESS = (0.4, 0.8, 1.8)  # px, correlation lengths of the departures
_DECAY = ((1.0, 2), (2.5, 2), (6.0, 2), (2.0, 1))  # px from the edge and power with which they fade
_STRENGTH = (0.0, *(10.0 ** (0.5 * k) for k in range(-10, 0)))  # of the departures, parts of the contrast
_SHADING = (0.0, 0.1)  # slope of the sides across the edge, parts of the contrast per half ROI
_FLOOR = 1e-6  # of the contrast: noise below this is rounding
_ROUNDS = 3  # of relinearising
_WIDTHS = 8.0  # standard deviations of the line spread function that the result spans
_SAMPLES = 16  # per px of the result
_NEGLIGIBLE = 1e-3  # weight of a prior
_RANDOM = [6, 9]  # derivatives of the fit that have a prior: by the slopes of the sides across the edge
_FIXED = [0, 1, 2, 3, 4, 5, 7, 8, 10]


@dataclass(frozen=True)
class Spread:
    """Edge and line spread function with what is needed to state their uncertainty.

    Attributes:
        fit: Edge, Gaussian blur and sides that the departure is added to.
        position: (N,) px.
        esf: (N,) edge spread function.
        lsf: (N,) its derivative.
        alternatives: (A, N) line spread functions by prior.
        weights: (A,) of the alternatives.
        basis: (N, R) derivatives of the line spread function by what is uncertain.
        roots: (A, R, S) square roots of the covariance of what is uncertain, by prior.
        noise: () standard deviation of the noise of a pixel.
    """

    fit: EdgeFit
    position: Tensor
    esf: Tensor
    lsf: Tensor
    alternatives: Tensor
    weights: Tensor
    basis: Tensor
    roots: Tensor
    noise: Tensor

    def std(self, frequency: Tensor) -> Tensor:
        """Standard deviation of the MTF at frequencies (F,)."""
        mean = transfer(self.position, self.lsf, frequency)
        mtf, phase = mean.abs(), mean.angle()
        ramps = torch.cos(2 * math.pi * frequency[:, None] * self.position + phase[:, None]) / self.lsf.sum()
        within = (ramps @ self.basis @ self.roots).square().sum(-1)
        between = (transfer(self.position, self.alternatives, frequency).abs() - mtf).square()
        return (self.weights @ (within + between)).sqrt()


@dataclass(frozen=True)
class _Knots:
    """Cubic B-splines, evenly spaced in ``u = stretch asinh(distance / stretch)``."""

    place: Tensor  # (K,) values of u
    step: float
    stretch: float

    @property
    def distance(self) -> Tensor:
        """(K,) px."""
        return self.stretch * torch.sinh(self.place / self.stretch)

    def values(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Splines (N, K) at distances (N,), and their derivatives per px."""
        squeeze = torch.rsqrt(1 + (distance / self.stretch).square()) / self.step
        u = (self.stretch * torch.asinh(distance / self.stretch)[:, None] - self.place) / self.step
        a = u.abs()
        inner, outer = a < 1, a < 2
        rest = 2 - a
        value = torch.where(inner, 2 / 3 - a**2 + 0.5 * a**3, torch.where(outer, rest**3 / 6, 0.0))
        slope = torch.where(inner, (1.5 * a - 2) * a, torch.where(outer, -0.5 * rest**2, 0.0)) * u.sign()
        return value, slope * squeeze[:, None]


def _lay_knots(room: float, width: float, like: Tensor) -> _Knots:
    stretch = _STRETCH * max(1.0, width)
    reach = stretch * math.asinh(room / stretch)
    step = max(_KNOT, 2 * reach / _MOST_KNOTS)
    half = max(int(reach / step - _REACH), 2)
    return _Knots(step * torch.arange(-half, half + 1, dtype=like.dtype, device=like.device), step, stretch)


@dataclass(frozen=True)
class _Departure:
    """Posterior of the spline's coefficients under every prior worth a thought."""

    weights: Tensor  # (A,)
    coefficients: Tensor  # (A, K)
    roots: Tensor  # (A, K, K) square roots of the covariances
    fixed: Tensor  # (11,) step of the other parameters at the mean coefficients
    projection: Tensor  # (11, K) how they follow the coefficients
    fixed_root: Tensor  # (11, 11) square root of their covariance


def _priors(knots: _Knots, scale: float) -> Tensor:
    """Square roots (P, 2 + K, 2 + K) of the prior covariances of slopes and spline at strength 1."""
    place, distance = knots.place, knots.distance.abs()
    apart = (place[:, None] - place).square()
    smooth = torch.stack([torch.exp(-0.5 * apart / (scale * length) ** 2) for length in _SMOOTHNESS])
    fade = torch.stack([(1 + (distance / (scale * reach)).square()) ** (-0.5 * power) for reach, power in _DECAY])
    prior = (smooth[:, None] * fade[:, :, None] * fade[:, None, :]).flatten(0, 1)
    prior.diagonal(dim1=-2, dim2=-1).add_(1e-9)
    roots: Tensor = torch.linalg.cholesky(prior)
    return roots


def _posterior(X: Tensor, Z: Tensor, residual: Tensor, roots: Tensor, contrast: Tensor) -> _Departure:
    """Random-effects fit of ``residual = X fixed + Z coefficients + unit noise``.

    The first two coefficients are the slopes of the sides, the others the spline's.
    """
    size = X.norm(dim=0).clamp(min=1e-12 * float(X.norm()))
    X = X / size
    normal = X.T @ X
    normal.diagonal().add_(1e-13)
    factor = torch.linalg.cholesky(normal)
    projection = torch.cholesky_solve(X.T @ Z, factor)
    start = torch.cholesky_solve((X.T @ residual)[:, None], factor)[:, 0]
    gram = Z.T @ Z - (X.T @ Z).T @ projection
    right = Z.T @ residual - projection.T @ (X.T @ residual)

    found = []
    for shading in _SHADING:
        # slopes first, at their own strength: what they explain is taken out of the spline's equations
        slope_gram = gram[:2, :2] * (shading * contrast) ** 2 + torch.eye(2, dtype=X.dtype, device=X.device)
        gain = (shading * contrast) ** 2 * torch.linalg.inv(slope_gram)
        spline_gram = gram[2:, 2:] - gram[2:, :2] @ gain @ gram[:2, 2:]
        spline_right = right[2:] - gram[2:, :2] @ gain @ right[:2]
        base = 0.5 * right[:2] @ gain @ right[:2] - 0.5 * torch.logdet(slope_gram)
        values, vectors = torch.linalg.eigh(roots.mT @ spline_gram @ roots)
        values = values.clamp(min=0.0)[:, None]
        modes = roots @ vectors
        seen = (modes.mT @ spline_right)[:, None]
        strength = X.new_tensor(_STRENGTH).square()[:, None]
        shrunk = strength / (1 + strength * values)  # (P, S, K)
        evidence = base + 0.5 * (shrunk * seen.square() - torch.log1p(strength * values)).sum(-1)
        found.append((evidence, modes, shrunk, shrunk * seen, gain))

    best = torch.stack([evidence.max() for evidence, *_ in found]).max()
    weights, coefficients, spreads = [], [], []
    for evidence, modes, shrunk, mean, gain in found:
        weight = torch.exp(evidence - best)
        kept = weight > _NEGLIGIBLE
        which = kept.nonzero()[:, 0]
        weights.append(weight[kept])
        spline = (modes[which] @ mean[kept][..., None])[..., 0]
        # slopes follow the spline
        follow = -gain @ gram[:2, 2:]
        coefficients.append(torch.cat([gain @ right[:2] + spline @ follow.T, spline], dim=1))
        root = modes[which] * shrunk[kept].sqrt()[:, None]
        own = torch.linalg.cholesky(gain + 1e-30 * torch.eye(2, dtype=X.dtype, device=X.device))
        upper = torch.cat([own.expand(len(root), 2, 2), follow @ root], dim=2)
        lower = torch.cat([root.new_zeros(*root.shape[:2], 2), root], dim=2)
        spreads.append(torch.cat([upper, lower], dim=1))
    weight, coefficient = torch.cat(weights), torch.cat(coefficients)
    weight = weight / weight.sum()
    fixed = start - projection @ (weight @ coefficient)
    return _Departure(
        weight,
        coefficient,
        torch.cat(spreads),
        fixed / size,
        projection / size[:, None],
        torch.linalg.inv(factor).T / size[:, None],
    )


def _noise(X: Tensor, Z: Tensor, residual: Tensor, bright: Tensor, floor: float) -> Tensor:
    """Standard deviation of the noise of every pixel: a variance linear in the grey value (shot noise)."""
    design = torch.cat([X / X.norm(dim=0).clamp(min=1e-12 * float(X.norm())), Z / Z.norm(dim=0).clamp(min=1e-9)], dim=1)
    normal = design.T @ design
    normal.diagonal().add_(1e-9)
    left = residual - design @ torch.linalg.solve(normal, design.T @ residual)
    freedom = len(residual) / max(len(residual) - design.shape[1], 0.3 * len(residual))
    share = torch.stack([1 - bright, bright])
    variances = freedom * (share @ left.square()) / share.sum(1)
    noise: Tensor = (variances @ share).clamp(min=floor**2).sqrt()
    return noise


def _quantisation(values: Tensor) -> float:
    """Standard deviation of rounding to steps; 0 for values that are not on steps."""
    levels = values.unique()
    if len(levels) > len(values) // 4:
        return 0.0
    return float(levels.diff().min()) / math.sqrt(12)


def fit_spread(fit: EdgeFit, scatter: Scatter, room: float) -> Spread:
    """Fit the edge spread function without assuming a shape.

    Args:
        fit: Edge and blur from ``fit_edge``.
        scatter: The pixels.
        room: px from the edge to the nearer of the ROI's borders alongside it.
    """
    knots = _lay_knots(room, float(fit.width), scatter.x)
    roots = _priors(knots, max(1.0, float(fit.width)))
    mean = knots.place.new_zeros(len(knots.place))
    noise = torch.zeros_like(scatter.value)
    for count in range(_ROUNDS):
        model, jacobian, distance = linearised(fit, scatter)
        planes = fit.planes(scatter)[0]
        contrast = planes[:, 1] - planes[:, 0]
        values, slopes = knots.values(distance)
        jacobian[:, :4] += (contrast * (slopes @ mean))[:, None] * fit.distance(scatter)[1]
        X, Z = jacobian[:, _FIXED], torch.cat([jacobian[:, _RANDOM], contrast[:, None] * values], dim=1)
        residual = scatter.value - model + Z[:, :2] @ fit.sides[:, 1]
        if count == 0:
            bright = ((model - planes[:, 0]) / contrast).clamp(0.0, 1.0)
            noise = _noise(X, Z, residual, bright, max(_FLOOR * float(fit.contrast), _quantisation(scatter.value)))
        departure = _posterior(X / noise[:, None], Z / noise[:, None], residual / noise, roots, fit.contrast)
        coefficients = departure.weights @ departure.coefficients
        mean = coefficients[2:]
        step = torch.zeros_like(jacobian[0])
        step[_FIXED] = departure.fixed
        step[_RANDOM] = coefficients[:2] - fit.sides[:, 1]
        before, fit = fit, moved(fit, step)
    return _sampled(before, departure, knots, scatter, noise)


def _sampled(fit: EdgeFit, departure: _Departure, knots: _Knots, scatter: Scatter, noise: Tensor) -> Spread:
    """Spread functions on an even grid."""
    span = max(float(knots.distance[-1]) + 3 * knots.step, _WIDTHS * float(fit.width))
    count = math.ceil(_SAMPLES * (span + 2.0))
    position = torch.arange(-count, count + 1, dtype=noise.dtype, device=noise.device) / _SAMPLES
    slope = fit.slope(scatter)
    esf, lsf, _ = edge_spread(position, fit.sigma, slope)
    values, slopes = knots.values(position)
    # derivative of both by log sigma
    change = 1e-3
    wider, narrower = (edge_spread(position, fit.sigma * math.exp(sign * change), slope) for sign in (1, -1))
    esf_by_blur, by_blur = ((a - b) / (2 * change) for a, b in zip(wider[:2], narrower[:2], strict=True))
    shrink = fit.contrast / (fit.contrast + departure.fixed[7] - departure.fixed[5])
    mean = departure.weights @ departure.coefficients
    blur, followed = departure.fixed[4], departure.projection[4]
    alternatives = lsf + shrink * (
        (blur - (departure.coefficients - mean) @ followed)[:, None] * by_blur
        + departure.coefficients[:, 2:] @ slopes.T
    )
    basis = torch.cat([slopes.new_zeros(len(slopes), 2), slopes], dim=1) - by_blur[:, None] * followed
    own = departure.fixed_root[4:5].expand(len(alternatives), 1, -1)
    (k, m), n = departure.roots.shape[1:], own.shape[-1]
    roots = own.new_zeros(len(own), k + 1, m + n)
    roots[:, :k, :m], roots[:, k:, m:] = departure.roots, own
    return Spread(
        fit,
        position,
        esf + shrink * (blur * esf_by_blur + values @ mean[2:]),
        lsf + shrink * (blur * by_blur + slopes @ mean[2:]),
        alternatives,
        departure.weights,
        shrink * torch.cat([basis, by_blur[:, None]], dim=1),
        roots,
        noise.square().mean().sqrt(),
    )
