"""What the rows of frames say of each row of the scene: sums of rows times kernels, ``K^H W g``."""

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.restoration.scene_model.row_system import RowKernels, SmoothKernels

__all__ = ["RowSums", "sum_looked_up"]

_ROWS = {"cpu": 128}  # at a time: they stay in the cache
_SPREAD = 2  # times as many places as the taps ask for, at most


class RowSums:
    """Sums over all rows that see a row of the scene.

    A row of the scene is seen by about as many rows as a kernel has taps. They are looked up, place by place, which is
    several times faster than adding every tap of every row where it belongs. Where a few rows of the scene are seen by
    very many, taps are added all the same.

    Args:
        kernels: How M frames of R rows see the scene.
        smooth: The same at all frequencies.
        top: Index of the scene's first row, in frame coordinates.
        count: Rows K of the scene.
    """

    def __init__(self, kernels: RowKernels, smooth: SmoothKernels, top: int, count: int) -> None:
        real, imaginary = smooth.left.tensor_split(2, dim=-1)
        weight = kernels.weight.to(smooth.left.dtype).flatten()[:, None]
        self.count = count
        self.kernels = SmoothKernels(torch.cat([weight * real, -weight * imaginary], dim=-1), smooth.reach)
        self.base = (kernels.first - top).flatten()
        self._places = self._looked_up(kernels.weight.detach().flatten() > 0)

    def _looked_up(self, counts: Tensor) -> tuple[Tensor, Tensor] | None:
        """Rows (K, Q) that see each scene row, and their kernels (K, Q, 2 Q'); None: too many for some of them."""
        taps, rows, terms = self.kernels.left.shape
        seen = (self.base + torch.arange(taps, device=self.base.device)[:, None])[:, counts].flatten()
        row = torch.arange(rows, device=seen.device).expand(taps, rows)[:, counts].flatten()
        order = seen.argsort(stable=True)
        seen, row = seen[order], row[order]
        numbers = torch.bincount(seen, minlength=self.count)
        most = max(1, int(numbers.amax()))
        if most * self.count > _SPREAD * taps * rows:
            return None
        place = torch.arange(len(seen), device=seen.device) - (numbers.cumsum(0) - numbers)[seen]
        source = seen.new_zeros(self.count, most)
        source[seen, place] = row
        left = self.kernels.left.new_zeros(self.count, most, terms)
        return source, left.index_put((seen, place), self.kernels.left[:, counts].flatten(0, 1)[order])

    def of(self, rows: Tensor, u: Tensor, out: Tensor | None = None) -> Tensor:
        """Sums (K, C, U).

        Args:
            rows: (M R, C, U) spectra, the phase of each row's middle taken off.
            u: (U,) frequencies in cycles per px.
            out: (K, C, U) where to write them; nothing is then differentiated.
        """
        if self._places is None or out is None:
            total = rows.new_zeros(self.count, *rows.shape[1:])
            for i, kernel in enumerate(self.kernels.taps(u)):
                total = total.index_add_(0, self.base + i, kernel[:, None] * rows)
            return total if out is None else out.copy_(total)
        source, left = self._places
        return sum_looked_up(rows, source, left, self.kernels.matrix(u), out)


def sum_looked_up(rows: Tensor, source: Tensor, left: Tensor, matrix: Tensor, out: Tensor) -> Tensor:
    """Sums (N, C, U) over Q of kernels times the rows that they are for, written to ``out``; not differentiated.

    Args:
        rows: (R, C, U) complex.
        source: (N, Q) which of them.
        left: (N, Q, 2 Q') kernels, as in ``SmoothKernels``.
        matrix: (2 Q', 2 U) from that to kernels at U frequencies.
        out: (N, C, U).
    """
    count, most = source.shape
    step = min(_ROWS.get(rows.device.type, count), count)
    kernel = rows.new_empty(step * most, rows.shape[-1])
    looked_up = rows.new_empty(step * most, *rows.shape[1:])
    for part in runs(count, step):
        size = (part.stop - part.start) * most
        torch.mm(left[part].flatten(0, 1), matrix, out=torch.view_as_real(kernel[:size]).flatten(1))
        torch.index_select(rows, 0, source[part].flatten(), out=looked_up[:size])
        looked_up[:size].mul_(kernel[:size, None])
        torch.sum(looked_up[:size].unflatten(0, (-1, most)), 1, out=out[part])
    return out
