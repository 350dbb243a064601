"""How frames see one scene, in the forms that solving asks for."""

from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from rsvib_torch.restoration.scene_model.row_sums import RowSums
from rsvib_torch.restoration.scene_model.row_system import (
    RowKernels,
    SmoothBand,
    SmoothKernels,
    smooth_band,
    smooth_kernels,
)

__all__ = ["SeenScene"]


class SeenScene:
    """Kernels of M frames of R rows, and what follows from them alone: made once for all that is solved with them.

    Args:
        kernels: How the rows see the scene.
        num_rows: R.
        dtype: Of the data.
    """

    def __init__(self, kernels: RowKernels, num_rows: int, dtype: torch.dtype) -> None:
        self.kernels, self.dtype = kernels, dtype
        self.num_rows, self.rows = num_rows, kernels.scene_rows(num_rows)
        self._bands: dict[tuple[int, bool], SmoothBand] = {}

    @cached_property
    def smooth(self) -> SmoothKernels:
        """The kernels at all frequencies."""
        return smooth_kernels(self.kernels, self.dtype)

    @cached_property
    def sums(self) -> RowSums:
        """What rows say of the scene."""
        return RowSums(self.kernels, self.smooth, self.rows.top, self.rows.count)

    def band(self, order: int) -> SmoothBand:
        """Normal matrices to which a prior of an order can be added."""
        key = (order, torch.is_grad_enabled())
        if key not in self._bands:
            width = max(self.kernels.taps.shape[-2] - 1, order)
            self._bands[key] = smooth_band(self.kernels, self.rows, width, order, self.dtype)
        return self._bands[key]

    def weighted(self, weight: Tensor) -> "SeenScene":
        """The same with other weights (M, R) of the rows."""
        return SeenScene(replace(self.kernels, weight=weight), self.num_rows, self.dtype)
