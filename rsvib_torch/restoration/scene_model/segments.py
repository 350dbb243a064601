"""Rows of banded systems in overlapping segments, solved side by side instead of one after the other."""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

__all__ = ["Segments"]


@dataclass(frozen=True)
class Segments:
    """A split of K rows into windows of one size that overlap.

    What a row of the solution depends on fades exponentially with the distance. So the rows of each segment are solved
    together with ``overlap`` rows beyond its ends, which are then dropped; all segments are one batch. A step costs
    nearly the same whether it takes one segment or a few, on a GPU even many.

    Attributes:
        rows: K.
        count: Number of segments n.
        overlap: Rows solved beyond either end of a segment.
    """

    rows: int
    count: int = 1
    overlap: int = 0

    @property
    def whole(self) -> bool:
        """Whether there is nothing to split."""
        return self.count <= 1 or self.size >= self.rows

    @property
    def size(self) -> int:
        """Rows R of a window."""
        size = -(-(self.rows + 2 * self.overlap * (self.count - 1)) // self.count)
        return self.rows if self.count <= 1 else min(size, self.rows)

    @property
    def windows(self) -> list[slice]:
        """The rows of each window."""
        if self.whole:
            return [slice(0, self.rows)]
        step = self.size - 2 * self.overlap
        starts = [min(k * step, self.rows - self.size) for k in range(self.count)]
        return [slice(start, start + self.size) for start in starts]

    def split(self, values: Tensor) -> Tensor:
        """Rows (K, ..., S) in windows (R, ..., n, S)."""
        return torch.stack([values[window] for window in self.windows], dim=-2)

    def join(self, windows: Tensor) -> Tensor:
        """Windows (R, ..., n, S) back to rows (K, ..., S)."""
        places = self.windows
        borders = [(before.stop + after.start) // 2 for before, after in pairwise(places)]
        own = pairwise([0, *borders, self.rows])
        return torch.cat(
            [
                windows[first - place.start : last - place.start, ..., k, :]
                for k, ((first, last), place) in enumerate(zip(own, places, strict=True))
            ]
        )
