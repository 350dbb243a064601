"""A straight edge as square pixels see it through Gaussian optics, in closed form."""

import math

import torch
from torch import Tensor

__all__ = ["edge_spread"]


def edge_spread(distance: Tensor, sigma: Tensor, slope: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Edge spread function of Gaussian optics and square pixels, with its derivatives.

    The pixel, projected on the normal of the edge, is the convolution of two boxes, as wide as the cosine and the
    sine of the edge's angle. Their convolution with the error function of the optics is a second difference of its
    second integral, ``J(x) = ((x^2 + sigma^2) Phi(x / sigma) + sigma x phi(x / sigma)) / 2``.

    Args:
        distance: px from the edge along its normal, positive on the bright side.
        sigma: () blur of the optics in px.
        slope: () tangent of the angle between edge and pixel.

    Returns:
        The edge spread function, the line spread function, and the derivative by sigma of the first.
    """
    cosine = torch.rsqrt(1 + slope.square())
    wide, narrow = 0.5 * cosine, 0.5 * cosine * slope.abs()
    # of the dark side only: on the bright side the numbers grow and their differences lose their digits
    outside = -distance.abs()
    value, first, second = (torch.zeros_like(distance) for _ in range(3))
    for shift, sign in ((wide + narrow, 1), (wide - narrow, -1), (narrow - wide, -1), (-wide - narrow, 1)):
        x = outside + shift
        density = torch.exp(-0.5 * (x / sigma).square()) / math.sqrt(2 * math.pi)
        below = 0.5 * torch.special.erfc(x / (-math.sqrt(2.0) * sigma))
        value += sign * 0.5 * ((x.square() + sigma.square()) * below + sigma * x * density)
        first += sign * (x * below + sigma * density)
        second += sign * below
    scale = 1 / (4 * wide * narrow)
    value, first, second = scale * value, scale * first, scale * sigma * second
    bright = distance > 0
    return torch.where(bright, 1 - value, value), first, torch.where(bright, -second, second)
