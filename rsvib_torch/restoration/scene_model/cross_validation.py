"""Strength of the prior by generalised cross-validation, at a sample of the rows and frequencies of the frames."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.core.banded_solver import BandedFactor, factor_banded
from rsvib_torch.core.fourier import squared_modulus, waves
from rsvib_torch.restoration.scene_model.observation import RowKernels, SmoothBand, smooth_band, smooth_kernels
from rsvib_torch.restoration.scene_model.scene_prior import ORDER, RowPrior

__all__ = ["Explained", "SampledRows", "StrengthCache", "prior_strength", "sample_rows", "select_strength"]

_SLAB_ROWS = 128  # rows solved side by side, each slab by itself: enough for the dependence on distant rows to vanish


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


def sample_rows(images: Tensor, kernels: RowKernels, chosen: Tensor, slab_rows: int = _SLAB_ROWS) -> SampledRows:
    """Spectra of tapered rows at a few frequencies, in slabs of rows.

    Args:
        images: (M, C, R, W); of up to n - 1 rows more than n slabs of equal height have, none is used.
        kernels: Kernels of their rows.
        chosen: (F,) whole numbers of cycles in W px.
        slab_rows: Rows of a slab.
    """
    slabs = max(1, images.shape[-2] // slab_rows)
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


_STRENGTHS = (2.0, 1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # factors on the prior, from strong to weak


def _cross_validation(explained: Explained, strengths: Tensor) -> int:
    """Index of the strength, of those from strong to weak, selected by generalised cross-validation.

    ``n |r|^2 / (n - freedom)^2`` of Craven and Wahba (1979) estimates the squared error of predicting a pixel from all
    others. The sum over the frequencies is dominated by those with the largest errors; the geometric mean gives all the
    same weight. The weaker of the two selected priors is used, because one that is too weak has the smaller error.
    """
    residual_freedom = explained.count - explained.freedom
    of_sum = explained.power.sum(-1).log() - 2 * residual_freedom.sum(-1).log()
    geometric = (explained.power.log() - 2 * residual_freedom.log()).mean(-1)
    octaves = strengths.log2()
    # strength 1 follows from the noise level: another must reduce the logarithm by this much per octave, weaker or
    # stronger
    handicap = torch.maximum(-0.014 * octaves, 0.002 * octaves)
    return int(torch.maximum((of_sum + handicap).argmin(), (geometric + handicap).argmin()))


@torch.no_grad()
def prior_strength(
    images: Tensor, kernels: RowKernels, prior: RowPrior, noise_power: Tensor, *, certain: bool = True
) -> float:
    """Factor on the prior for restoring one scene.

    The prior is fitted to the power spectrum of the frames minus that of the noise. A weaker one predicts pixels better
    where dense texture is taken for noise, or where the scene differs from its mean spectrum.

    Args:
        images: (M, C, R, W) of one scene, in row order.
        kernels: Kernels of the images.
        prior: Fitted to them.
        noise_power: Variance of the noise of images of weight 1.
        certain: Whether the noise level is given or estimated from several frames. That of a single frame includes
            texture, so that the prior cannot be too weak.

    Returns:
        One of a few factors.
    """
    height, width = images.shape[-2:]
    if min(height, width) < 64:  # too few values for a choice
        return 1.0
    count = min(height, 512)  # rows from the middle
    top = (height - count) // 2
    part = kernels.rows(top, count)
    # 24 frequencies from 0.02 cycles per px, below which the taper mixes them
    chosen = torch.linspace(
        0.02 * width, width // 2, min(24, width // 4), device=images.device, dtype=torch.float32
    ).long()
    place = (chosen.to(torch.float32) / width * 2 * (prior.power.shape[-1] - 1)).round().long()
    sample = sample_rows(images[..., top : top + count, :], part, chosen)
    # less noise than 200 times the interpolation error of the kernel cannot be distinguished from it
    certain = certain and bool(noise_power > 200.0 * prior.interpolation_power.mean())
    strengths = [strength for strength in _STRENGTHS if certain or strength <= 1]
    precisions = [
        prior.precision(noise_power, strength=strength, blur_reach=kernels.blur_reach)[..., place]
        for strength in strengths
    ]
    return select_strength(strengths, precisions, sample.explain)


def select_strength(
    strengths: list[float], precisions: list[Tensor], explain: Callable[[list[Tensor]], Explained]
) -> float:
    """The strength that cross-validation selects.

    Args:
        strengths: From strong to weak.
        precisions: Of the prior with each strength.
        explain: Residual power and degrees of freedom of the data for some of the precisions.
    """
    first = 3  # weaker priors are rarely selected: they are tried only if the weakest of these is
    tried = explain(precisions[:first])
    choice = _cross_validation(tried, tried.power.new_tensor(strengths[:first]))
    if choice == first - 1:
        tried = tried.joined(explain(precisions[first:]))
        choice = _cross_validation(tried, tried.power.new_tensor(strengths))
    return strengths[choice]


class StrengthCache:
    """Strengths of the prior for the scenes of a stack: those with about the same noise share one."""

    def __init__(self) -> None:
        self._chosen: list[tuple[float, float]] = []

    def of(self, noise: Tensor, choose: Callable[[], float]) -> float:
        """The strength for one scene.

        Args:
            noise: Power of the noise and of the interpolation error.
            choose: Returns the strength; called unless that of a scene with the same power, to 20 %, was chosen before.
        """
        logarithm = float(noise.detach().log())
        for earlier, strength in self._chosen:
            if abs(logarithm - earlier) < 0.2:
                return strength
        self._chosen.append((logarithm, choose()))
        return self._chosen[-1][1]
