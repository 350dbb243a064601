"""Smooth departures from a model of the edge: a cubic B-spline along the normal with Gaussian-process priors.

Where they fade slowly, a tail goes on beyond the ROI: light scattered so far lowers the contrast that the ROI shows.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.evaluation.mtf.mtf_curve import Tail

__all__ = ["Knots", "lay_knots", "prior_roots"]

_KNOT = 0.25  # px between knots of the spline at the edge
_STRETCH = 10.0  # px from the edge, where they are 1.4 times as far apart, and ever farther beyond
_MOST_KNOTS = 220
_CLEAR = 2  # knots that stay clear of the ROI's borders
_SMOOTHNESS = (0.4, 0.8, 1.8)  # px, correlation lengths of the departures
_DECAY = ((1.0, 2), (2.5, 2), (6.0, 2), (2.0, 1))  # px from the edge and power with which they fade
_ABSENT = 1e-12  # variance of the tail where departures fade faster


@dataclass(frozen=True)
class Knots:
    """Cubic B-splines, evenly spaced in ``u = stretch asinh(distance / stretch)``.

    Attributes:
        place: (K,) values of u.
        step: Between them.
        stretch: px.
        tail: What goes on beyond them.
    """

    place: Tensor
    step: float
    stretch: float
    tail: Tail

    @property
    def distance(self) -> Tensor:
        """(K,) px from the edge."""
        return self.stretch * torch.sinh(self.place / self.stretch)

    def taps(self, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The four splines that reach each distance (N,): indices, values and derivatives per px, (N, 4)."""
        position = (self.stretch * torch.asinh(distance / self.stretch) - self.place[0]) / self.step
        cell = position.floor()
        t = (position - cell)[:, None]
        index = cell.long()[:, None] + torch.arange(-1, 3, device=distance.device)
        s = 1 - t
        value = torch.cat([s**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * s**2 + 3 * s**3, t**3], dim=1) / 6
        slope = torch.cat([-(s**2), (3 * t - 4) * t, (4 - 3 * s) * s, t**2], dim=1) / 2
        squeeze = torch.rsqrt(1 + (distance / self.stretch).square()) / self.step
        inside = (index >= 0) & (index < len(self.place))
        return index.clamp(0, len(self.place) - 1), value * inside, slope * inside * squeeze[:, None]

    def matrices(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Values and derivatives per px of all splines and of the tail, (N, K + 1)."""
        index, *taps = self.taps(distance)
        empty = distance.new_zeros(len(distance), len(self.place))
        value, slope = (
            torch.cat([empty.scatter_add(1, index, tap), beyond[:, None]], dim=1)
            for tap, beyond in zip(taps, (self.tail.esf(distance), self.tail.lsf(distance)), strict=True)
        )
        return value, slope


def lay_knots(room: float, width: float, like: Tensor) -> Knots:
    """Knots for an edge with ``room`` px on either side and a line spread function of standard deviation ``width``."""
    stretch = _STRETCH * max(1.0, width)
    reach = stretch * math.asinh(room / stretch)
    step = max(_KNOT, 2 * reach / _MOST_KNOTS)
    half = max(int(reach / step) - _CLEAR, 2)
    place = step * torch.arange(-half, half + 1, dtype=like.dtype, device=like.device)
    return Knots(place, step, stretch, Tail(_DECAY[-1][0] * max(1.0, width)))


def prior_roots(knots: Knots, width: float) -> Tensor:
    """Square roots (P, K + 1, K + 1) of prior covariances of splines and tail, at strength 1 in the middle."""
    scale = max(1.0, width)
    distance = knots.distance.abs()
    apart = (knots.place[:, None] - knots.place).square()
    smooth = torch.stack([torch.exp(-0.5 * apart / (scale * length) ** 2) for length in _SMOOTHNESS])
    fade = torch.stack([(1 + (distance / (scale * reach)).square()) ** (-0.5 * power) for reach, power in _DECAY])
    prior = (smooth[:, None] * fade[:, :, None] * fade[:, None, :]).flatten(0, 1)
    prior.diagonal(dim1=-2, dim2=-1).add_(1e-9)
    prior = torch.nn.functional.pad(prior, (0, 1, 0, 1))
    slow = [1.0 if power == 1 else _ABSENT for _ in _SMOOTHNESS for _, power in _DECAY]
    prior[:, -1, -1] = prior.new_tensor(slow)
    roots: Tensor = torch.linalg.cholesky(prior)
    return roots
