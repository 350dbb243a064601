"""One scene, the frames that see it, and what it is like: all that a restoration has to solve."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.restoration.exact.partition import Partition
from rsvib_torch.restoration.exact.scene_solver import SceneSolver
from rsvib_torch.restoration.scene_model.observation import SeenScene

__all__ = ["SceneProblem"]


@dataclass(frozen=True, eq=False)
class SceneProblem:
    """One scene, seen by M frames.

    Attributes:
        data: (M, C, R, L) rows continued to a period.
        seen: How the frames see it.
        precision: What it is like, products as from ``RowPrior.precision``.
        level: Standard deviation of the noise of data of weight 1.
        partition: What is solved at a time.
    """

    data: Tensor
    seen: SeenScene
    precision: Tensor
    level: Tensor
    partition: Partition

    def solver(self, weight: Tensor | None = None, *, keep: bool = False) -> SceneSolver:
        """The fast solver, if all data had been measured.

        Args:
            weight: (M, R) of the rows, by default that of the kernels.
            keep: Keep the factors, for solving again and again.
        """
        seen = self.seen if weight is None else self.seen.weighted(weight)
        return SceneSolver(seen, self.precision, self.data.shape[-1], self.partition, keep=keep)

    def precision_at(self, length: int) -> Tensor:
        """The precision for rows continued to another period."""
        flat = self.precision.flatten(0, 1)[None]
        resampled = torch.nn.functional.interpolate(flat, length // 2 + 1, mode="linear", align_corners=True)
        precision: Tensor = resampled[0].unflatten(0, self.precision.shape[:2])
        return precision
