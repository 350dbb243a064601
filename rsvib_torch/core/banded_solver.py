"""Batched solver for Hermitian positive definite banded systems."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rsvib_torch.core.in_order import making_views, subtract_products

__all__ = [
    "BandedFactor",
    "BandedMemory",
    "factor_banded",
    "factor_skewed",
    "runs_of_rows",
    "skew_band",
    "solve_banded",
    "solve_factored",
    "solve_skewed",
]


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """``A = L D L^H`` of a batch of banded matrices.

    Attributes:
        skewed: (K + b, 2 b + 1, S). Entry ``[j, b]`` of the first K rows is the diagonal of D, entries right of it
            are row j of ``L^H``, entries ``[j + i, b - i]`` column j of ``L D``; the rest has no meaning.
        inverse: (K, S), the diagonal of the inverse of D.
    """

    skewed: Tensor
    inverse: Tensor
    _memories: dict[int, tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]] = field(default_factory=dict)

    @property
    def width(self) -> int:
        """The half-width b of the band."""
        return self.skewed.shape[1] // 2

    @property
    def pivots(self) -> Tensor:
        """(K, S), the real diagonal of D."""
        diagonal = self.skewed[: len(self.inverse), self.width]
        return diagonal.real if diagonal.is_complex() else diagonal

    @cached_property
    @making_views()
    def _right(self) -> tuple[Tensor, ...]:
        """Rows of ``L^H`` right of the diagonal, (b, 1, S) each."""
        return self.skewed[: len(self.inverse), self.width + 1 :, None].unbind() if self.width else ()

    @cached_property
    @making_views()
    def _above(self) -> tuple[Tensor, ...]:
        return _columns(self.skewed, below=False)

    def solve(self, right_side: Tensor) -> Tensor:
        """Solve ``A x = right_side`` for right sides (K, M, S), M of them per matrix."""
        count, x, values, windows = len(self.inverse), *self._memory(right_side)
        x[:count] = right_side.conj()
        x[count:] = 0
        if self.width:
            subtract_products(windows[1:], self._right, values[:count])  # columns of the conjugate of L
        if x.is_complex():
            x.conj_physical_()
        x[:count] *= self.inverse[:, None]
        return self.substitute(x, values, windows, count).clone()

    @making_views()
    def _memory(self, right_side: Tensor) -> tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Memory for right sides like these, its rows, and every run of b of them: made once, for many solutions."""
        number = right_side.shape[1]
        if number not in self._memories:
            x = right_side.new_empty(len(self.skewed), *right_side.shape[1:])
            self._memories[number] = (x, x.unbind(), runs_of_rows(x, self.width))
        return self._memories[number]

    def substitute(self, x: Tensor, values: tuple[Tensor, ...], windows: tuple[Tensor, ...], count: int) -> Tensor:
        """Solve ``L^H x' = x`` in place for right sides (K + b, M, S); returns the first rows.

        Args:
            x: Right sides, those beyond ``count`` rows 0.
            values: Its rows.
            windows: Every run of b of its rows.
            count: Rows K, or fewer of a smaller system.
        """
        width = self.width
        if width and count > width:
            back = slice(count - 1 - width, None, -1)
            subtract_products(windows[back], self._above[back], values[count - 1 : width - 1 : -1])
        for j in range(min(width, count) - 1, 0, -1):
            column = torch.stack([self.skewed[k, width + j - k] for k in range(j)])
            x[:j].addcmul_(column[:, None], values[j], value=-1)
        return x[:count]


def _with_rows(values: Tensor, count: int) -> Tensor:
    return torch.cat([values, values.new_zeros(count, *values.shape[1:])])


def runs_of_rows(x: Tensor, width: int) -> tuple[Tensor, ...]:
    """Every run of ``width`` rows of x (K + b, M, S)."""
    step = x.stride()
    shape = (len(x) - width + 1, width, *x.shape[1:])
    return x.as_strided(shape, (step[0], *step), x.storage_offset()).unbind() if width else ()


def _columns(full: Tensor, *, below: bool) -> tuple[Tensor, ...]:
    """For every row j < K, what column j holds below, or column j + b above, the diagonal, (b, 1, S)."""
    width = full.shape[1] // 2
    if width == 0:
        return ()
    line, entry = full.stride(0), full.stride(1)
    first = full.storage_offset() + (line + (width - 1) * entry if below else 2 * width * entry)
    shape = (len(full) - width, width, 1, full.shape[2])
    return full.as_strided(shape, (line, line - entry, entry, 1), first).unbind()


