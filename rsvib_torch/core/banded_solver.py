"""Batched solver for Hermitian positive definite banded systems ``A x = g``.

Elimination of one row after the other factors ``A = U^H D U`` with a unit upper triangular U: for j = 0, 1, ...

    d_j = A[j, j],   U[j, k] = A[j, k] / d_j,   A[i, k] -= A[i, j] U[j, k]   for i, k = j + 1 ... j + b.

Forward substitution solves ``U^H D y = g``, back substitution ``U x = y``. Every step is one operation for the whole
batch of matrices.

``InterpolatedFactors`` are those of systems that change smoothly with frequency: some are computed, the others are
interpolated.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = [
    "BandedFactor",
    "InterpolatedFactors",
    "extend_system",
    "factor_banded",
    "node_frequencies",
    "skew_band",
    "solve_banded",
    "solve_skewed",
]


class _Solution(NamedTuple):
    """Memory of a solution.

    Attributes:
        x: (K + b, M, S).
        rows: The K first rows.
        runs: Rows j ... j + b - 1, for j = 0 ... K.
    """

    x: Tensor
    rows: tuple[Tensor, ...]
    runs: tuple[Tensor, ...]

    @classmethod
    def of(cls, right_side: Tensor, width: int) -> "_Solution":
        """Memory for right sides (K, M, S)."""
        x = right_side.new_empty(len(right_side) + width, *right_side.shape[1:])
        return cls(x, x[: len(right_side)].unbind(), x.unfold(0, width, 1).movedim(-1, 1).unbind())


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """``A = U^H D U`` of a batch of banded matrices.

    The views of every step are kept with the memory of the solution, because creating them takes as long as a solution
    of few systems. A factor must not be used by two threads at the same time.

    Attributes:
        upper: (K, b, S), ``[j, i - 1]`` is ``U[j, j + i]``; values beyond the last column have no meaning.
        inverse: (K, S), ``1 / d_j``, real.
    """

    upper: Tensor
    inverse: Tensor
    _solutions: dict[int, "_Solution"] = field(default_factory=dict)

    @cached_property
    def _rows(self) -> tuple[Tensor, ...]:
        """U right of the diagonal, (b, 1, S) of each row."""
        return self.upper[:, :, None].unbind()

    @cached_property
    def _columns(self) -> tuple[Tensor, ...]:
        """U above the diagonal, (b, 1, S) of the columns from b on."""
        (count, width, size), (line, entry, _) = self.upper.shape, self.upper.stride()
        shape, first = (max(0, count - width), width, 1, size), self.upper.storage_offset() + (width - 1) * entry
        return self.upper.as_strided(shape, (line, line - entry, entry, 1), first).unbind()

    def solve(self, right_side: Tensor) -> Tensor:
        """Solve ``A x = right_side`` for right sides (K, M, S)."""
        count, width = self.upper.shape[:2]
        if width == 0:
            return right_side * self.inverse[:, None]
        if right_side.shape[1] not in self._solutions:
            self._solutions[right_side.shape[1]] = _Solution.of(right_side, width)
        x, rows, runs = self._solutions[right_side.shape[1]]
        x[:count] = right_side.conj()  # U^H y = g is U^T y^* = g^*: both substitutions use the same U
        x[count:] = 0
        for value, row, below in zip(rows, self._rows, runs[1:], strict=True):
            below.addcmul_(row, value, value=-1)
        if x.is_complex():
            x.conj_physical_()
        x[:count] *= self.inverse[:, None]
        for j in range(count - 1, width - 1, -1):
            runs[j - width].addcmul_(self._columns[j - width], rows[j], value=-1)
        for j in range(min(width, count) - 1, 0, -1):
            column = torch.stack([self.upper[k, j - 1 - k] for k in range(j)])
            x[:j].addcmul_(column[:, None], rows[j], value=-1)
        return x[:count].clone()


def factor_banded(skewed: Tensor) -> BandedFactor:
    """Factor Hermitian positive definite matrices (K + b, 2 b + 1, S) as from ``skew_band`` in their own memory."""
    width, (line, entry, _) = skewed.shape[1] // 2, skewed.stride()
    count, first = len(skewed) - width, skewed.storage_offset() + line
    pivots, upper = skewed[:count, width], skewed[:count, width + 1 :]
    inverse = pivots.reciprocal()
    if width:
        # A[i, j] of step j, and A[i, k]: strided views, because row j + 1 begins one column further right
        strides = (line, line - entry, entry, 1)
        below = skewed.as_strided((count, width, 1, skewed.shape[2]), strides, first + (width - 1) * entry)
        trailing = skewed.as_strided((count, width, width, skewed.shape[2]), strides, first + width * entry)
        steps = (pivots, inverse, upper, below, trailing)
        for pivot, over, row, column, rest in zip(*(values.unbind() for values in steps), strict=True):
            torch.reciprocal(pivot, out=over)
            rest.addcmul_(column, row.mul_(over), value=-1)
    return BandedFactor(upper, inverse.real if inverse.is_complex() else inverse)


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


def extend_system(skewed: Tensor, count: int, width: int) -> Tensor:
    """Systems (K + b, 2 b + 1, S) as from ``skew_band`` with further rows, those of the identity matrix.

    Args:
        skewed: The systems.
        count: Number of rows of the result, at least K.
        width: Half-width of its band, at least b.

    Returns:
        (count + width, 2 width + 1, S).
    """
    b = skewed.shape[1] // 2
    rows = len(skewed) - b
    if (rows, b) == (count, width):
        return skewed
    extended = skewed.new_zeros(count + width, 2 * width + 1, skewed.shape[2])
    extended[:rows, width - b : width + b + 1] = skewed[:rows]
    for d in range(1, b + 1):  # entries beyond the last column may have any value
        extended[rows - d : rows, width + d] = 0
    extended[rows:count, width] = 1
    return extended


class _Solve(torch.autograd.Function):
    """Solve; the gradients of ``x = A^-1 g`` are ``A^-1 dx`` for g and ``-(A^-1 dx) x^H`` for A."""

    @staticmethod
    def forward(ctx: Any, system: Tensor | BandedFactor, right_side: Tensor) -> Tensor:
        if isinstance(system, BandedFactor):
            factor = system
        else:
            factor = factor_banded(system.clone() if ctx.needs_input_grad[0] else system)
        solution = factor.solve(right_side)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(factor.upper, factor.inverse, solution)
        return solution

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor]:
        upper, inverse, x = ctx.saved_tensors
        adjoint = BandedFactor(upper, inverse).solve(gradient)
        if not ctx.needs_input_grad[0]:
            return None, adjoint
        count, width, size = upper.shape
        of_matrix = upper.new_zeros(count + width, 2 * width + 1, size)
        for d in range(-min(width, count - 1), min(width, count - 1) + 1):
            rows = slice(max(0, -d), min(count, count - d))
            columns = slice(max(0, d), min(count, count + d))
            of_matrix[rows, width + d] = -(adjoint[rows] * x[columns].conj()).sum(1)
        return of_matrix, adjoint


def solve_skewed(system: Tensor | BandedFactor, right_side: Tensor) -> Tensor:
    """Solve Hermitian positive definite systems, differentiably.

    Args:
        system: (K + b, 2 b + 1, S) as from ``skew_band``, overwritten unless its gradient is required; or its factors,
            for solving several times, through which no gradient flows.
        right_side: (K, M, S), M right sides per matrix.

    Returns:
        Solutions (K, M, S).
    """
    solution: Tensor = _Solve.apply(system, right_side)  # type: ignore[no-untyped-call]
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


def node_frequencies(count: int, step: float, device: torch.device) -> Tensor:
    """Indices (N,) of the frequencies whose systems are factored, of ``count`` from 0 on.

    Steps increase with the frequency up to ``step``, because priors change most at low frequencies: with steps of a
    sixth of the frequency, a restored frame of 2048 x 2048 px changes by 2e-5 of full scale (rms).

    Example:
        >>> node_frequencies(28, 3.0, torch.device("cpu")).tolist()
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 18, 21, 24, 27]
    """
    nodes = [0]
    while nodes[-1] < count - 1:
        nodes.append(min(count - 1, nodes[-1] + max(1, int(min(step, nodes[-1] / 6)))))
    return torch.tensor(nodes, device=device)


@dataclass(frozen=True, eq=False)
class InterpolatedFactors:
    """``A = U^H D U`` of n batches of matrices at a few frequencies, the nodes.

    U and D are as smooth in the frequency as A is. Linear interpolation of both replaces the elimination, whose number
    of operations is b / 2 times that of solving with the factors.

    Attributes:
        nodes: (N,) frequencies of the nodes, ascending from the first to the last of all frequencies.
        upper: (K, b, n, N) as in ``BandedFactor``.
        inverse: (K, n, N) likewise.
    """

    nodes: Tensor
    upper: Tensor
    inverse: Tensor

    @classmethod
    def of(cls, skewed: Tensor, nodes: Tensor) -> "InterpolatedFactors":
        """Factor matrices (K + b, 2 b + 1, n N) as from ``skew_band`` in their own memory."""
        factor = factor_banded(skewed)
        upper, inverse = (
            values.unflatten(-1, (-1, len(nodes))).contiguous() for values in (factor.upper, factor.inverse)
        )
        return cls(nodes, upper, inverse)

    def at(self, part: slice, out: BandedFactor | None = None) -> BandedFactor:
        """Factors of n S matrices at S consecutive frequencies, in the memory of ``out`` if they fit."""
        chosen = torch.arange(part.start, part.stop, dtype=torch.float64, device=self.nodes.device)
        ends = torch.searchsorted(self.nodes, chosen[[0, -1]].long(), right=True).clamp(max=len(self.nodes) - 1)
        near = slice(int(ends[0]) - 1, int(ends[1]) + 1)
        places = self.nodes[near].to(torch.float64)
        rising = (chosen - places[:-1, None]) / places.diff()[:, None]
        one = torch.ones_like(rising[:1])
        hat = torch.minimum(torch.cat([one, rising]), torch.cat([1 - rising, one])).clamp(min=0)  # (nodes, S)
        batch = self.inverse.shape[1] * len(chosen)
        if out is None or out.inverse.shape[-1] != batch:
            out = BandedFactor(
                self.upper.new_empty(*self.upper.shape[:2], batch), self.inverse.new_empty(len(self.inverse), batch)
            )
        for nodes, values in ((self.upper, out.upper), (self.inverse, out.inverse)):
            torch.mm(nodes[..., near].flatten(0, -2), hat.to(nodes.dtype), out=values.view(-1, len(chosen)))
        return out
