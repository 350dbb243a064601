"""Batched solver for Hermitian positive definite banded systems ``A x = g``.

Elimination of one row after the other factors ``A = U^H D U`` with a unit upper triangular U: for j = 0, 1, ...

    d_j = A[j, j],   U[j, k] = A[j, k] / d_j,   A[i, k] -= A[i, j] U[j, k]   for i, k = j + 1 ... j + b.

Forward substitution solves ``U^H D y = g``, back substitution ``U x = y``. Every step is one operation for the whole
batch of matrices.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["BandedFactor", "factor_banded", "skew_band", "solve_banded", "solve_skewed"]


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """``A = U^H D U`` of a batch of banded matrices.

    Attributes:
        skewed: (K + b, 2 b + 1, S). Entry ``[j, b]`` of the first K rows is ``d_j``, ``[j, b + i]`` is ``U[j, j + i]``,
            ``[j + i, b - i]`` is ``U[j, j + i]^* d_j``.
        inverse: (K, S), ``1 / d_j``.
    """

    skewed: Tensor
    inverse: Tensor

    @property
    def pivots(self) -> Tensor:
        """(K, S), the diagonal of D, real."""
        diagonal = self.skewed[: len(self.inverse), self.skewed.shape[1] // 2]
        return diagonal.real if diagonal.is_complex() else diagonal

    def solve(self, right_side: Tensor) -> Tensor:
        """Solve ``A x = right_side`` for right sides (K, M, S)."""
        count, width = len(self.inverse), self.skewed.shape[1] // 2
        if width == 0:
            return right_side * self.inverse[:, None]
        x = torch.cat([right_side, right_side.new_zeros(width, *right_side.shape[1:])])
        rows = x[:count].unbind()
        following = x[1:].unfold(0, width, 1).movedim(-1, 1).unbind()  # the b rows after each row
        for value, inverse, column, after in zip(
            rows, self.inverse.unbind(), _columns(self.skewed).unbind(), following, strict=True
        ):
            after.addcmul_(column, value.mul_(inverse), value=-1)
        upper = self.skewed[:count, width + 1 :, None].unbind()
        for value, row, after in zip(rows[::-1], upper[::-1], following[::-1], strict=True):
            value.sub_((row * after).sum(0))
        return x[:count]


def _columns(skewed: Tensor) -> Tensor:
    """Entries below the diagonal of every column, (K, b, 1, S): ``[j, i - 1]`` is ``A[j + i, j]``."""
    width, (line, entry, _) = skewed.shape[1] // 2, skewed.stride()
    shape = (len(skewed) - width, width, 1, skewed.shape[2])
    return skewed.as_strided(
        shape, (line, line - entry, entry, 1), skewed.storage_offset() + line + (width - 1) * entry
    )


def factor_banded(skewed: Tensor) -> BandedFactor:
    """Factor Hermitian positive definite matrices (K + b, 2 b + 1, S) as from ``skew_band`` in their own memory."""
    width, (line, entry, _) = skewed.shape[1] // 2, skewed.stride()
    count = len(skewed) - width
    pivots = skewed[:count, width]
    factor = BandedFactor(skewed, pivots.reciprocal())
    if width:
        # the b x b entries that step j changes are one strided view, because row j + 1 begins one column further right
        shape, strides = (count, width, width, skewed.shape[2]), (line, line - entry, entry, 1)
        trailing = skewed.as_strided(shape, strides, skewed.storage_offset() + line + width * entry)
        steps = (pivots, factor.inverse, skewed[:count, width + 1 :], _columns(skewed), trailing)
        for pivot, inverse, row, column, rest in zip(*(values.unbind() for values in steps), strict=True):
            torch.reciprocal(pivot, out=inverse)
            rest.addcmul_(column, row.mul_(inverse), value=-1)
    return factor


def skew_band(band: Tensor) -> Tensor:
    """Both sides of Hermitian bands, row by row.

    Args:
        band: Lower band (K, b + 1, S), ``band[k, d] = A[k + d, k]``; entries below the last row are not read. Real or
            complex; the batch S comes last, so that each step works on contiguous memory.

    Returns:
        (K + b, 2 b + 1, S), ``[k, b + d] = A[k, k + d]``.
    """
    count, diagonals, size = band.shape
    width = diagonals - 1
    skewed = band.new_zeros(count + width, 2 * width + 1, size)
    skewed[:count, width] = band[:, 0].real if band.is_complex() else band[:, 0]
    for d in range(1, min(diagonals, count)):
        skewed[d:count, width - d] = band[: count - d, d]
        skewed[: count - d, width + d] = band[: count - d, d].conj()
    return skewed


class _Solve(torch.autograd.Function):
    """Solve; the gradients of ``x = A^-1 g`` are ``A^-1 dx`` for g and ``-(A^-1 dx) x^H`` for A."""

    @staticmethod
    def forward(ctx: Any, skewed: Tensor, right_side: Tensor, factor: BandedFactor | None) -> Tensor:
        if factor is None:
            factor = factor_banded(skewed.clone() if ctx.needs_input_grad[0] else skewed)
        solution = factor.solve(right_side)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(factor.skewed, factor.inverse, solution)
        return solution

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, None]:
        skewed, inverse, x = ctx.saved_tensors
        adjoint = BandedFactor(skewed, inverse).solve(gradient)
        if not ctx.needs_input_grad[0]:
            return None, adjoint, None
        width, count = skewed.shape[1] // 2, len(inverse)
        of_matrix = torch.zeros_like(skewed)
        for d in range(-min(width, count - 1), min(width, count - 1) + 1):
            rows = slice(max(0, -d), min(count, count - d))
            columns = slice(max(0, d), min(count, count + d))
            of_matrix[rows, width + d] = -(adjoint[rows] * x[columns].conj()).sum(1)
        return of_matrix, adjoint, None


def solve_skewed(system: Tensor | BandedFactor, right_side: Tensor) -> Tensor:
    """Solve Hermitian positive definite systems, differentiably.

    Args:
        system: (K + b, 2 b + 1, S) as from ``skew_band``, overwritten unless its gradient is required; or its factors,
            for solving several times, through which no gradient flows.
        right_side: (K, M, S), M right sides per matrix.

    Returns:
        Solutions (K, M, S).
    """
    factor = system if isinstance(system, BandedFactor) else None
    skewed = system.skewed if isinstance(system, BandedFactor) else system
    solution: Tensor = _Solve.apply(skewed, right_side, factor)  # type: ignore[no-untyped-call]
    return solution


def solve_banded(band: Tensor, right_side: Tensor) -> Tensor:
    """Solve Hermitian positive definite banded systems, differentiably.

    Args:
        band: Lower band (K, b + 1, *S), ``band[k, d] = A[k + d, k]``; the imaginary part of the diagonal is ignored.
        right_side: (K, M, *S), M right sides per matrix.

    Returns:
        Solutions (K, M, *S).

    Example:
        >>> band = torch.tensor([[2.0, 1.0], [2.0, 1.0], [2.0, 0.0]])
        >>> solve_banded(band, torch.tensor([[3.0], [4.0], [3.0]])).flatten().round(decimals=4)
        tensor([1., 1., 1.])
    """
    skewed = skew_band(band.reshape(*band.shape[:2], -1))
    return solve_skewed(skewed, right_side.reshape(*right_side.shape[:2], -1)).reshape(right_side.shape)
