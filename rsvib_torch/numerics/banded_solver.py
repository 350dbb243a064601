"""Batched solver for Hermitian positive definite banded systems ``A x = g``.

Elimination of one row after the other factors ``A = U^H D U`` with a unit upper triangular U: for j = 0, 1, ...

    d_j = A[j, j],   U[j, k] = A[j, k] / d_j,   A[i, k] -= A[i, j] U[j, k]   for i, k = j + 1 ... j + b.

A matrix of K rows is given as both sides of its band, row by row: skewed (K + b, 2 b + 1, S) with ``[k, b + d] =
A[k, k + d]``, whose last b rows are 0. The batch S comes last, so that each step works on contiguous memory.

Forward substitution solves ``U^H D y = g``, back substitution ``U x = y``. Every step is one operation for the whole
batch of matrices.

A system is eliminated from both ends at a time, which halves the number of steps: the last rows in reverse order are
the second half of the batch. ``from_both_ends`` makes the two halves, each with the b or b + 1 middle rows. Both
eliminations together turn the middle rows into one small matrix.

``InterpolatedFactors`` are factors of systems that change smoothly with frequency: some are computed, the others are
interpolated.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import BackwardCFunction, once_differentiable


def _eliminated(skewed: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Eliminate the first rows of skewed matrices (K + b, 2 b + 1, S), in their memory: ``upper`` and ``inverse``."""
    width, (line, entry, _) = skewed.shape[1] // 2, skewed.stride()
    origin = skewed.storage_offset() + line
    pivots, upper = skewed[:steps, width], skewed[: len(skewed) - width, width + 1 :]
    # A[i, j] of step j, and A[i, k]: strided views, because row j + 1 begins one column further right
    strides = (line, line - entry, entry, 1)
    below = skewed.as_strided((steps, width, 1, skewed.shape[2]), strides, origin + (width - 1) * entry)
    trailing = skewed.as_strided((steps, width, width, skewed.shape[2]), strides, origin + width * entry)
    views = (pivots, upper[:steps], below, trailing)
    for pivot, row, column, block in zip(*(values.unbind() for values in views), strict=True):
        block.addcmul_(column, row.div_(pivot), value=-1)
    inverse = pivots.reciprocal()
    return upper, inverse.real if inverse.is_complex() else inverse


