"""Random-effects fit: some parameters are free, others follow priors whose strength the data decide."""

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Equations", "Posterior", "posterior"]

SLOPES = 2  # coefficients in front of the spline's: slopes of the two sides across the edge
_STRENGTH = (0.0, *(10.0 ** (0.5 * k) for k in range(-10, 0)))  # of the departures, parts of the contrast
_SHADING = (0.0, 0.1)  # slope of the sides across the edge, parts of the contrast per half ROI
_NEGLIGIBLE = 1e-3  # weight of a prior beside the best one


@dataclass(frozen=True)
class Equations:
    """Normal equations of weighted least squares: free parameters, slopes, then the K coefficients of the departure.

    Attributes:
        matrix: (F + 2 + K, F + 2 + K).
        right: (F + 2 + K,).
        free: F.
    """

    matrix: Tensor
    right: Tensor
    free: int

    @classmethod
    def of(cls, dense: Tensor, index: Tensor, taps: Tensor, count: int, residual: Tensor) -> "Equations":
        """Equations of ``residual = dense @ first + sum of taps of ``count`` coefficients + dense[:, -1] last``."""
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
        order = [*range(columns - 1), *range(columns, columns + count), columns - 1]
        right = torch.cat([dense.T @ residual, right])[order]
        return cls(matrix[order][:, order], right, columns - 1 - SLOPES)

    def solution(self) -> Tensor:
        """Least-squares solution, all parameters free but for a trace of damping."""
        size = self.matrix.diagonal().sqrt().clamp(min=1e-12 * float(self.matrix.diagonal().max()) ** 0.5)
        scaled = self.matrix / size / size[:, None]
        scaled.diagonal().add_(1e-9)
        solution: Tensor = torch.linalg.solve(scaled, self.right / size) / size
        return solution


@dataclass(frozen=True)
class Posterior:
    """Free parameters, and slopes and coefficients under every prior worth a thought.

    Attributes:
        weights: (A,) of the priors.
        coefficients: (A, 2 + K) under each of them.
        roots: (A, 2 + K, 2 + K) square roots of their covariances.
        mean: (2 + K,) coefficients over all priors.
        fixed: (F,) free parameters at the mean coefficients.
        projection: (F, 2 + K) by which they fall when coefficients rise.
        fixed_root: (F, F) square root of their covariance at given coefficients.
        used: (P,) which of the spline's priors have any weight.
    """

    weights: Tensor
    coefficients: Tensor
    roots: Tensor
    mean: Tensor
    fixed: Tensor
    projection: Tensor
    fixed_root: Tensor
    used: Tensor


def posterior(equations: Equations, roots: Tensor, contrast: Tensor) -> Posterior:
    """Average over priors, each weighted by its restricted likelihood, for noise of variance 1.

    Args:
        equations: Of all parameters.
        roots: (P, K, K) square roots of the prior covariances of the departure's coefficients at strength 1.
        contrast: () of the edge.
    """
    free = equations.free
    size = equations.matrix.diagonal()[:free].sqrt()
    size = size.clamp(min=1e-12 * float(size.max()))
    normal = equations.matrix[:free, :free] / size / size[:, None]
    normal.diagonal().add_(1e-13)
    factor = torch.linalg.cholesky(normal)
    mixed = equations.matrix[:free, free:] / size[:, None]
    projection = torch.cholesky_solve(mixed, factor)
    start = torch.cholesky_solve((equations.right[:free] / size)[:, None], factor)[:, 0]
    gram = equations.matrix[free:, free:] - mixed.T @ projection
    right = equations.right[free:] - mixed.T @ start

    found = [_under_shading(gram, right, roots, shading * contrast) for shading in _SHADING]
    best = torch.stack([evidence.max() for evidence, *_ in found]).max()
    weights, coefficients, spreads = [], [], []
    used = torch.zeros(len(roots), dtype=torch.bool, device=roots.device)
    for evidence, modes, shrunk, mean, gain in found:
        weight = torch.exp(evidence - best)
        kept = weight > _NEGLIGIBLE
        which = kept.nonzero()[:, 0]
        used |= kept.any(1)
        weights.append(weight[kept])
        spline = (modes[which] @ mean[kept][..., None])[..., 0]
        follow = -gain @ gram[:SLOPES, SLOPES:]
        coefficients.append(torch.cat([gain @ right[:SLOPES] + spline @ follow.T, spline], dim=1))
        root = modes[which] * shrunk[kept].sqrt()[:, None]
        spread = root.new_zeros(len(root), *gram.shape)
        spread[:, :SLOPES, :SLOPES] = torch.linalg.cholesky_ex(gain)[0]
        spread[:, :SLOPES, SLOPES:], spread[:, SLOPES:, SLOPES:] = follow @ root, root
        spreads.append(spread)
    weight, coefficient = torch.cat(weights), torch.cat(coefficients)
    weight = weight / weight.sum()
    average = weight @ coefficient
    return Posterior(
        weight,
        coefficient,
        torch.cat(spreads),
        average,
        (start - projection @ average) / size,
        projection / size[:, None],
        torch.linalg.inv(factor).T / size[:, None],
        used,
    )


def _under_shading(
    gram: Tensor, right: Tensor, roots: Tensor, shading: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Log likelihood (P, S), modes (P, K, K), their variances and means (P, S, K), covariance of the slopes (2, 2)."""
    slopes, rest = slice(None, SLOPES), slice(SLOPES, None)
    # slopes first, at their own strength: what they explain is taken out of the spline's equations
    informed = gram[slopes, slopes] * shading**2 + torch.eye(SLOPES, dtype=gram.dtype, device=gram.device)
    gain = shading**2 * torch.linalg.inv(informed)
    gain = 0.5 * (gain + gain.T)
    spline_gram = gram[rest, rest] - gram[rest, slopes] @ gain @ gram[slopes, rest]
    spline_right = right[rest] - gram[rest, slopes] @ gain @ right[slopes]
    values, vectors = torch.linalg.eigh(roots.mT @ spline_gram @ roots)
    values = values.clamp(min=0.0)[:, None]
    modes = roots @ vectors
    seen = (modes.mT @ spline_right)[:, None]
    strength = gram.new_tensor(_STRENGTH).square()[:, None]
    shrunk = strength / (1 + strength * values)
    evidence = 0.5 * (shrunk * seen.square() - torch.log1p(strength * values)).sum(-1)
    evidence = evidence + 0.5 * (right[slopes] @ gain @ right[slopes] - torch.logdet(informed))
    return evidence, modes, shrunk, shrunk * seen, gain
