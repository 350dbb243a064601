"""Banded systems that change smoothly with frequency: factors of a few of them, interpolated for all others."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.banded_solver import BandedFactor, runs_of_rows
from rsvib_torch.core.chunking import runs
from rsvib_torch.core.in_order import making_views, subtract_products
from rsvib_torch.restoration.scene_model.segments import Segments

Mixture = list[tuple[slice, slice, Tensor]]

__all__ = ["NodeFactors", "SubstitutionMemory", "chosen_nodes"]

_ALIGNED = 8  # nodes: products of matrices take several times as long where rows do not begin at full cache lines
_FINER = 6.0  # times the frequency itself: steps between low frequencies, where priors change most, are smaller
_BLOCK, _LEAST = 96, 24  # systems that one product of matrices interpolates, at most and at least:
_NODES = 6  # not many nodes count for them
_ROWS = {"cpu": 160}  # that are interpolated at a time: they stay in the cache


def chosen_nodes(frequencies: int, step: float, device: torch.device) -> Tensor:
    """Indices (N,) of the frequencies to factor: all of the lowest, then in growing steps of up to ``step``.

    The widest steps are halved until there is a multiple of eight, as long as there are steps to halve.

    Args:
        frequencies: How many there are, from 0 on.
        step: Largest step, in frequencies.
        device: Where the indices are to be.

    Example:
        >>> chosen_nodes(28, 3.0, torch.device("cpu")).tolist()
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 18, 19, 21, 22, 24, 25, 27]
    """
    nodes, last = [0], frequencies - 1
    while nodes[-1] < last:
        nodes.append(min(last, nodes[-1] + max(1, int(min(step, nodes[-1] / _FINER)))))
    missing = -len(nodes) % _ALIGNED
    steps = [after - before for before, after in itertools.pairwise(nodes)]
    widest = sorted(range(len(steps)), key=lambda k: -steps[k])[:missing]
    nodes += [nodes[k] + steps[k] // 2 for k in widest if steps[k] > 1]
    return torch.tensor(sorted(nodes), device=device)


@dataclass(frozen=True, eq=False)
class NodeFactors:
    """``A = L D L^H`` at a few frequencies, the nodes.

    Attributes:
        nodes: (N,) which frequencies, ascending.
        upper: (K, b, n, 2 N) real and imaginary parts of the rows of ``L^H`` right of the diagonal, for n windows.
        inverse: (K, n, N) diagonal of the inverse of D.
    """

    nodes: Tensor
    upper: Tensor
    inverse: Tensor

    @classmethod
    def of(cls, nodes: Tensor, factor: BandedFactor, segments: Segments) -> "NodeFactors":
        """From factors (R + b, 2 b + 1, n N) of windows of rows."""
        upper = factor.skewed[: segments.size, factor.width + 1 :].unflatten(-1, (-1, len(nodes)))
        inverse = factor.inverse.real if factor.inverse.is_complex() else factor.inverse
        upper, inverse = segments.join(upper), segments.join(inverse.unflatten(-1, (-1, len(nodes))))
        return cls(nodes, torch.view_as_real(upper).flatten(-2)[:, :, None], inverse[:, None])

    def in_segments(self, segments: Segments) -> "NodeFactors":
        """The factors of all rows as those of windows of rows."""
        return NodeFactors(self.nodes, segments.split(self.upper[:, :, 0]), segments.split(self.inverse[:, 0]))

    def between(self, first: int, last: int) -> tuple[Mixture, Mixture]:
        """How the factors of S frequencies ``first`` ... ``last - 1`` follow from those at the nodes.

        Returns:
            For ``L^H`` and the inverse of D, block by block of frequencies: which columns of the nodes' values count,
            which columns (2 S) they make, and the matrix that turns the former into the latter: real and imaginary
            parts into interleaved ones, conjugated, and values into pairs (value, -value).
        """
        chosen = torch.arange(first, last, device=self.nodes.device)
        above = torch.searchsorted(self.nodes, chosen).clamp(min=1)
        bounds = above.tolist()
        uppers: Mixture = []
        inverses: Mixture = []
        for k, stop in _blocks(bounds):
            few = slice(bounds[k] - 1, bounds[stop - 1] + 1)
            places = self.nodes[few].to(torch.float64)
            here = chosen[k:stop].to(torch.float64)
            rising = (here - places[:-1, None]) / places.diff()[:, None]
            hat = torch.minimum(
                torch.cat([torch.ones_like(rising[:1]), rising]), torch.cat([1 - rising, torch.ones_like(rising[:1])])
            )
            weights = hat.clamp(min=0).to(self.inverse.dtype)  # (nodes, systems)
            pairs = torch.stack([weights, torch.zeros_like(weights)], dim=-1)
            conjugated = torch.stack([pairs, -pairs.flip(-1)], dim=1).flatten(0, 1).flatten(-2)
            signed = torch.stack([weights, -weights], dim=-1).flatten(-2)
            both, many = slice(2 * few.start, 2 * few.stop), slice(2 * k, 2 * stop)
            uppers.append((both, many, conjugated))
            inverses.append((few, many, signed))
        return uppers, inverses


class SubstitutionMemory:
    """Memory for solving systems with interpolated factors, with views of every step: made once, for many systems.

    ``L^H`` and D are as smooth in the frequency as A is. Linear interpolation between nodes spares the elimination of
    all other systems, which takes half the width of the band times as long as solving with its factors. These are not
    kept either: interpolating them twice takes less time than fetching them from memory.

    Args:
        rows: Rows K of the largest systems.
        width: Half-width b of the band, at least 1.
        right_sides: Right sides M of each system.
        windows: Windows n of rows, solved side by side.
        systems: Systems S of each window.
        like: A tensor of the dtype and on the device of the systems.

    Attributes:
        right_side: (K, M, n S), the first rows of which are to hold the right sides.
    """

    @making_views()
    def __init__(self, rows: int, width: int, right_sides: int, windows: int, systems: int, like: Tensor) -> None:
        self._sizes = (width, right_sides, windows, systems)
        self._step = min(_ROWS.get(like.device.type, rows), rows)
        batch = windows * systems
        # rows before the first and after the last, so that every run of rows is one view
        sides = like.new_zeros(rows + 2 * width, right_sides, batch)
        runs = runs_of_rows(sides, width)
        self.right_side = sides[width : rows + width]
        self._values = self.right_side.unbind()
        self._before, self._after = runs[:rows], runs[width + 1 :]
        upper = like.new_zeros(self._step + width, width, batch)
        line, entry = upper.stride(0), upper.stride(1)
        skewed = (self._step, width, 1, batch)
        self._rows = upper[width:, :, None].unbind()
        self._columns = upper.as_strided(skewed, (line, line - entry, entry, 1), (width - 1) * entry).unbind()
        self._upper = torch.view_as_real(upper.unflatten(-1, (windows, systems))).flatten(-2)
        self._inverse = like.real.new_empty(self._step, windows, 2 * systems)

    def holds(self, rows: int, width: int, right_sides: int, windows: int, systems: int) -> bool:
        """Whether such systems can be solved in it."""
        return self._sizes == (width, right_sides, windows, systems) and len(self._values) >= rows

    def solve(self, factors: NodeFactors, between: tuple[Mixture, Mixture]) -> Tensor:
        """Solve the systems whose right sides the memory holds.

        Args:
            factors: At the nodes.
            between: How those of all systems follow from them.

        Returns:
            The solutions, **conjugated**: a part of ``right_side``.
        """
        rows, width = len(factors.inverse), self._sizes[0]
        uppers, inverses = between
        blocks = runs(rows, self._step)
        for block in blocks:
            count = block.stop - block.start
            _mix(factors.upper[block], uppers, self._upper[width : width + count])
            subtract_products(self._after[block], self._rows[:count], self._values[block])
            inverse = self._inverse[:count]
            _mix(factors.inverse[block], inverses, inverse)
            values = torch.view_as_real(self.right_side[block]).flatten(-2)
            values.mul_(inverse.flatten(1)[:, None])  # which conjugates, too
        for block in reversed(blocks):
            count = block.stop - block.start
            above = max(block.start - width, 0)  # columns reach that far up
            first = width - (block.start - above)
            self._upper[:first] = 0
            _mix(factors.upper[above : block.stop], uppers, self._upper[first : width + count])
            back = slice(block.stop - 1, block.start - 1 if block.start else None, -1)
            subtract_products(self._before[back], self._columns[:count][::-1], self._values[back])
        return self.right_side[:rows]


def _blocks(above: list[int]) -> Iterator[tuple[int, int]]:
    """Blocks of systems that lie below the nodes ``above``, first and last + 1: smaller where nodes lie close."""
    start = 0
    while start < len(above):
        size = _BLOCK
        while size > _LEAST and above[min(start + size, len(above)) - 1] - above[start] > _NODES:
            size //= 2
        stop = min(start + size, len(above))
        yield start, stop
        start = stop


def _mix(nodes: Tensor, mixture: Mixture, out: Tensor) -> None:
    """Values (..., 2 S) of all systems from those at the nodes."""
    nodes, out = nodes.flatten(0, -2), out.flatten(0, -2)
    for few, many, matrix in mixture:
        torch.mm(nodes[:, few], matrix, out=out[:, many])
