"""Nodes and weights of numerical integrals, worked out once."""

from functools import cache

import numpy as np
import torch
from torch import Tensor

__all__ = ["gauss_legendre"]


@cache
def gauss_legendre(count: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes (N,) within 0 ... 1, and weights that sum to 1, float64; not to be changed in place.

    Example:
        >>> nodes, weights = gauss_legendre(2)
        >>> round(float((weights * nodes**3).sum()), 12)
        0.25
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    with torch.inference_mode(False):  # whoever comes first, others may differentiate
        return torch.from_numpy((nodes + 1) / 2), torch.from_numpy(weights / 2)
