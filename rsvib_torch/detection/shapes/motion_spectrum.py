"""A motion whose power spectrum is learned from the measurements themselves.

Smoothness alone takes for granted how fast the power of a motion falls with frequency. A motion that also rings has
more power where it rings, and more may be hidden at frequencies near there that repeat in every frame. So the power
at each frequency is estimated from what is seen at the frequencies about it (expectation maximisation): what is not
seen is then as uncertain as the motion is large at frequencies beside it.
"""

import math

import torch
from torch import Tensor

__all__ = ["MOST_KNOTS", "fit_with_spectrum"]

MOST_KNOTS = 800  # whose spectrum is learned: the cost grows with the cube of their number
_ROUNDS = 20
_NEIGHBOURS = 2.0  # standard deviation of the window over frequencies, in half cycles in the record
_BEYOND = 10  # knots, at least, by which cosines reach beyond the record: their ends are level
_ANCHOR = 1e-9  # of the mean information, on all: the mean over the record is not known


def fit_with_spectrum(gram: Tensor, right: Tensor, noise: float, smoothness: float) -> tuple[Tensor, Tensor]:
    """Coefficients (N,) of a spline and their covariance (N, N), the power of each frequency being estimated.

    The coefficients are a straight line and cosines that reach beyond the record, ``c = sum_j a_j cos(w_j (n + 1/2))``
    with ``a_j`` of variance ``s_j``. In turn the a are found for given s, and s_j is set to the mean of
    ``a_j^2 + var(a_j)`` over the frequencies about j, relative to what the smoothness expects.

    Args:
        gram: (N, N) normal matrix of the coefficients.
        right: (N,) right-hand side.
        noise: Variance of measurements of unit weight.
        smoothness: Weight of the squares of second differences in the sum of squares, to start with.

    Returns:
        Coefficients and covariance.
    """
    count = len(right)
    beyond = max(_BEYOND, count // 16)
    length = count + 2 * beyond
    order = torch.arange(length, dtype=torch.float64, device=right.device)
    place = torch.arange(count, dtype=torch.float64, device=right.device)
    angle = math.pi / length * order
    waves = torch.cos(angle * (place[:, None] + beyond + 0.5)) * math.sqrt(2 / length)
    line = place - place.mean()
    columns = torch.cat([waves, (line / line.norm())[:, None]], 1)
    matrix = columns.mT @ gram @ columns / noise
    target = columns.mT @ right / noise
    expected = noise / smoothness * (2 * torch.sin(0.5 * angle[1:])) ** -4
    window = torch.exp(-0.5 * ((order[1:, None] - order[1:]) / _NEIGHBOURS) ** 2)
    window = window / window.sum(1, keepdim=True)
    anchor = (_ANCHOR * matrix.diagonal().mean()).expand(1)
    power = expected
    amplitude, spread = torch.zeros_like(target), matrix
    for _ in range(_ROUNDS):
        whole = matrix + torch.diag(torch.cat([anchor, anchor + 1 / power, anchor]))
        spread = torch.cholesky_inverse(torch.linalg.cholesky(whole))
        amplitude = spread @ target
        found = amplitude[1:-1].square() + spread.diagonal()[1:-1]
        power = (window @ (found / expected)) * expected
    return columns @ amplitude, columns @ spread @ columns.mT
