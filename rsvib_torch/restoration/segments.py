"""Rows of banded systems in overlapping segments, solved side by side instead of one after the other."""

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Segments"]

OVERLAP = 96  # rows on either side: what lies further away does not matter to 1e-5


@dataclass(frozen=True)
class Segments:
    """A split of K rows into windows that overlap.

    What a row of the solution depends on fades exponentially with the distance. So the rows of each segment are solved
    together with ``overlap`` rows on either side, which are then dropped; all segments are one batch. On a GPU, where
    a step costs the same whether one segment takes it or many, that is as many times faster; on a CPU the overlap
    costs time.

    Attributes:
        rows: K.
        count: Number of segments.
        overlap: Rows solved beyond either end of a segment.
    """

    rows: int
    count: int = 1
    overlap: int = OVERLAP

    @property
    def whole(self) -> bool:
        """Whether there is nothing to split."""
        return self.count <= 1 or self._window >= self.rows

    @property
    def _own(self) -> int:
        return -(-self.rows // self.count)

    @property
    def _window(self) -> int:
        return self._own + 2 * self.overlap

    def _starts(self, device: torch.device) -> Tensor:
        first = torch.arange(self.count, device=device) * self._own - self.overlap
        return first.clamp(min=0, max=self.rows - self._window)

    def split(self, values: Tensor) -> Tensor:
        """Rows (K + x, N, S) as windows (R, N, segments S)."""
        if self.whole:
            return values
        index = self._starts(values.device)[:, None] + torch.arange(self._window, device=values.device)
        return values[index].permute(1, 2, 0, 3).flatten(2)

    def split_band(self, full: Tensor) -> Tensor:
        """Skewed bands (K + b, 2 b + 1, S) as those of all windows (R + b, 2 b + 1, segments S)."""
        if self.whole:
            return full
        windows = self.split(full)
        return torch.cat([windows, windows.new_zeros(full.shape[1] // 2, *windows.shape[1:])])

    def join(self, windows: Tensor) -> Tensor:
        """Windows (R, N, segments S) back to rows (K, N, S)."""
        if self.whole:
            return windows
        row = torch.arange(self.rows, device=windows.device)
        segment = row // self._own
        joined: Tensor = windows.unflatten(2, (self.count, -1))[row - self._starts(windows.device)[segment], :, segment]
        return joined
