"""Edge spread function of any shape: Gaussian optics and square pixels plus a random departure.

The departure from the Gaussian model is a smooth random function of the distance from the edge: a cubic B-spline with
Gaussian-process priors, and a tail beyond the ROI, as light scattered that far reduces the contrast within the ROI. Its
strength, smoothness and reach are averaged over priors weighted by their restricted likelihood, so that it shrinks to
zero where the pixels agree with the Gaussian model.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.evaluation.mtf.edge import EdgeFit, Scatter, edge_spread, linearised, moved
from rsvib_torch.numerics.interpolation import bspline_weights

_EDGE = 11  # parameters of ``EdgeFit``; all coefficients of the departure follow them
_BLUR, _DARK, _BRIGHT = 4, 5, 8  # log blur, and values of the sides in the middle of the ROI, among them
_SLOPES = [6, 9]  # slopes of the two sides across the edge, which have a prior
_SHADINGS = (1e-12, 0.1)  # standard deviations of these slopes over the contrast, per half ROI: none, or some
_STRENGTHS = (0.0, *(10.0 ** (0.5 * k) for k in range(-10, 0)))  # of the departure over the contrast


# --- Departure from the Gaussian model and its priors ---


@dataclass(frozen=True)
class Tail:
    """Part of an edge spread function that decays as slowly as diffraction: ``-x w / (x^2 + w^2)``.

    Its Fourier transform has a closed form, so that it need not be sampled to infinity.
    """

    width: float  # w in px

    def esf(self, distance: Tensor) -> Tensor:
        """Value at distances in px from the edge."""
        return -distance * self.width / (distance.square() + self.width**2)

    def lsf(self, distance: Tensor) -> Tensor:
        """Derivative of the value, per px."""
        squared, width = distance.square(), self.width
        return (squared - width**2) * width / (squared + width**2).square()

    def transfer(self, position: Tensor, lsf: Tensor, far: Tensor, frequency: Tensor) -> Tensor:
        """Complex transfer (..., F) of line spread functions (..., N) at evenly spaced positions, 1 at frequency 0.

        The functions contain the tail times ``far`` (...); positions are in px, frequencies (F,) in cycles/px.
        """
        angle = -2 * math.pi * frequency[:, None] * position
        ramps = torch.polar(torch.ones_like(angle), angle)
        sampled, step = self.lsf(position), position[1] - position[0]
        whole = -2 * (math.pi * self.width) * math.pi * frequency * torch.exp(-2 * math.pi * self.width * frequency)
        missing = whole / step - ramps @ sampled.to(ramps.dtype)
        total = lsf.sum(-1) - far * sampled.sum()
        return (lsf.to(ramps.dtype) @ ramps.mT + far[..., None] * missing) / total[..., None]


@dataclass(frozen=True)
class Knots:
    """Tail and cubic B-splines, evenly spaced in ``u = stretch asinh(distance / stretch)``."""

    place: Tensor  # (K,) values of u
    step: float  # between them
    stretch: float  # px
    tail: Tail  # departure beyond them

    @property
    def distance(self) -> Tensor:
        """(K,) px from the edge."""
        return self.stretch * torch.sinh(self.place / self.stretch)

    def taps(self, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The four splines that are not zero at each distance (N,): indices, values and derivatives per px, (N, 4)."""
        position = (self.stretch * torch.asinh(distance / self.stretch) - self.place[0]) / self.step
        cell = position.floor()
        index = cell.long()[:, None] + torch.arange(-1, 3, device=distance.device)
        value, slope = (bspline_weights(position - cell, 3, derivative) for derivative in (0, 1))
        density = torch.rsqrt(1 + (distance / self.stretch).square()) / self.step
        inside = (index >= 0) & (index < len(self.place))
        return index.clamp(0, len(self.place) - 1), value * inside, slope * inside * density[:, None]

    def matrices(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Values and derivatives per px of the tail and of all splines, (N, 1 + K)."""
        index, *taps = self.taps(distance)
        empty = distance.new_zeros(len(distance), len(self.place))
        value, slope = (
            torch.cat([beyond[:, None], empty.scatter_add(1, index, tap)], dim=1)
            for tap, beyond in zip(taps, (self.tail.esf(distance), self.tail.lsf(distance)), strict=True)
        )
        return value, slope


def lay_knots(room: float, width: float, like: Tensor) -> Knots:
    """Knots for an edge with ``room`` px on either side and a line spread function of standard deviation ``width``."""
    stretch = 10.0 * max(1.0, width)
    reach = stretch * math.asinh(room / stretch)
    step = max(0.25, 2 * reach / 220)  # px at the edge; at most 220 knots
    half = max(int(reach / step) - 2, 2)  # splines within the ROI
    place = step * torch.arange(-half, half + 1, dtype=like.dtype, device=like.device)
    return Knots(place, step, stretch, Tail(2.0 * max(1.0, width)))


def prior_roots(knots: Knots, width: float) -> Tensor:
    """Square roots (P, 1 + K, 1 + K) of prior covariances of tail and splines, at strength 1 in the middle.

    Lengths are in px for a line spread function of a standard deviation ``width`` of up to 1 px.
    """
    smoothness = (0.4, 0.8, 1.8)  # correlation lengths of the departures
    decay = (1.0, 2.5, 6.0)  # over which departures decay quadratically; one more prior decays linearly, as the tail
    scale = max(1.0, width)
    distance = knots.distance.abs()
    apart = (knots.place[:, None] - knots.place).square()
    smooth = torch.stack([torch.exp(-0.5 * apart / (scale * length) ** 2) for length in smoothness])
    shapes = [*((scale * reach, 2) for reach in decay), (knots.tail.width, 1)]
    fade = torch.stack([(1 + (distance / reach).square()) ** (-0.5 * power) for reach, power in shapes])
    prior = smooth[:, None] * fade[:, :, None] * fade[:, None, :]
    prior.diagonal(dim1=-2, dim2=-1).add_(1e-9)
    prior = torch.nn.functional.pad(prior, (1, 0, 1, 0))
    prior[..., 0, 0] = 1e-12
    prior[:, -1, 0, 0] = 1.0  # only the slowest decay has a tail beyond the ROI
    return torch.linalg.cholesky(prior.flatten(0, 1))


# --- Posterior ---


def normal_equations(dense: Tensor, index: Tensor, taps: Tensor, count: int, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations of ``residual = dense @ first + sum of taps of ``count`` coefficients``: matrix, right side."""
    columns = dense.shape[1]
    matrix = dense.new_zeros(columns + count, columns + count)
    matrix[:columns, :columns] = dense.T @ dense
    products = (taps[:, :, None] * taps[:, None, :]).flatten()
    places = (index[:, :, None] * count + index[:, None, :]).flatten()
    matrix[columns:, columns:] = dense.new_zeros(count * count).index_add_(0, places, products).view(count, count)
    mixed, right = dense.new_zeros(count, columns), dense.new_zeros(count)
    for tap in range(taps.shape[1]):
        mixed.index_add_(0, index[:, tap], dense * taps[:, tap, None])
        right.index_add_(0, index[:, tap], residual * taps[:, tap])
    matrix[columns:, :columns], matrix[:columns, columns:] = mixed, mixed.T
    return matrix, torch.cat([dense.T @ residual, right])


@dataclass(frozen=True)
class Posterior:
    """Parameters of edge and sides, tail and splines for every prior of at least 0.1 % of the best weight."""

    weights: Tensor  # (A,) of the priors
    parameters: Tensor  # (A, 11 + 1 + K) under each of them
    roots: Tensor  # (A, 11 + 1 + K, S) square roots of their covariances
    used: Tensor  # (P,) priors of the departure with weight

    @property
    def mean(self) -> Tensor:
        """Parameters (11 + 1 + K) over all priors."""
        return self.weights @ self.parameters


def posterior(matrix: Tensor, right: Tensor, roots: Tensor, contrast: Tensor) -> Posterior:
    """Average over priors, each weighted by its restricted likelihood, for noise of variance 1.

    ``matrix`` and ``right`` are the normal equations of all parameters, ``roots`` (P, 1 + K, 1 + K) square roots of the
    prior covariances of the departure at strength 1.
    """
    edge, rest = slice(None, _EDGE), slice(_EDGE, None)
    strength = matrix.new_tensor(_STRENGTHS).square()[:, None]
    shading = matrix.new_tensor(_SHADINGS) * contrast
    # elimination of edge and sides, with the priors of the slopes in the first dimension
    precision = matrix[edge, edge].repeat(len(shading), 1, 1)
    precision[:, _SLOPES, _SLOPES] += shading[:, None] ** -2
    size = precision.diagonal(dim1=1, dim2=2).sqrt()
    size = size.clamp(min=1e-12 * float(matrix.diagonal()[edge].max()) ** 0.5)[..., None]
    precision = precision / size / size.mT
    precision.diagonal(dim1=1, dim2=2).add_(1e-13)
    free = (
        torch.linalg.inv(torch.linalg.cholesky(precision)).mT / size
    )  # root of the covariance of edge and sides alone
    follow = -free @ (free.mT @ matrix[edge, rest])
    start = free @ (free.mT @ right[edge, None])
    gram = matrix[rest, rest] + matrix[rest, edge] @ follow
    evidence = 0.5 * (right[edge] @ start)[:, 0] + free.diagonal(dim1=1, dim2=2).log().sum(1) - 2 * shading.log()
    # modes of tail and splines, which all strengths have in common
    values, vectors = torch.linalg.eigh(roots.mT @ gram[:, None] @ roots)
    values, modes = values.clamp(min=0.0)[:, :, None], roots @ vectors
    projected = (modes.mT @ (right[rest, None] - matrix[rest, edge] @ start)[:, None]).mT
    shrunk = strength / (1 + strength * values)  # variances (shadings, P, strengths, 1 + K) of the modes
    gain = 0.5 * (shrunk * projected.square() - torch.log1p(strength * values)).sum(-1)
    weight = gain + evidence[:, None, None]
    weight = torch.exp(weight - weight.max())
    kept = weight > 1e-3
    of, prior, _ = kept.nonzero().T
    root = modes[of, prior] * shrunk[kept].sqrt()[:, None]
    departure = modes[of, prior] @ (shrunk * projected)[kept][..., None]
    parameters = torch.cat([start[of] + follow[of] @ departure, departure], dim=1)[..., 0]
    of_edge = torch.cat([follow[of] @ root, free[of]], dim=-1)
    roots_of_all = torch.cat([of_edge, torch.nn.functional.pad(root, (0, _EDGE))], dim=-2)
    return Posterior(weight[kept] / weight[kept].sum(), parameters, roots_of_all, kept.any(0).any(-1))


# --- Fit and result ---


@dataclass(frozen=True)
class Spread:
    """Edge and line spread function with their uncertainty."""

    fit: EdgeFit  # edge, Gaussian blur and sides without the departure
    position: Tensor  # (N,) px
    esf: Tensor  # (N,) edge spread function
    lsf: Tensor  # (N,) its derivative
    tail: Tail  # shape of the tail beyond ``position``
    far: Tensor  # () amplitude of the tail in ``esf`` and ``lsf``
    alternatives: Tensor  # (A, N) line spread functions by prior
    alternative_far: Tensor  # (A,) amplitude of the tail in each
    weights: Tensor  # (A,) of the alternatives
    basis: Tensor  # (N, R) derivatives of the line spread function by blur, tail and splines
    roots: Tensor  # (A, R, S) square roots of the covariance of these parameters, by prior
    noise: Tensor  # () standard deviation of the noise of a pixel

    def mtf(self, frequency: Tensor) -> Tensor:
        """MTF at frequencies (F,)."""
        return self.tail.transfer(self.position, self.lsf, self.far, frequency).abs()

    def std(self, frequency: Tensor) -> Tensor:
        """Standard deviation of the MTF at frequencies (F,)."""
        mean = self.tail.transfer(self.position, self.lsf, self.far, frequency)
        mtf, phase = mean.abs(), mean.angle()
        ramps = torch.cos(2 * math.pi * frequency[:, None] * self.position + phase[:, None]) / self.lsf.sum()
        within = (ramps @ self.basis @ self.roots).square().sum(-1)
        others = self.tail.transfer(self.position, self.alternatives, self.alternative_far, frequency)
        between = (others.abs() - mtf).square()
        return (self.weights @ (within + between)).sqrt()


def _quantisation(values: Tensor) -> float:
    """Standard deviation of rounding to steps; 0 for values that are not on steps.

    Without it, the error of MTF50 of noise-free 8-bit edges is up to 20 standard deviations.
    """
    levels = values.unique()
    if len(levels) > len(values) // 4:
        return 0.0
    return float(levels.diff().min()) / math.sqrt(12)


def fit_spread(fit: EdgeFit, scatter: Scatter, room: float) -> Spread:
    """Fit the edge spread function without assuming a shape.

    ``room`` is the distance in px from the edge to the nearer of the ROI's borders alongside it.
    """
    knots = lay_knots(room, float(fit.width), scatter.x)
    roots = prior_roots(knots, float(fit.width))
    result: Posterior | None = None
    noise = torch.ones_like(scatter.value)
    for count in range(3):
        model, jacobian, distance = linearised(fit, scatter)
        sides = fit.planes(scatter)[0]
        contrast = sides[:, 1] - sides[:, 0]
        index, values, slopes = knots.taps(distance)
        if result is not None:
            tail, splines = result.mean[_EDGE], result.mean[_EDGE + 1 :]
            steeper = (slopes * splines[index]).sum(1) + knots.tail.lsf(distance) * tail
            jacobian[:, :4] += (contrast * steeper)[:, None] * fit.distance(scatter)[1]
        beyond = contrast * knots.tail.esf(distance)
        dense = torch.cat([jacobian, beyond[:, None]], dim=1)
        taps = contrast[:, None] * values
        # the prior of the slopes is centred on 0, not on their last estimate
        residual = scatter.value - model + jacobian[:, _SLOPES] @ fit.sides[:, 1]
        if count == 0:
            # all parameters free, with slight damping
            matrix, right = normal_equations(dense, index, taps, len(knots.place), residual)
            size = matrix.diagonal().sqrt().clamp(min=1e-12 * float(matrix.diagonal().max()) ** 0.5)
            scaled = matrix / size / size[:, None]
            scaled.diagonal().add_(1e-9)
            plain = torch.linalg.solve(scaled, right / size) / size
            front, splines = plain.split([dense.shape[1], len(knots.place)])
            unexplained = residual - dense @ front - (taps * splines[index]).sum(1)
            bright = ((model - sides[:, 0]) / contrast).clamp(0.0, 1.0)
            floor = max(1e-6 * float(fit.contrast), _quantisation(scatter.value))
            noise = _noise(unexplained, bright, len(plain), floor)
        weighted = (dense / noise[:, None], index, taps / noise[:, None], len(knots.place), residual / noise)
        result = posterior(*normal_equations(*weighted), roots, fit.contrast)
        roots = roots[result.used]
        step = result.mean[:_EDGE]
        step[_SLOPES] -= fit.sides[:, 1]
        before, fit = fit, moved(fit, step)
        if not float(fit.contrast) > 0:  # that of an edge that a vibration has torn apart, for example
            raise ValueError("the pixels do not follow one edge between a dark and a bright side; choose another roi")
    assert result is not None
    return _sampled(before, result, knots, scatter, noise)


def _noise(residual: Tensor, bright: Tensor, parameters: int, floor: float) -> Tensor:
    """Standard deviation of the noise of every pixel: a variance linear in the grey value (shot noise)."""
    freedom = len(residual) / max(len(residual) - parameters, 0.3 * len(residual))
    share = torch.stack([1 - bright, bright])
    variances = freedom * (share @ residual.square()) / share.sum(1)
    return (variances @ share).clamp(min=floor**2).sqrt()


def _sampled(fit: EdgeFit, found: Posterior, knots: Knots, scatter: Scatter, noise: Tensor) -> Spread:
    """Spread functions on an even grid."""
    span = max(float(knots.distance[-1]) + 3 * knots.step, 8.0 * float(fit.width))
    samples = 16  # per px
    count = math.ceil(samples * (span + 2.0))
    position = torch.arange(-count, count + 1, dtype=noise.dtype, device=noise.device) / samples
    slope = fit.slope(scatter)
    esf, lsf, _ = edge_spread(position, fit.sigma, slope)
    # derivative of both by log sigma
    change = 1e-3
    wider, narrower = (edge_spread(position, fit.sigma * math.exp(sign * change), slope) for sign in (1, -1))
    by_blur = [(a - b)[:, None] / (2 * change) for a, b in zip(wider[:2], narrower[:2], strict=True)]
    esf_basis, lsf_basis = (torch.cat(both, dim=1) for both in zip(by_blur, knots.matrices(position), strict=True))
    mean = found.mean
    shrink = fit.contrast / (fit.contrast + mean[_BRIGHT] - mean[_DARK])
    used = [_BLUR, *range(_EDGE, len(mean))]  # parameters that change the shape
    basis, alternatives = shrink * lsf_basis, found.parameters[:, used]
    return Spread(
        fit,
        position,
        esf + shrink * (esf_basis @ mean[used]),
        lsf + basis @ mean[used],
        knots.tail,
        shrink * mean[_EDGE],
        lsf + alternatives @ basis.T,
        shrink * found.parameters[:, _EDGE],
        found.weights,
        basis,
        found.roots[:, used],
        noise.square().mean().sqrt(),
    )
