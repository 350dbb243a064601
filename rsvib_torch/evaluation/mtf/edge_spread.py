"""Edge spread function of any shape: Gaussian optics and square pixels, plus what the pixels say beyond that.

The departure from the Gaussian model is a smooth random function of the distance from the edge (a cubic B-spline with
a Gaussian-process prior, and a tail beyond the ROI) whose strength, smoothness and reach are weighted by how well each
explains the pixels (restricted likelihood). Where the pixels agree with the model, it shrinks to nothing and costs no
noise; where they do not, it follows them.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.evaluation.mtf.edge_geometry import EdgeFit, Scatter, linearised, moved
from rsvib_torch.evaluation.mtf.edge_model import edge_spread
from rsvib_torch.evaluation.mtf.knots import Knots, lay_knots, prior_roots
from rsvib_torch.evaluation.mtf.mtf_curve import Tail
from rsvib_torch.evaluation.mtf.posterior import SLOPES, Equations, Posterior, posterior

__all__ = ["Spread", "fit_spread"]

_FLOOR = 1e-6  # of the contrast: noise below this is rounding
_ROUNDS = 3  # of relinearising
_WIDTHS = 8.0  # standard deviations of the line spread function that the result spans
_SAMPLES = 16  # per px of the result
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
        tail: Shape of what lies beyond ``position``.
        far: () how much of the tail there is in ``esf`` and ``lsf``.
        alternatives: (A, N) line spread functions by prior.
        alternative_far: (A,) how much of the tail there is in each.
        weights: (A,) of the alternatives.
        basis: (N, R) derivatives of the line spread function by what is uncertain.
        roots: (A, R, S) square roots of the covariance of what is uncertain, by prior.
        noise: () standard deviation of the noise of a pixel.
    """

    fit: EdgeFit
    position: Tensor
    esf: Tensor
    lsf: Tensor
    tail: Tail
    far: Tensor
    alternatives: Tensor
    alternative_far: Tensor
    weights: Tensor
    basis: Tensor
    roots: Tensor
    noise: Tensor

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
    knots = lay_knots(room, float(fit.width), scatter.x)
    roots = prior_roots(knots, float(fit.width))
    found: Posterior | None = None
    noise = torch.ones_like(scatter.value)
    for count in range(_ROUNDS):
        model, jacobian, distance = linearised(fit, scatter)
        sides = fit.planes(scatter)[0]
        contrast = sides[:, 1] - sides[:, 0]
        index, values, slopes = knots.taps(distance)
        if found is not None:
            steeper = (slopes * found.mean[SLOPES:][index]).sum(1) + knots.tail.lsf(distance) * found.mean[-1]
            jacobian[:, :4] += (contrast * steeper)[:, None] * fit.distance(scatter)[1]
        beyond = contrast * knots.tail.esf(distance)
        dense = torch.cat([jacobian[:, _FIXED + _RANDOM], beyond[:, None]], dim=1)
        taps = contrast[:, None] * values
        # slopes have a prior around zero: all of them is to be explained
        residual = scatter.value - model + jacobian[:, _RANDOM] @ fit.sides[:, 1]
        if count == 0:
            plain = Equations.of(dense, index, taps, len(knots.place), residual).solution()
            front = dense.shape[1] - 1
            left = residual - dense @ torch.cat([plain[:front], plain[-1:]]) - (taps * plain[front:][index]).sum(1)
            bright = ((model - sides[:, 0]) / contrast).clamp(0.0, 1.0)
            floor = max(_FLOOR * float(fit.contrast), _quantisation(scatter.value))
            noise = _noise(left, bright, len(plain), floor)
        equations = Equations.of(
            dense / noise[:, None], index, taps / noise[:, None], len(knots.place), residual / noise
        )
        found = posterior(equations, roots, fit.contrast)
        roots = roots[found.used]
        step = torch.zeros_like(jacobian[0])
        step[_FIXED] = found.fixed
        step[_RANDOM] = found.mean[:SLOPES] - fit.sides[:, 1]
        before, fit = fit, moved(fit, step)
    assert found is not None
    return _sampled(before, found, knots, scatter, noise)


def _noise(left: Tensor, bright: Tensor, parameters: int, floor: float) -> Tensor:
    """Standard deviation of the noise of every pixel: a variance linear in the grey value (shot noise)."""
    freedom = len(left) / max(len(left) - parameters, 0.3 * len(left))
    share = torch.stack([1 - bright, bright])
    variances = freedom * (share @ left.square()) / share.sum(1)
    noise: Tensor = (variances @ share).clamp(min=floor**2).sqrt()
    return noise


def _sampled(fit: EdgeFit, found: Posterior, knots: Knots, scatter: Scatter, noise: Tensor) -> Spread:
    """Spread functions on an even grid."""
    span = max(float(knots.distance[-1]) + 3 * knots.step, _WIDTHS * float(fit.width))
    count = math.ceil(_SAMPLES * (span + 2.0))
    position = torch.arange(-count, count + 1, dtype=noise.dtype, device=noise.device) / _SAMPLES
    slope = fit.slope(scatter)
    esf, lsf, _ = edge_spread(position, fit.sigma, slope)
    values, slopes = knots.matrices(position)
    # derivative of both by log sigma
    change = 1e-3
    wider, narrower = (edge_spread(position, fit.sigma * math.exp(sign * change), slope) for sign in (1, -1))
    esf_by_blur, by_blur = ((a - b) / (2 * change) for a, b in zip(wider[:2], narrower[:2], strict=True))
    shrink = fit.contrast / (fit.contrast + found.fixed[7] - found.fixed[5])
    mean = found.mean
    blur, followed = found.fixed[4], found.projection[4]
    alternatives = lsf + shrink * (
        (blur - (found.coefficients - mean) @ followed)[:, None] * by_blur + found.coefficients[:, SLOPES:] @ slopes.T
    )
    basis = torch.cat([slopes.new_zeros(len(slopes), SLOPES), slopes], dim=1) - by_blur[:, None] * followed
    own = found.fixed_root[4:5].expand(len(alternatives), 1, -1)
    (k, m), n = found.roots.shape[1:], own.shape[-1]
    roots = own.new_zeros(len(own), k + 1, m + n)
    roots[:, :k, :m], roots[:, k:, m:] = found.roots, own
    return Spread(
        fit,
        position,
        esf + shrink * (blur * esf_by_blur + values @ mean[SLOPES:]),
        lsf + shrink * (blur * by_blur + slopes @ mean[SLOPES:]),
        knots.tail,
        shrink * mean[-1],
        alternatives,
        shrink * found.coefficients[:, -1],
        found.weights,
        shrink * torch.cat([basis, by_blur[:, None]], dim=1),
        roots,
        noise.square().mean().sqrt(),
    )
