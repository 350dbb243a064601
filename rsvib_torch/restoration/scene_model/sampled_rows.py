"""Residuals and degrees of freedom of a scene fitted to frames, at a sample of their rows and frequencies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.core.banded_solver import BandedFactor, factor_banded
from rsvib_torch.core.fourier import squared_modulus, waves
from rsvib_torch.restoration.scene_model.observation import (
    RowKernels,
    SmoothBand,
    smooth_band,
    smooth_kernels,
)
from rsvib_torch.restoration.scene_model.row_prior import ORDER

__all__ = ["Explained", "SampledRows", "sample_rows"]

_SLAB = 128  # rows solved side by side, each slab by itself: enough for the dependence on distant rows to vanish


@dataclass(frozen=True, eq=False)
class Explained:
    """Residuals of fits with n priors, frequency by frequency.

    Attributes:
        power: (n, F) squared residuals of all rows, mean over channels, in units of the noise of one pixel.
        freedom: (n, F) degrees of freedom of the fit.
        count: Rows with a weight above 0.
    """

    power: Tensor
    freedom: Tensor
    count: int

    def joined(self, other: "Explained") -> "Explained":
        """These and the residuals of fits of the same rows with other priors."""
        power, freedom = (torch.cat(pair) for pair in ((self.power, other.power), (self.freedom, other.freedom)))
        return Explained(power, freedom, self.count)


@dataclass(frozen=True, eq=False)
class SampledRows:
    """Rows of M images at F frequencies, in n slabs with K coefficients of the scene each.

    Slabs are fitted independently and in one batch, which takes little longer than one slab.

    Attributes:
        u: (F,) frequencies in cycles per px.
        spectra: (M R, C, F), the phase of each row's middle taken off.
        taps: Kernels (M R, 1, F), one tap after the other.
        base: (M R,) first coefficient of each row's kernel, of n K: one slab after the other.
        weight: (M R, 1, 1) weight of each row.
        normal: The normal matrices, one window for each slab.
        energy: Squared norm of the taper, times the number of channels; powers are divided by it.
    """

    u: Tensor
    spectra: Tensor
    taps: list[Tensor]
    base: Tensor
    weight: Tensor
    normal: SmoothBand
    energy: Tensor

    def explain(self, precisions: Sequence[Tensor]) -> Explained:
        """Fit the scene with each of n priors, products (p + 1, p + 1, F) as from ``RowPrior.precision``."""
        number, many = len(precisions), len(precisions) * len(self.u)
        slabs, rows = self.normal.left.shape[2], len(self.normal.left) - self.normal.width
        # n - d log det A / d log s are the degrees of freedom, with the strength s of the prior: a difference quotient
        step = 1.2
        products = torch.cat([*precisions, *(step * products for products in precisions)], dim=-1)
        factor = factor_banded(self.normal.at(self.u.repeat(2 * number), products))
        logs = factor.inverse.log().to(torch.float64).sum(0).neg().unflatten(-1, (slabs, -1)).sum(0)
        growth = (logs[many:] - logs[:many]) / math.log(step)
        right = self.spectra.new_zeros(slabs * rows, *self.spectra.shape[1:])
        for i, tap in enumerate(self.taps):
            right.index_add_(0, self.base + i, tap.conj() * self.spectra * self.weight)
        sides = right.unflatten(0, (slabs, rows)).movedim(0, 2).repeat(1, 1, 1, number).flatten(-2)
        unchanged = (
            values.unflatten(-1, (slabs, -1))[..., :many].flatten(-2) for values in (factor.upper, factor.inverse)
        )
        solved = BandedFactor(*unchanged).solve(sides).unflatten(-1, (slabs, -1))
        fitted = solved.movedim(2, 0).flatten(0, 1).unflatten(-1, (number, -1))
        residual = self.spectra[..., None, :] - sum(
            tap[..., None, :] * fitted[self.base + i] for i, tap in enumerate(self.taps)
        )
        power = (self.weight[..., None] * squared_modulus(residual)).sum((0, 1)).to(torch.float64) / self.energy
        freedom = (slabs * rows - growth).unflatten(-1, (number, -1))
        return Explained(power, freedom, int((self.weight > 0).sum()))


def sample_rows(images: Tensor, kernels: RowKernels, chosen: Tensor) -> SampledRows:
    """Spectra of tapered rows at a few frequencies, in slabs of rows.

    Args:
        images: (M, C, R, W); of up to n - 1 rows more than n slabs of equal height have, none is used.
        kernels: Kernels of their rows.
        chosen: (F,) whole numbers of cycles in W px.
    """
    slabs = max(1, images.shape[-2] // _SLAB)
    height, width = images.shape[-2] // slabs, images.shape[-1]
    count = slabs * height
    images, kernels = images[..., :count, :], kernels.rows(0, count)
    taper = torch.hann_window(width + 2, periodic=False, dtype=images.dtype, device=images.device)[1:-1]
    u = chosen.to(torch.float32) / width
    cycles = torch.arange(width, device=u.device)[:, None] * chosen % width
    angle = (-2 * torch.pi) * cycles.to(torch.float32) / width
    angle = angle.to(torch.float64)
    tapered = (taper[:, None] * torch.cat([angle.cos(), angle.sin()], dim=-1)).to(images.dtype)
    mean = images.mean((-2, -1), keepdim=True)
    spectra = images @ tapered - mean * tapered.sum(0)
    spectra = torch.complex(*spectra.chunk(2, dim=-1)).transpose(1, 2)  # (M, R, C, F)
    spectra = spectra * waves(kernels.middle, -u).to(spectra.dtype)[:, :, None]
    taps = [tap[:, None] for tap in smooth_kernels(kernels, images.dtype).taps(u)]
    slab = torch.arange(count, device=u.device) // height
    place = kernels.first - slab * height
    rows = int(place.amax() - place.amin()) + len(taps)
    apart = replace(kernels, first=place - place.amin() + slab * rows)
    normal = smooth_band(apart, 0, slabs * rows, ORDER, images.dtype)
    return SampledRows(
        u,
        spectra.flatten(0, 1),
        taps,
        apart.first.flatten(),
        kernels.weight.to(images.dtype).flatten()[:, None, None],
        normal.apart(slabs),
        images.shape[1] * taper.square().sum().to(torch.float64),
    )