def from_both_ends(skewed: Tensor) -> Tensor:
    """The two halves (H + b, 2 b + 1, 2, ...) of skewed systems (K + b, 2 b + 1, ...).

    The first one has the rows 0 ... H - 1, the second one the rows K - 1 ... K - H in reverse order. Entries between
    the middle rows, which both contain, are in the first one only.
    """
    width = skewed.shape[1] // 2
    count = len(skewed) - width
    steps = max(0, count - width) // 2
    half = count - steps
    first, second = skewed[:half], skewed[steps:count].flip(0, 1)
    row = np.arange(half)[:, None]
    in_middle = (row >= steps) & (row + np.arange(-width, width + 1) >= steps)
    middle_entries = torch.from_numpy(in_middle).to(skewed.device).view(half, 2 * width + 1, *(1,) * (skewed.ndim - 2))
    halves = torch.stack([first, second.masked_fill(middle_entries, 0)], 2)
    return torch.cat([halves, halves.new_zeros(width, *halves.shape[1:])])


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """``A = U^H D U`` of a batch of banded matrices, eliminated from both ends: 2 S halves of H rows."""

    # (H, b, 2 S), ``[j, i - 1]`` is ``U[j, j + i]``; rows that are not eliminated are 0
    upper: Tensor
    inverse: Tensor  # (steps, 2 S), ``1 / d_j`` of the eliminated rows, real
    # U^-1 (m, m, S) and 1 / D (m, S) of the matrix that the elimination leaves of the m middle rows: the inverse of the
    # matrix itself loses three times as much to rounding
    middle: Tensor
    middle_inverse: Tensor

    def split(self, number: int) -> list["BandedFactor"]:
        """Factors of ``number`` equal parts of the batch."""
        ends = (values.unflatten(-1, (2, number, -1)) for values in (self.upper, self.inverse))
        upper, inverse = ([part.flatten(-2) for part in values.unbind(-2)] for values in ends)
        middle, middle_inverse = (values.chunk(number, -1) for values in (self.middle, self.middle_inverse))
        return [BandedFactor(*parts) for parts in zip(upper, inverse, middle, middle_inverse, strict=True)]

    def log_determinant(self) -> Tensor:
        """Logarithms (S,) of the determinants of the matrices, float64."""
        ends, middle = (inverse.double().log().sum(0) for inverse in (self.inverse, self.middle_inverse))
        return -(ends.view(2, -1).sum(0) + middle)

    def halves(self, values: Tensor) -> Tensor:
        """The halves (H, M, 2 S) of values (K, M, S)."""
        half = len(self.upper)
        return torch.cat([values[:half], values.flip(0)[:half]], -1)

    def solve(self, right_side: Tensor) -> Tensor:
        """Solve ``A x = right_side`` for right sides (K, M, S)."""
        (half, width, size), steps = self.upper.shape, len(self.inverse)
        x = right_side.new_empty(half + width, right_side.shape[1], size)
        halves = x[:half]
        halves.copy_(self.halves(right_side).conj())
        first_half, second_half = halves.split(right_side.shape[-1], -1)
        second_half[steps:] = 0
        x[half:] = 0
        # U right of the diagonal, (b, 1, 2 S) of each row, and above it, of the columns from b on; views of x
        upper = self.upper[:steps, :, None].unbind()
        line, entry, _ = self.upper.stride()
        first_column = self.upper.storage_offset() + (width - 1) * entry
        shape = (max(0, half - width), width, 1, size)
        columns = self.upper.as_strided(shape, (line, line - entry, entry, 1), first_column).unbind()
        rows, runs = halves.unbind(), x.unfold(0, width, 1).movedim(-1, 1).unbind()
        # 1. U^H y = g is U^T y^* = g^*: both substitutions use the same U.
        for value, row, below in zip(rows, upper, runs[1:], strict=False):
            below.addcmul_(row, value, value=-1)
        if x.is_complex():
            x.conj_physical_()
        x[:steps].mul_(self.inverse[:, None])
        # 2. The middle rows, after both eliminations.
        middle = first_half[steps:] + second_half[steps:].flip(0)
        middle = (self.middle.conj()[:, :, None] * middle[:, None]).sum(0) * self.middle_inverse[:, None]
        middle = (self.middle[:, :, None] * middle).sum(1)
        halves[steps:] = torch.cat([middle, middle.flip(0)], -1)
        # 3. U x = y, the first b rows one by one.
        for j in range(half - 1, width - 1, -1):
            runs[j - width].addcmul_(columns[j - width], rows[j], value=-1)
        for j in range(min(width - 1, steps) - 1, -1, -1):
            later = x[j + 1 : width]
            rows[j].sub_((upper[j][: len(later)] * later).sum(0))
        return torch.cat([first_half, second_half[:steps].flip(0)])


def factor_banded(halves: Tensor, count: int) -> BandedFactor:
    """Factor Hermitian positive definite matrices of ``count`` rows from ``from_both_ends`` in their own memory."""
    width, size = halves.shape[1] // 2, halves.shape[2] // 2
    half = len(halves) - width
    steps = count - half
    ends = _eliminated(halves, steps)
    first, second = halves[steps:half].split(size, -1)
    middle = halves.new_zeros(half - steps + width, 2 * width + 1, size)
    torch.add(first, second.flip(0, 1), out=middle[: half - steps])
    halves[steps:half, width + 1 :] = 0
    _, inverse = _eliminated(middle, half - steps)
    # the middle rows as dense matrices: a strided view, because each row begins one column further right
    line, entry, _ = middle.stride()
    dense = middle.as_strided((half - steps, half - steps, size), (line - entry, entry, 1), width * entry).movedim(
        -1, 0
    )
    identity = torch.eye(half - steps, dtype=halves.dtype, device=halves.device)
    upper = torch.linalg.solve_triangular(dense, identity, upper=True, unitriangular=True)
    return BandedFactor(*ends, upper.movedim(0, -1).contiguous(), inverse)


