"""What registration tells the fit: displacements of scene rows between frames, with no image left."""

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

__all__ = ["Measurements"]

_SMALL = 0.1  # of the median residual: below it, sizes count as equal
_TUNING = 6.0  # of Tukey's biweight: 98 % efficient for Gaussian errors


@dataclass(frozen=True, eq=False)
class Measurements:
    """Displacements of scene rows in the frames of a batch of stacks, in row order.

    Every scene row n is seen in a group of G frames (two of them make an offset). Where the scene itself lies is
    unknown, so only differences within a group count: displacements have their mean over the group taken out, and so
    has every model that is held against them.

    Attributes:
        moments: (B, N, G) float64 s, exposure start of the row of each frame that shows scene row n.
        displacements: (B, N, G, 2) float64 px, axes (x, y), with zero mean over the frames that see the row; 0 in the
            others.
        seen: (B, N, G) float64, 1 where a frame sees the row, else 0.
        information: (B, N, 2, 2) float64 px^-2, inverse covariance of the displacement in one frame up to a common
            factor; 0 where unknown.
        exposure_time: T_e in seconds.
        average_times: Duration over which each displacement (x, y) is an average: rows of a band times the row time.
        independent: Fraction of the measurements that are independent (bands may overlap).
    """

    moments: Tensor
    displacements: Tensor
    seen: Tensor
    information: Tensor
    exposure_time: float
    average_times: tuple[float, float] = (0.0, 0.0)
    independent: float = 1.0

    @classmethod
    def of_pairs(
        cls,
        starts: Tensor,
        later_starts: Tensor,
        offsets: Tensor,
        information: Tensor,
        exposure_time: float,
        average_times: tuple[float, float] = (0.0, 0.0),
        independent: float = 1.0,
    ) -> "Measurements":
        """Measurements of offsets (B, N, 2) between rows exposed from ``starts`` and ``later_starts`` (B, N) on."""
        return cls(
            torch.stack([starts, later_starts], dim=-1),
            torch.stack([-0.5 * offsets, 0.5 * offsets], dim=-2),
            torch.ones(*starts.shape, 2, dtype=torch.float64, device=starts.device),
            2.0 * information,  # an offset tells of two displacements that are equal and opposite
            exposure_time,
            average_times,
            independent,
        )

    @cached_property
    def _share(self) -> Tensor:
        """(B, N, G) weights of the mean over the frames that see a row."""
        return self.seen / self.seen.sum(2, keepdim=True).clamp(min=1.0)

    @cached_property
    def centre(self) -> Tensor:
        """(B,) mid-time of the record in seconds: phases are fitted there, where they depend least on frequency."""
        return 0.5 * (self.moments.amin((1, 2)) + self.moments.amax((1, 2)) + self.exposure_time)

    @cached_property
    def middles(self) -> Tensor:
        """(B, N, G, 1, 1) mid-exposures in seconds from the centre of the record."""
        return (self.moments + (0.5 * self.exposure_time - self.centre)[:, None, None])[..., None, None]

    @cached_property
    def smearing_times(self) -> Tensor:
        """(2, 1, 2, 1) seconds over which displacements (x, y) are averages: the exposure, the rows of a band."""
        times = [(self.exposure_time, self.exposure_time), self.average_times]
        return torch.tensor(times, dtype=self.moments.dtype, device=self.moments.device)[:, None, :, None]

    @property
    def duration(self) -> Tensor:
        """(B,) seconds from the first to the last row of the record, in any frame but the last of a group."""
        first = self.moments.amin(-1)
        return first.amax(1) - first.amin(1)

    @property
    def weights(self) -> Tensor:
        """(B, N, 2) information of each axis alone."""
        return self.information.diagonal(dim1=-2, dim2=-1)

    @property
    def differences(self) -> Tensor:
        """(B, N) independent differences within each group: one less than the frames that see the row."""
        return (self.seen.sum(-1) - 1).clamp(min=0.0)

    @property
    def known(self) -> Tensor:
        """(B, 2) number of independent measurements of each axis."""
        return ((self.weights > 0) * self.differences[..., None]).sum(1) * self.independent

    def repeated(self, count: int) -> "Measurements":
        """Every stack ``count`` times in a row."""
        tensors = (self.moments, self.displacements, self.seen, self.information)
        moments, displacements, seen, information = (t.repeat_interleave(count, dim=0) for t in tensors)
        return replace(self, moments=moments, displacements=displacements, seen=seen, information=information)

    def in_segments(self, count: int) -> "Measurements":
        """The record cut into ``count`` pieces of equal length, as a batch (B count, N / count, ...)."""
        rows = self.moments.shape[1] // count * count
        tensors = (self.moments, self.displacements, self.seen, self.information)
        cut = (t[:, :rows].unflatten(1, (count, -1)).flatten(0, 1) for t in tensors)
        return replace(self, **dict(zip(("moments", "displacements", "seen", "information"), cut, strict=True)))

    def only(self, counts: Tensor) -> "Measurements":
        """The rows that count (B, N), the others known no more."""
        return self._known_by(self.information * counts[..., None, None])

    def _known_by(self, information: Tensor) -> "Measurements":
        """The same displacements with another information; what follows from their times is not worked out again."""
        result = copy(self)
        object.__setattr__(result, "information", information)
        return result

    def relative(self, values: Tensor) -> Tensor:
        """Values (B, N, G, ...) of every frame less their mean over the frames that see the row, 0 where unseen."""
        ones = (1,) * (values.ndim - 3)
        mean = (self._share.reshape(*self.seen.shape, *ones) * values).sum(2, keepdim=True)
        return self.seen.reshape(*self.seen.shape, *ones) * (values - mean)

    def square(self, residual: Tensor) -> Tensor:
        """(B, 2) weighted sum of squares of residuals (B, N, G, 2), each axis with its share of the cross terms."""
        return torch.einsum("bnga,bnac,bngc->ba", residual, self.information, residual)

    def sizes(self, residual: Tensor) -> Tensor:
        """(B, N, 2) size of residuals (B, N, G, 2) in units of their information; NaN where unknown."""
        return self.distances(residual) * self.weights.sqrt()

    def distances(self, residual: Tensor) -> Tensor:
        """(B, N, 2) size of residuals (B, N, G, 2) in px; NaN where unknown."""
        known = (self.weights > 0) & (self.differences[..., None] > 0)
        square = residual.square().sum(2) / self.differences[..., None].clamp(min=1.0)
        return torch.where(known, square.sqrt(), torch.nan)

    def scaled(self, factor: Tensor) -> "Measurements":
        """The measurements with their information multiplied by factors (B, N, 2) of each axis."""
        root = factor.sqrt()
        return self._known_by(self.information * root[..., :, None] * root[..., None, :])

    def for_least_absolute(self, residual: Tensor) -> "Measurements":
        """Weights that turn a sum of squares into a sum of sizes of the residual: outliers have little pull."""
        size = self.sizes(residual)
        floor = _SMALL * size.nanmedian(dim=1, keepdim=True).values.nan_to_num(1.0) + 1e-12
        return self.scaled(1 / torch.maximum(size.nan_to_num(0.0), floor))

    def reweighted(self, residual: Tensor) -> "Measurements":
        """The measurements with outliers weighed down by Tukey's biweight of their residual, axis by axis."""
        return self.scaled((1 - self._reach(residual).square()).square())

    def share_counted(self, residual: Tensor) -> float:
        """What the rows of ``reweighted`` count for in the variance of a fit, against rows of fixed weight.

        A row that is weighed by its own residual makes the residual look smaller than the error is: the variance of
        an M-estimator is ``E psi^2 / (E psi')^2`` with ``psi = w z``, not ``E w z^2 / E w`` (Huber 1981, ch. 6).
        """
        reach = self._reach(residual)
        weight = (1 - reach.square()).square()
        slope = (1 - reach.square()) * (1 - 5 * reach.square())
        counted, weights, slopes = (reach < 1).sum(), weight.sum(), slope.sum()
        apparent = (weight * reach.square()).sum() / (weights * counted).clamp(min=1e-300)
        actual = (weight * reach).square().sum() / slopes.square().clamp(min=1e-300)
        return min(1.0, float(apparent / actual.clamp(min=1e-300)))

    def _reach(self, residual: Tensor) -> Tensor:
        """(B, N, 2) size of residuals over the largest that counts, 1 from there on and where nothing is known."""
        size = self.sizes(residual)
        spread = 1.4826 * size.nanmedian(dim=1, keepdim=True).values
        return (size / (_TUNING * spread.nan_to_num(1.0).clamp(min=1e-9))).nan_to_num(1.0).clamp(max=1.0)
