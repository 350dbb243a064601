"""Batched solver for Hermitian positive definite banded systems."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["BandedFactor", "factor_banded", "factor_skewed", "skew_band", "solve_banded", "solve_skewed"]


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """``A = L D L^H`` of a batch of banded matrices.

    Attributes:
        skewed: (K + b, 2 b + 1, S). Entry ``[j, b]`` of the first K rows is the diagonal of D, entries right of it
            are row j of ``L^H``, entries ``[j + i, b - i]`` column j of ``L D``; the rest has no meaning.
    """

    skewed: Tensor

    @property
    def width(self) -> int:
        """The half-width b of the band."""
        return self.skewed.shape[1] // 2

    @property
    def count(self) -> int:
        """The number K of rows."""
        return len(self.skewed) - self.width

    @property
    def pivots(self) -> Tensor:
        """(K, S), the real diagonal of D."""
        diagonal = self.skewed[: self.count, self.width]
        return diagonal.real if diagonal.is_complex() else diagonal

    def solve(self, right_side: Tensor) -> Tensor:
        """Solve ``A x = right_side`` for right sides (K, M, S), M of them per matrix."""
        width, count, full = self.width, self.count, self.skewed
        x = torch.cat([right_side, right_side.new_zeros(width, *right_side.shape[1:])])
        pivots, below, above = full[:count, width].unbind(), self._columns(below=True), self._columns(below=False)
        values, step = x.unbind(), x.stride()
        windows = x.as_strided((count, width, *x.shape[1:]), (step[0], *step), x.storage_offset()).unbind()
        for j in range(count):
            values[j].div_(pivots[j])
            if width and j + 1 < count:
                windows[j + 1].addcmul_(below[j], values[j], value=-1)
        for j in range(count - 1, 0, -1):
            if j >= width > 0:
                windows[j - width].addcmul_(above[j - width], values[j], value=-1)
            elif width:
                x[:j].addcmul_(torch.stack([full[k, width + j - k] for k in range(j)])[:, None], values[j], value=-1)
        return x[:count]

    def _columns(self, *, below: bool) -> tuple[Tensor, ...]:
        """For every row j < K, what column j holds below, or column j + b above, the diagonal, (b, 1, S)."""
        line, entry = self.skewed.stride(0), self.skewed.stride(1)
        first = self.skewed.storage_offset() + (line + (self.width - 1) * entry if below else 2 * self.width * entry)
        shape = (self.count, self.width, 1, self.skewed.shape[2])
        if self.width == 0:
            return ()
        return self.skewed.as_strided(shape, (line, line - entry, entry, 1), first).unbind()


def factor_skewed(full: Tensor) -> BandedFactor:
    """Factor a contiguous skewed band (K + b, 2 b + 1, S), of which both sides are filled, in its own memory."""
    factor = BandedFactor(full)
    width, count = factor.width, factor.count
    if width == 0:
        return factor
    line, entry = full.stride(0), full.stride(1)
    shape = (count, width, width, full.shape[2])
    # the trailing window of every step: skewed, so that it is one strided view
    first = full.storage_offset() + line + width * entry
    windows = full.as_strided(shape, (line, line - entry, entry, 1), first).unbind()
    pivots, rows, columns = (
        full[:count, width].unbind(),
        full[:count, width + 1 :].unbind(),
        factor._columns(below=True),
    )
    for j in range(count):
        rows[j].div_(pivots[j])
        windows[j].addcmul_(columns[j], rows[j], value=-1)
    return factor


def skew_band(band: Tensor) -> Tensor:
    """Both sides of Hermitian bands, row by row.

    Args:
        band: Lower band (K, b + 1, S), ``band[k, d] = A[k + d, k]``; entries that would lie below the last row are
            not read. Real or complex; the batch S comes last, so that each step works on contiguous memory.

    Returns:
        (K + b, 2 b + 1, S), ``[k, b + d] = A[k, k + d]``.
    """
    count, diagonals, size = band.shape
    width = diagonals - 1
    full = band.new_zeros(count + width, 2 * width + 1, size)
    full[:count, width] = band[:, 0].real if band.is_complex() else band[:, 0]
    for d in range(1, min(diagonals, count)):
        full[d:count, width - d] = band[: count - d, d]
        full[: count - d, width + d] = band[: count - d, d].conj()
    return full


def factor_banded(band: Tensor) -> BandedFactor:
    """Factor Hermitian positive definite bands, laid out as in ``skew_band``.

    In the skewed storage the trailing window of an elimination step is one strided view, its update one call for the
    whole batch.
    """
    return factor_skewed(skew_band(band))


class _Solve(torch.autograd.Function):
    """Solve; the backward pass of a Hermitian solve is the same solve."""

    @staticmethod
    def forward(ctx: Any, full: Tensor, right_side: Tensor) -> Tensor:
        factor = factor_skewed(full.clone() if ctx.needs_input_grad[0] else full)
        solution = factor.solve(right_side)
        ctx.save_for_backward(factor.skewed, solution)
        return solution

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor]:
        skewed, x = ctx.saved_tensors
        factor = BandedFactor(skewed)
        adjoint = factor.solve(gradient)
        if not ctx.needs_input_grad[0]:
            return None, adjoint
        width, count = factor.width, factor.count
        full = torch.zeros_like(skewed)
        for d in range(-min(width, count - 1), min(width, count - 1) + 1):
            rows = slice(max(0, -d), min(count, count - d))
            columns = slice(max(0, d), min(count, count + d))
            full[rows, width + d] = -(adjoint[rows] * x[columns].conj()).sum(1)
        return full, adjoint


def solve_skewed(full: Tensor, right_side: Tensor) -> Tensor:
    """Solve Hermitian positive definite systems laid out by rows, differentiably.

    Args:
        full: (K + b, 2 b + 1, S) as from ``skew_band``, contiguous; its memory is used up unless its gradient is asked
            for.
        right_side: (K, M, S), M right sides per matrix.

    Returns:
        Solutions (K, M, S).
    """
    solution: Tensor = _Solve.apply(full, right_side)  # type: ignore[no-untyped-call]
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
    shape = (*band.shape[:2], -1)
    return solve_skewed(skew_band(band.reshape(shape)), right_side.reshape(*right_side.shape[:2], -1)).reshape(
        right_side.shape
    )