class _Solve(torch.autograd.Function):
    """Solve; the gradients of ``x = A^-1 g`` are ``A^-1 dx`` for g and ``-(A^-1 dx) x^H`` for A."""

    @staticmethod
    def forward(ctx: BackwardCFunction, system: Tensor | BandedFactor, right_side: Tensor) -> Tensor:
        if isinstance(system, BandedFactor):
            factor = system
        else:
            factor = factor_banded(system.clone() if ctx.needs_input_grad[0] else system, len(right_side))
        solution = factor.solve(right_side)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(*vars(factor).values(), solution)
        return solution

    @staticmethod
    @once_differentiable
    def backward(ctx: BackwardCFunction, gradient: Tensor) -> tuple[Tensor | None, Tensor]:
        *tensors, x = list(ctx.saved_tensors)
        factor = BandedFactor(*tensors)
        adjoint = factor.solve(gradient)
        if not ctx.needs_input_grad[0]:
            return None, adjoint
        count, width, size = factor.upper.shape
        adjoint_halves, solution_halves = factor.halves(adjoint), factor.halves(x.conj())
        matrix_gradient = adjoint_halves.new_zeros(count + width, 2 * width + 1, size)
        for d in range(-min(width, count - 1), min(width, count - 1) + 1):
            rows = slice(max(0, -d), min(count, count - d))
            columns = slice(max(0, d), min(count, count + d))
            matrix_gradient[rows, width + d] = -(adjoint_halves[rows] * solution_halves[columns]).sum(1)
        return matrix_gradient, adjoint


def solve_halves(system: Tensor | BandedFactor, right_side: Tensor) -> Tensor:
    """Solve Hermitian positive definite systems differentiably, for right sides and solutions (K, M, S).

    The systems (H + b, 2 b + 1, 2 S), as from ``from_both_ends``, are overwritten unless their gradient is required. No
    gradient flows through factors, for solving several times.
    """
    return _Solve.apply(system, right_side)  # type: ignore[no-untyped-call]


def node_frequencies(count: int, step: float, device: torch.device) -> Tensor:
    """Indices (N,) of the frequencies whose systems are factored, of ``count`` from 0 on.

    Steps increase with the frequency up to ``step``, because priors change most at low frequencies: with steps of a
    sixth of the frequency, a restored frame of 2048 x 2048 px changes by 2e-5 of full scale (rms).
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
    """

    nodes: Tensor  # (N,) frequencies of the nodes, ascending from the first to the last of all frequencies
    tensors: tuple[Tensor, ...]  # the fields of a ``BandedFactor``, (..., n, N) instead of (..., S)

    @classmethod
    def of(cls, halves: Tensor, nodes: Tensor, count: int) -> "InterpolatedFactors":
        """Factor matrices (H + b, 2 b + 1, 2 n N) as ``factor_banded`` in their own memory."""
        tensors = vars(factor_banded(halves, count)).values()
        return cls(nodes, tuple(values.unflatten(-1, (-1, len(nodes))).contiguous() for values in tensors))

    def at(self, part: slice) -> BandedFactor:
        """Factors of n S matrices at S consecutive frequencies."""
        frequencies = torch.arange(part.start, part.stop, dtype=torch.float64, device=self.nodes.device)
        ends = torch.searchsorted(self.nodes, frequencies[[0, -1]].long(), right=True)
        first, last = ends.clamp(max=len(self.nodes) - 1).tolist()
        nodes = slice(first - 1, last + 1)
        places = self.nodes[nodes].to(torch.float64)
        rising = (frequencies - places[:-1, None]) / places.diff()[:, None]
        ones = torch.ones_like(rising[:1])
        hat = torch.minimum(torch.cat([ones, rising]), torch.cat([1 - rising, ones])).clamp(min=0)  # (nodes, S)
        return BandedFactor(*((values[..., nodes] @ hat.to(values)).flatten(-2) for values in self.tensors))