class _Elimination:
    """Views of every step of factoring matrices in their own memory, of ``factor_skewed``."""

    @making_views()
    def __init__(self, full: Tensor, right_side: Tensor | None) -> None:
        width, size = full.shape[1] // 2, full.shape[2]
        count = len(full) - width
        pivots = full[:count, width]
        self.factor = BandedFactor(full, torch.empty_like(pivots, memory_format=torch.contiguous_format))
        self.right_side = right_side
        self.values = () if right_side is None else right_side.unbind()
        self.windows = () if right_side is None else runs_of_rows(right_side, width)
        line, entry = full.stride(0), full.stride(1)
        # the trailing window of every step: skewed, so that it is one strided view
        first = full.storage_offset() + line + width * entry
        shape, strides = (count, width, width, size), (line, line - entry, entry, 1)
        self._steps = list(
            zip(
                pivots.unbind(),
                self.factor.inverse.unbind(),
                full[:count, width + 1 :].unbind(),
                _columns(full, below=True),
                full.as_strided(shape, strides, first).unbind() if width else (),
                strict=False,  # none without a band
            )
        )

    def run(self, count: int) -> BandedFactor:
        """Factor what the first ``count`` rows of the memory hold now."""
        if self.factor.width == 0:
            torch.reciprocal(self.factor.skewed[:, 0], out=self.factor.inverse)
            if self.right_side is not None:
                self.right_side.mul_(self.factor.inverse[:, None])
            return self.factor
        values, windows = self.values, self.windows
        for j, (pivot, inverse, row, column, trailing) in enumerate(self._steps[:count]):
            torch.reciprocal(pivot, out=inverse)
            trailing.addcmul_(column, row.mul_(inverse), value=-1)
            if values:
                windows[j + 1].addcmul_(column, values[j].mul_(inverse), value=-1)
        return self.factor


def factor_skewed(full: Tensor, right_side: Tensor | None = None) -> BandedFactor:
    """Factor Hermitian positive definite matrices in their own memory.

    Args:
        full: (K + b, 2 b + 1, S) as from ``skew_band``, contiguous; overwritten.
        right_side: (K + b, M, S) whose last b rows are 0; overwritten with ``(L D)^-1`` times it.

    Returns:
        The factors.
    """
    return _Elimination(full, right_side).run(len(full) - full.shape[1] // 2)


class BandedMemory:
    """Memory for systems of one size, with views of every step of solving them: made once, for many systems.

    The views cost as much as the arithmetic.

    Args:
        rows: Rows K of the largest systems.
        width: Half-width b of the band.
        right_sides: Right sides M of each matrix; 0 where only factors are wanted.
        batch: Matrices S that are solved at a time.
        like: A tensor of the dtype and on the device of the systems.

    Attributes:
        full: (K + b, 2 b + 1, S), the first rows of which are to hold systems as from ``skew_band``.
        right_side: (K + b, M, S), likewise.
    """

    def __init__(self, rows: int, width: int, right_sides: int, batch: int, like: Tensor) -> None:
        self.full = like.new_empty(rows + width, 2 * width + 1, batch)
        self.right_side = like.new_empty(rows + width, right_sides, batch)
        self._elimination = _Elimination(self.full, self.right_side if right_sides else None)

    def holds(self, rows: int, width: int, right_sides: int, batch: int) -> bool:
        """Whether systems of so many rows can be solved in it."""
        same = self.full.shape[1:] == (2 * width + 1, batch) and self.right_side.shape[1] == right_sides
        return same and len(self.full) - width >= rows

    def factor(self, rows: int) -> BandedFactor:
        """Factor the systems of so many rows that the memory holds, in it."""
        factor, width = self._elimination.run(rows), self.full.shape[1] // 2
        return BandedFactor(factor.skewed[: rows + width], factor.inverse[:rows])

    def solve(self, rows: int) -> Tensor:
        """Solve the systems of so many rows that the memory holds; returns a part of ``right_side``."""
        elimination = self._elimination
        self.right_side[rows : rows + self.full.shape[1] // 2] = 0
        factor = elimination.run(rows)
        return factor.substitute(self.right_side, elimination.values, elimination.windows, rows)


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
        x = _with_rows(right_side, full.shape[1] // 2)
        elimination = _Elimination(full.clone() if ctx.needs_input_grad[0] else full, x)
        count = len(right_side)
        factor = elimination.run(count)
        solution = factor.substitute(x, elimination.values, elimination.windows, count)
        ctx.save_for_backward(factor.skewed, factor.inverse, solution)
        return solution

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor]:
        skewed, inverse, x = ctx.saved_tensors
        factor = BandedFactor(skewed, inverse)
        adjoint = factor.solve(gradient)
        if not ctx.needs_input_grad[0]:
            return None, adjoint
        width, count = factor.width, len(inverse)
        full = torch.zeros_like(skewed)
        for d in range(-min(width, count - 1), min(width, count - 1) + 1):
            rows = slice(max(0, -d), min(count, count - d))
            columns = slice(max(0, d), min(count, count + d))
            full[rows, width + d] = -(adjoint[rows] * x[columns].conj()).sum(1)
        return full, adjoint


class _SolveAgain(torch.autograd.Function):
    """Solve with factors at hand, that have no gradient."""

    @staticmethod
    def forward(ctx: Any, factor: BandedFactor, right_side: Tensor) -> Tensor:
        ctx.factor = factor
        return factor.solve(right_side)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:
        return None, ctx.factor.solve(gradient)


def solve_factored(factor: BandedFactor, right_side: Tensor) -> Tensor:
    """Solve ``A x = right_side`` (K, M, S) with the factors of A, differentiably in the right sides."""
    solution: Tensor = _SolveAgain.apply(factor, right_side)  # type: ignore[no-untyped-call]
    return solution


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
