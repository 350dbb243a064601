"""A smooth motion in time through measured displacements: penalised spline, smoothness chosen by the data."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.splines import bspline_weights, gauss_legendre
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.shapes.motion_spectrum import MOST_KNOTS, fit_with_spectrum

__all__ = ["SplineFit", "fit_spline", "precision_of_axis", "spline_basis"]

_CHUNK = 128  # scene rows taken together
_SMOOTHNESS = tuple(10.0**power for power in range(-8, 5))  # over the mean information
_FINER = (-2 / 3, -1 / 3, 1 / 3, 2 / 3)  # decades around the best
_ANCHOR = 1e-3  # of the information, on what no row tells: the mean over the record
_WORTH = 1e-12  # of the energy, the accuracy of its sums


@dataclass(frozen=True, eq=False)
class SplineFit:
    """Cubic spline ``sum_n c_n B((t - start) / spacing - n + 1)`` an axis.

    Attributes:
        coefficients: (2, N) float64 px.
        covariance: (2, N, N) float64 px^2 of each axis.
        start: Time of the first knot in seconds.
        spacing: Seconds between knots.
    """

    coefficients: Tensor
    covariance: Tensor
    start: float
    spacing: float

    @property
    def knots(self) -> Tensor:
        """(N,) s, times that the coefficients belong to."""
        count = self.coefficients.shape[-1]
        places = torch.arange(count, dtype=torch.float64, device=self.coefficients.device) - 1.0
        return self.start + places * self.spacing

    def columns(self, times: Tensor) -> Tensor:
        """Derivatives (S, N) of the motion at times (S,) by the coefficients."""
        count = self.coefficients.shape[-1]
        index, weights = spline_basis(times, self.start, self.spacing, count)
        return torch.zeros(len(times), count, dtype=torch.float64, device=times.device).scatter(-1, index, weights)


def spline_basis(times: Tensor, start: float, spacing: float, count: int) -> tuple[Tensor, Tensor]:
    """Index (S, 4) and weight (S, 4) of the coefficients of a cubic spline at times S."""
    place = ((times - start) / spacing).clamp(0.0, count - 3.0)
    cell = place.floor().clamp(max=count - 4.0)
    return cell.to(torch.int64)[..., None] + torch.arange(4, device=times.device), bspline_weights(place - cell, 3)


def fit_spline(
    measurements: Measurements, spacing: float, record: tuple[float, float], *, learn: bool = False
) -> SplineFit:
    """Fit a spline to the measurements of one stack, each axis by itself.

    Minimises ``sum w (d - relative(D))^2 + lambda |D''|^2``: rows tell only differences between the frames that see
    them, so that a warp of the scene is left to smoothness. lambda maximises the marginal likelihood.

    Args:
        measurements: Of one stack (B = 1).
        spacing: Seconds between knots.
        record: First and last time in seconds that the spline is wanted for.
        learn: Whether to learn the power spectrum of the motion, in place of one smoothness; splines of many knots
            keep to smoothness.
    """
    first, last = record
    count = math.ceil((last - first) / spacing) + 3
    device = measurements.moments.device
    shape = SplineFit(
        torch.zeros(2, count, dtype=torch.float64, device=device), torch.zeros(2, 0, 0, device=device), first, spacing
    )
    values, covariances = zip(*(_fit_axis(measurements, shape, axis, learn) for axis in range(2)), strict=True)
    return SplineFit(torch.stack(values), torch.stack(covariances), first, spacing)


def _design(measurements: Measurements, shape: SplineFit, axis: int, part: slice) -> Tensor:
    """Derivatives (n, G, N) of the relative displacements of some scene rows by the coefficients of an axis."""
    moments = measurements.moments[0, part]
    average = measurements.average_times[axis] + measurements.exposure_time
    nodes, weights = gauss_legendre(3 + math.ceil(2 * average / shape.spacing))
    first = moments + 0.5 * (measurements.exposure_time - average)
    columns = torch.zeros(*moments.shape, 1, dtype=torch.float64, device=moments.device)
    for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
        at = (first + average * node).flatten()
        columns = columns + weight * shape.columns(at).unflatten(0, moments.shape)
    seen = measurements.seen[0, part][..., None]
    mean = (seen * columns).sum(1, keepdim=True) / seen.sum(1, keepdim=True).clamp(min=1.0)
    return seen * (columns - mean)


def _fit_axis(measurements: Measurements, shape: SplineFit, axis: int, learn: bool) -> tuple[Tensor, Tensor]:
    """Coefficients (N,) of one axis and their covariance (N, N)."""
    values = (measurements.displacements[..., axis] * measurements.seen)[0]
    weight = precision_of_axis(measurements.information[0], axis)
    count = shape.coefficients.shape[-1]
    gram = torch.zeros(count, count, dtype=torch.float64, device=values.device)
    right = torch.zeros(count, dtype=torch.float64, device=values.device)
    for begin in range(0, len(values), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        design = _design(measurements, shape, axis, part)
        used = (design != 0).flatten(0, 1).any(0).nonzero()[:, 0]
        flat = design[..., used].flatten(0, 1)
        weighted = flat * weight[part, None].expand(-1, design.shape[1]).flatten()[:, None]
        gram[used[:, None], used] += flat.mT @ weighted
        right[used] += weighted.mT @ values[part].flatten()
    energy = (weight[:, None] * values.square()).sum()
    known = ((measurements.differences[0] * (weight > 0)).sum() * measurements.independent).clamp(min=1.0)
    scale = gram.diagonal().mean() + 1e-300
    second = torch.eye(count, dtype=torch.float64, device=values.device).diff(n=2, dim=0)
    bend = second.mT @ second
    base = gram + scale * _ANCHOR / count  # on every element: on the mean

    def evidence(smoothness: float) -> tuple[Tensor, Tensor, Tensor]:
        factor = torch.linalg.cholesky(base + smoothness * scale * bend)
        found = torch.cholesky_solve(right[:, None], factor)[:, 0]
        left = torch.maximum(energy - right @ found, _WORTH * energy + 1e-300)
        logarithm = 2 * factor.diagonal().log().sum() - (count - 2) * math.log(smoothness)
        return -0.5 * (known * (left / known).log() + logarithm), found, factor

    def best_of(tried: tuple[float, ...]) -> float:
        place = int(torch.stack([evidence(smoothness)[0] for smoothness in tried]).argmax())
        return tried[place]

    best = best_of(_SMOOTHNESS)
    smoothness = best_of((best, *(best * 10**step for step in _FINER)))
    _, found, factor = evidence(smoothness)
    noise = float(torch.maximum(energy - right @ found, _WORTH * energy) / known)
    if learn and count <= MOST_KNOTS and noise > 0:
        return fit_with_spectrum(gram, right, noise, smoothness * float(scale))
    return found, noise * torch.cholesky_inverse(factor)


def precision_of_axis(information: Tensor, axis: int) -> Tensor:
    """(N,) inverse variance of one axis from information (N, 2, 2), the other axis being unknown too."""
    other = information[:, 1 - axis, 1 - axis]
    own = information[:, axis, axis]
    cross = information[:, 0, 1].square() / torch.where(other > 0, other, 1.0)
    return torch.where(other > 0, own - cross, own).clamp(min=0.0)
