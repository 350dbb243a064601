"""The offset curve: what registration measures and detection fits."""

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["OffsetCurve"]


@dataclass(frozen=True, eq=False)
class OffsetCurve:
    """Offsets of row bands between frames.

    The band around row r of the earlier frame is found displaced by the offset in the later frame (displacement in
    the later frame minus that in the earlier one). A batch of stacks leads ``offsets`` and ``quality`` with B.

    Attributes:
        pairs: (P, 2) int64, indices of the earlier and the later frame.
        rows: (N,) float64, centre row of each band in the earlier frame, in read order.
        times: (P, N) float64, exposure start of the centre row in the earlier frame, s; windows of a stack lead it.
        later_times: Same shape, exposure start of the same row in the later frame, s.
        offsets: (..., P, N, 2) float64 px, axes (x, y); NaN where registration failed.
        quality: (..., P, N) float64 in 0 ... 1; correlation of the matched bands, 0 where registration failed.
        heights: Rows averaged for the offset along x and y, (x, y).
    """

    pairs: Tensor
    rows: Tensor
    times: Tensor
    later_times: Tensor
    offsets: Tensor
    quality: Tensor
    heights: tuple[int, int]

    @property
    def good(self) -> Tensor:
        """(..., P, N) bool: bands whose offset is known."""
        return torch.isfinite(self.offsets).all(-1)

    def __getitem__(self, index: int) -> "OffsetCurve":
        """The curve of one stack out of a batch."""
        if self.offsets.ndim == 3:
            raise IndexError("this offset curve is not a batch")
        own = self.times.ndim > 2
        return OffsetCurve(
            self.pairs,
            self.rows,
            self.times[index] if own else self.times,
            self.later_times[index] if own else self.later_times,
            self.offsets[index],
            self.quality[index],
            self.heights,
        )
