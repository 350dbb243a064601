"""Factors of banded systems that change smoothly with frequency, interpolated between a few frequencies."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.banded_solver import BandedFactor, factor_banded

__all__ = ["InterpolatedFactors", "node_frequencies"]


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
