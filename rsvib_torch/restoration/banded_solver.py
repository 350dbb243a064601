"""Batched solver for Hermitian positive definite banded systems."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["BandedFactor", "factor_banded", "solve_banded"]


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """``A = L D L^H`` of a batch of banded matrices.

    Attributes:
        rows: (K, b, *S), row j holds the b entries right of the diagonal of ``L^H``.
        pivots: (K, *S), the real diagonal of D.
    """

    rows: Tensor
    pivots: Tensor

    def solve(self, right_side: Tensor) -> Tensor:
        """Solve ``A x = right_side`` for right sides (K, M, *S), M of them per matrix."""
        count, band = self.rows.shape[:2]
        x = torch.cat([right_side, right_side.new_zeros(band, *right_side.shape[1:])])
        lower = self.rows.conj().resolve_conj()[:, :, None]
        upper = self.rows[:, :, None]
        for j in range(count if band else 0):
            x[j + 1 : j + 1 + band].addcmul_(lower[j], x[j], value=-1)
        x[:count] /= self.pivots[:, None]
        for j in range(count - 2 if band else -1, -1, -1):
            x[j] -= (upper[j] * x[j + 1 : j + 1 + band]).sum(0)
        return x[:count]


def factor_banded(band: Tensor) -> BandedFactor:
    """Factor Hermitian positive definite banded matrices.

    The full band is kept skewed (row k of the storage holds row k of the matrix from k - b to k + b), so that the
    trailing window of an elimination step is one strided view and its update one call for the whole batch.

    Args:
        band: Lower band (K, b + 1, *S), ``band[k, d] = A[k + d, k]``; entries that would lie below the last row are
            not read. Real or complex; the batch S comes last, so that each step works on contiguous memory.

    Returns:
        The factors.
    """
    count, diagonals = band.shape[:2]
    width = diagonals - 1
    flat = band.flatten(2) if band.ndim > 2 else band[..., None]
    size = flat.shape[-1]
    full = flat.new_zeros(count + width, 2 * width + 1, size)
    full[:count, width] = flat[:, 0]
    full[count:, width] = 1.0
    for d in range(1, min(diagonals, count)):
        full[d:count, width - d] = flat[: count - d, d]
        full[: count - d, width + d] = flat[: count - d, d].conj()
    line = (2 * width + 1) * size
    for j in range(count if width else 0):
        row = full[j, width + 1 :]
        column = row.conj().resolve_conj() if row.is_complex() else row.clone()
        row.div_(full[j, width].real)
        window = full.as_strided((width, width, size), (2 * width * size, size, 1), (j + 1) * line + width * size)
        window.addcmul_(column[:, None], row[None], value=-1)
    shape = band.shape[2:]
    pivots = full[:count, width].real.reshape(count, *shape)
    return BandedFactor(full[:count, width + 1 :].reshape(count, width, *shape), pivots)


class _Solve(torch.autograd.Function):
    """Solve; the backward pass of a Hermitian solve is the same solve."""

    @staticmethod
    def forward(ctx: Any, band: Tensor, right_side: Tensor) -> Tensor:
        factor = factor_banded(band)
        solution = factor.solve(right_side)
        ctx.save_for_backward(factor.rows, factor.pivots, solution)
        return solution

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor]:
        rows, pivots, x = ctx.saved_tensors
        adjoint = BandedFactor(rows, pivots).solve(gradient)
        if not ctx.needs_input_grad[0]:
            return None, adjoint
        count, width = rows.shape[:2]
        band = rows.new_zeros(count, width + 1, *rows.shape[2:])
        band[:, 0] = -(adjoint * x.conj()).sum(1).real
        for d in range(1, min(width + 1, count)):
            below = (adjoint[d:] * x[:-d].conj()).sum(1) + (adjoint[:-d].conj() * x[d:]).sum(1)
            band[: count - d, d] = -below
        return band, adjoint


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
    solution: Tensor = _Solve.apply(band, right_side)  # type: ignore[no-untyped-call]
    return solution
