"""Strength of the prior by generalised cross-validation, at a sample of the rows and frequencies of the frames."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.numerics.banded_solver import factor_banded
from rsvib_torch.numerics.fourier import squared_modulus, waves
from rsvib_torch.numerics.tables import Array, table, tables
from rsvib_torch.restoration.scene_model.observation import Observation, RowKernels
from rsvib_torch.restoration.scene_model.scene_prior import RowPrior

_SLAB_ROWS = 128  # rows solved side by side, each slab by itself: enough for the dependence on distant rows to vanish


@dataclass(frozen=True, eq=False)
class SampledRows:
    """Rows of S scenes of M images at F frequencies, in n slabs of each scene, which are scenes of their own."""

    observation: Observation  # of S n slabs
    spectra: Tensor  # (S n, M, C, R, F), the phase of each row's middle taken off
    energy: float  # squared norm of the taper, times the number of channels; powers are divided by it

    def unexplained(self, precisions: Tensor) -> tuple[Array, Array]:
        """Residuals of fits to the scenes with each of n priors, frequency by frequency.

        The priors are products (n, p + 1, p + 1, S, F) as from ``RowPrior.precision``. The results (n, S, F) are the
        squared residuals of all rows, mean over channels, in units of the noise of one pixel; and the number of rows of
        a weight above 0, less the degrees of freedom of the fit.
        """
        observation, spectra = self.observation, self.spectra
        number, scenes, frequencies = len(precisions), precisions.shape[-2], precisions.shape[-1]
        slabs, members = observation.num_scenes // scenes, spectra.shape[1]
        # 1. One system for each prior, slab and frequency. Those with a prior that is stronger by a factor s give the
        # degrees of freedom n - d log det A / d log s: a difference quotient.
        products, step = torch.cat([*precisions], 2).repeat_interleave(slabs, 2), 1.2
        normal = observation.normal(len(products) - 1)
        repeated = replace(normal, left=normal.left.repeat(1, 1, number, 1)).in_windows([slice(0, observation.count)])
        factor, stronger = (
            factor_banded(repeated.at(observation.u, times * products), observation.count) for times in (1.0, step)
        )
        growth = (stronger.log_determinant() - factor.log_determinant()).view(number, scenes, slabs, frequencies)
        freedom = observation.count * slabs - growth.sum(2) / math.log(step)
        # 2. The residuals of the rows with each prior, which are channels of the scenes that are fitted.
        whole = slice(0, frequencies)
        fitted = factor.solve(observation.adjoint(spectra, whole).flatten(2).repeat(1, 1, number))
        fitted = fitted.unflatten(2, (number, observation.num_scenes, frequencies))
        predicted = observation.forward(fitted.flatten(1, 2), whole).unflatten(2, (-1, number))
        weight = observation.kernels.weight.unflatten(0, (-1, members))  # (S n, M, R)
        residual = squared_modulus(spectra[:, :, :, None] - predicted)
        power = torch.einsum("smr,smcnrf->nsf", weight.to(residual.dtype), residual) / self.energy
        counted = (weight > 0).double().sum((1, 2)).view(scenes, slabs).sum(1)
        of_scenes, rest = tables(power.unflatten(1, (scenes, slabs)).sum(2), counted[:, None] - freedom)
        return of_scenes, rest


@torch.no_grad()
def sample_rows(images: Tensor, kernels: RowKernels, chosen: NDArray[np.int64]) -> SampledRows:
    """Spectra of tapered rows of images (S, M, C, R, W) at frequencies (F,), cycles in W px, in slabs of equal height.

    ``kernels`` are those of the rows of S M images. Rows beyond the last slab are not used.
    """
    scenes, members, channels = images.shape[:3]
    slabs = max(1, images.shape[-2] // _SLAB_ROWS)
    height, width = images.shape[-2] // slabs, images.shape[-1]
    images, kernels = images[..., : slabs * height, :], kernels.rows(0, slabs * height)
    # spectra of the rows, minus the mean of the image, with the phase of each row's middle taken off
    taper = np.hanning(width + 2)[1:-1]
    u = torch.from_numpy(chosen / width)
    deviations = (images - images.mean((-2, -1), keepdim=True)) * torch.from_numpy(taper).to(images)
    spectra = torch.fft.rfft(deviations)[..., torch.from_numpy(chosen).to(images.device)]
    phases = waves(-kernels.middle, u.to(images.device)).to(spectra.dtype)
    spectra = spectra * phases.unflatten(0, (scenes, members))[:, :, None]

    def in_slabs(values: Tensor) -> Tensor:
        """(S M, n height, ...) as (S n M, height, ...)."""
        return values.unflatten(1, (slabs, height)).unflatten(0, (scenes, members)).transpose(1, 2).flatten(0, 2)

    # coefficients of a slab count from its first row
    first = kernels.first - height * (torch.arange(slabs * height, device=images.device) // height)
    of_slabs = RowKernels(
        *map(in_slabs, (first, kernels.taps, torch.zeros_like(kernels.middle), kernels.along, kernels.weight))
    )
    observation = Observation(of_slabs, height, width, images.dtype, scenes * slabs).at_frequencies(u, width)
    spectra = spectra.unflatten(3, (slabs, height)).movedim(3, 1).flatten(0, 1)
    return SampledRows(observation, spectra, channels * float((taper**2).sum()))


_STRENGTHS = np.array([2.0, 1.0, 0.5, 0.25, 0.12, 0.06, 0.03])  # factors on the prior, from strong to weak
_TRIED = 4  # of them, first
_FREQUENCIES = 24  # at which rows are sampled
_ROWS = 512  # sampled, from the middle of the frames


@torch.no_grad()
def prior_strengths(
    images: Tensor, kernels: RowKernels, prior: RowPrior, noise_power: Tensor, blur_reach: Tensor, *, certain: bool
) -> NDArray[np.float64]:
    """Factors (S,), of a few, on the prior for restoring S scenes, selected by cross-validation.

    The prior is fitted to the power spectrum of the frames minus that of the noise. A weaker one predicts pixels better
    where dense texture is taken for noise, or where the scene differs from its mean spectrum.

    The images (S, M, C, R, W) are in row order; ``noise_power`` (S, 1) is that of images of weight 1. The noise level
    is ``certain`` if it is given or estimated from several frames: that of a single frame includes texture, so that the
    prior cannot be too weak.
    """
    height, width = images.shape[-2:]
    if min(height, width) < 64:  # too few values for a choice
        return np.ones(len(images))
    # 1. Fits with the prior at all strengths, at 24 frequencies from 0.02 cycles per px, below which the taper mixes
    # them.
    count = min(height, _ROWS)
    top = (height - count) // 2
    number = min(_FREQUENCIES, width // 4)
    chosen = np.linspace(0.02 * width, width // 2, number, dtype=np.float32).astype(np.int64)
    sample = sample_rows(images[..., top : top + count, :], kernels.rows(top, count), chosen)
    place = torch.from_numpy(np.rint(chosen / width * 2 * (prior.power.shape[-1] - 1)).astype(np.int64))
    at = RowPrior(*(values[..., place.to(values.device)] for values in vars(prior).values()))
    # 2. A stronger prior is allowed only if the noise level is certain, and can be distinguished from the interpolation
    # error of the kernel. The strongest priors are tried first, and all only if the weakest of them is selected.
    above = table(noise_power)[:, 0] > 200.0 * table(prior.interpolation_power.mean((1, 2)))
    allowed = (above & certain) | (_STRENGTHS[:, None] <= 1.0)
    octaves = np.log2(_STRENGTHS)[:, None]
    # strength 1 follows from the noise level: another must reduce the logarithm by this much per octave, weaker or
    # stronger
    handicap = np.maximum(-0.014 * octaves, 0.002 * octaves)
    selected = np.full(len(images), _TRIED - 1)
    for tried in (_TRIED, len(_STRENGTHS)):
        open_scenes = selected == _TRIED - 1
        if not open_scenes.any():
            break
        # ``n |r|^2 / (n - freedom)^2`` of Craven and Wahba (1979) estimates the squared error of predicting a pixel
        # from all others. The sum over the frequencies is dominated by those with the largest errors; the geometric
        # mean gives all the same weight. The weaker of the two selected priors is used, as it has the smaller error.
        precisions = [at.precision(noise_power, strength, blur_reach) for strength in _STRENGTHS[:tried].tolist()]
        power, rest = sample.unexplained(torch.stack(precisions))
        with np.errstate(divide="ignore", invalid="ignore"):
            of_sum = np.log(power.sum(-1)) - 2 * np.log(rest.sum(-1))
            geometric = (np.log(power) - 2 * np.log(rest)).mean(-1)
        criteria = (np.where(allowed[:tried], values + handicap[:tried], np.inf) for values in (of_sum, geometric))
        selected = np.where(open_scenes, np.maximum(*(criterion.argmin(0) for criterion in criteria)), selected)
    return _STRENGTHS[selected]
