"""Strength of the prior by generalised cross-validation, at a sample of the rows and frequencies of the frames.

The spectra and kernels of the sampled rows are computed on the device of the frames. All else are small tables in NumPy
on the CPU, some scenes in each thread.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from rsvib_torch.execution.chunking import runs
from rsvib_torch.execution.parallel import allowed_threads, in_parallel
from rsvib_torch.numerics.tables import Array, table
from rsvib_torch.restoration.scene_model.observation import RowKernels, prior_diagonals
from rsvib_torch.restoration.scene_model.scene_prior import ORDER, RowPrior, bounded_ratio

_SLAB_ROWS = 128  # rows solved side by side, each slab by itself: enough for the dependence on distant rows to vanish


@dataclass(frozen=True, eq=False)
class Explained:
    """Residuals of fits with n priors to S scenes, frequency by frequency."""

    # (n, S, F) squared residuals of all rows, mean over channels, in units of the noise of one pixel
    power: NDArray[np.float64]
    freedom: NDArray[np.float64]  # (n, S, F) degrees of freedom of the fit
    count: NDArray[np.int64]  # (S,) rows with a weight above 0


@dataclass(frozen=True, eq=False)
class SampledRows:
    """Rows of S scenes of M images at F frequencies, in G = S n slabs of rows with K coefficients of the scene each.

    Slabs are fitted independently and together, which takes little longer than one slab.
    """

    u: NDArray[np.float64]  # (F,) frequencies in cycles per px
    spectra: Array  # (G, M R, C, F), the phase of each row's middle taken off
    taps: Array  # kernels (G, M R, J, F)
    base: NDArray[np.int64]  # (G, M R) first coefficient of each row's kernel, of the K of its slab
    weight: Array  # (G, M R) weight of each row, in the precision of the spectra
    count: int  # K
    slabs: int  # n
    energy: float  # squared norm of the taper, times the number of channels; powers are divided by it

    @cached_property
    def _selection(self) -> csr_array:
        """Sparse matrix (G K, G M R) that adds up rows with the same first coefficient."""
        place = (self.base + self.count * np.arange(len(self.base))[:, None]).ravel()
        ones = np.ones(place.size, self.taps.real.dtype)
        return csr_array((ones, (place, np.arange(place.size))), shape=(len(self.base) * self.count, place.size))

    def _selected(self, values: Array) -> Array:
        """Sums (K, G, ...) of values (G, M R, ...) over the rows with the same first coefficient."""
        total = self._selection @ values.reshape(self.base.size, -1)
        sums: Array = total.reshape(len(self.base), self.count, *values.shape[2:]).swapaxes(0, 1)
        return sums

    def _normal(self, width: int) -> Array:
        """Skewed bands (K + b, 2 b + 1, G, F) of the normal matrices without prior."""
        bands = np.zeros((self.count + width, 2 * width + 1, len(self.base), len(self.u)), self.taps.dtype)
        weighted = self.weight[..., None, None] * self.taps.conj()
        for tap in range(self.taps.shape[2]):
            # A[k, k + d] of all d
            side = self._selected(weighted[:, :, tap, None] * self.taps[:, :, tap:])[: self.count - tap]
            bands[tap : self.count, width : width + side.shape[2]] += side.swapaxes(1, 2)
        for d in range(1, self.taps.shape[2]):
            bands[d : self.count, width - d] = bands[: self.count - d, width + d].conj()
        return bands

    def of_scenes(self, part: slice) -> "SampledRows":
        """The rows of some of the scenes."""
        slabs = slice(part.start * self.slabs, part.stop * self.slabs)
        tables = (self.spectra, self.taps, self.base, self.weight)
        spectra, taps, base, weight = (values[slabs] for values in tables)
        return replace(self, spectra=spectra, taps=taps, base=base, weight=weight)

    def explain(self, precisions: list[Array]) -> Explained:
        """Fit the scenes with each of n priors, products (p + 1, p + 1, S, F) as from ``RowPrior.precision``."""
        scenes = len(self.base) // self.slabs
        parts = runs(scenes, -(-scenes // allowed_threads()))  # 64 scenes, 16 cores: 0.8 of the time of a restoration
        explained = in_parallel(
            lambda part: self.of_scenes(part)._explained([products[:, :, part] for products in precisions]),
            parts,
            torch.device("cpu"),
        )
        power, freedom = (
            np.concatenate([getattr(part, name) for part in explained], 1) for name in ("power", "freedom")
        )
        return Explained(power, freedom, np.concatenate([part.count for part in explained]))

    def _explained(self, precisions: list[Array]) -> Explained:
        """``explain`` of all scenes together."""
        number, groups, frequencies = len(precisions), len(self.base), len(self.u)
        width = max(self.taps.shape[2] - 1, len(precisions[0]) - 1)
        # n - d log det A / d log s are the degrees of freedom, with the strength s of the prior: a difference quotient
        step = 1.2
        products = np.stack([*precisions, *(step * products for products in precisions)], 2).repeat(self.slabs, 3)
        bands = np.repeat(self._normal(width)[:, :, None], 2 * number, 2)  # (K + b, 2 b + 1, 2 n, G, F)
        merged = products.reshape(*products.shape[:2], -1, frequencies)
        _add_row_prior(bands.reshape(*bands.shape[:2], -1, frequencies), merged, self.count, width)
        upper, pivots = _factored(bands.reshape(*bands.shape[:2], -1), self.count)
        logs = np.log(pivots.astype(np.float64)).sum(0).reshape(2, number, groups, frequencies)
        growth = (logs[1] - logs[0]) / math.log(step)
        # right sides, the same for all priors
        right = np.zeros((self.count, *self.spectra.shape[2:3], groups, frequencies), self.spectra.dtype)
        for tap in range(self.taps.shape[2]):
            rows = self.taps[:, :, tap, None].conj() * self.spectra * self.weight[..., None, None]
            side = self._selected(rows)[: self.count - tap].swapaxes(1, 2)
            right[tap : tap + len(side)] += side
        chosen = slice(0, number * groups * frequencies)
        sides = np.repeat(right[:, :, None], number, 2).reshape(*right.shape[:2], -1)
        fitted = _solved(upper[..., chosen], pivots[:, chosen], sides)
        fitted = fitted.reshape(*right.shape[:2], number, groups, frequencies)
        # residuals of the rows of all priors
        group = np.arange(groups)[:, None]
        predicted = sum(
            self.taps[:, :, tap, None, None] * fitted[self.base + tap, :, :, group] for tap in range(self.taps.shape[2])
        )  # (G, M R, C, n, F)
        residual = self.spectra[:, :, :, None] - predicted
        power = residual.real.astype(np.float64) ** 2 + residual.imag.astype(np.float64) ** 2
        power = (self.weight[..., None, None, None] * power).sum((1, 2)) / self.energy
        freedom = (self.count - growth).reshape(number, -1, self.slabs, frequencies).sum(2)
        power = np.moveaxis(power, 1, 0).reshape(number, -1, self.slabs, frequencies).sum(2)
        return Explained(power, freedom, (self.weight > 0).reshape(power.shape[1], -1).sum(1))


def _add_row_prior(bands: Array, precision: Array, rows: int, width: int) -> None:
    """Add the precision (p + 1, p + 1, N, U) of a prior to skewed bands in their memory.

    The bands are (rows + width, 2 width + 1, N, U), of N scenes.
    """
    order = len(precision) - 1
    added = prior_diagonals(order) @ precision.reshape((order + 1) ** 2, -1)
    added = added.reshape(2 * order + 1, 2 * order + 1, *precision.shape[2:])
    near = bands[:rows, width - order : width + order + 1]
    near += added[order]
    # the first and the last rows are predicted from fewer rows
    near[:order] += added[:order]
    near[::-1, ::-1][:order] += added[:order]


def _factored(skewed: Array, count: int) -> tuple[Array, Array]:
    """U (K, b, S) right of the diagonal and D (K, S) of ``A = U^H D U``, as ``core.banded_solver.factor_banded``.

    For the few systems of a sample, the calls of PyTorch would take longer than the arithmetic.
    """
    width = skewed.shape[1] // 2
    line, entry, item = skewed.strides
    upper = skewed[:count, width + 1 :]
    shape = (width, width, skewed.shape[2])
    for j in range(count):
        row = upper[j]
        row /= skewed[j, width]  # its imaginary part, of the size of rounding, would grow from row to row
        # A[i, j] and A[i, k] of the rows below, each of which begins one column further right
        column = as_strided(skewed[j + 1 :, width - 1 :], (width, 1, shape[2]), (line - entry, entry, item))
        rest = as_strided(skewed[j + 1 :, width:], shape, (line - entry, entry, item))
        rest -= column * row
    return upper, skewed[:count, width].real


def _solved(upper: Array, pivots: Array, right: Array) -> Array:
    """Solutions (K, M, S) of ``U^H D U x = right`` for right sides (K, M, S), in the memory of ``right``."""
    count, width = upper.shape[:2]
    x = np.concatenate([right, np.zeros_like(right[:1]).repeat(width, 0)])
    for j in range(count):
        x[j + 1 : j + 1 + width] -= upper[j].conj()[:, None] * x[j]
    x[:count] /= pivots[:, None]
    x[count:] = 0
    for j in range(count - 1, -1, -1):
        x[j] -= (upper[j][:, None] * x[j + 1 : j + 1 + width]).sum(0)
    return x[:count]


@torch.no_grad()
def sample_rows(
    images: Tensor, kernels: RowKernels, chosen: NDArray[np.int64], slab_rows: int = _SLAB_ROWS
) -> SampledRows:
    """Spectra of tapered rows of images (S, M, C, R, W) at frequencies (F,), cycles in W px, in slabs of equal height.

    ``kernels`` are those of the rows of S M images, of a scene one after the other. Rows beyond the last slab are not
    used.
    """
    scenes, members, channels = images.shape[:3]
    slabs = max(1, images.shape[-2] // slab_rows)
    height, width = images.shape[-2] // slabs, images.shape[-1]
    kernels = kernels.rows(0, slabs * height)
    # spectra of the rows, minus the mean of the image
    taper = np.hanning(width + 2)[1:-1]
    angles = -2 * np.pi * (np.arange(width)[:, None] * chosen % width) / width
    tapered = torch.from_numpy(taper[:, None] * np.concatenate([np.cos(angles), np.sin(angles)], 1)).to(images.dtype)
    tapered = tapered.to(images.device)
    mean = images.mean((-2, -1), keepdim=True)
    transformed = (images[..., : slabs * height, :] @ tapered - mean * tapered.sum(0)).cpu().numpy()
    spectra = transformed[..., : len(chosen)] + 1j * transformed[..., len(chosen) :]
    # kernels of the rows at these frequencies
    u = chosen / width
    frequencies = torch.from_numpy(u).to(images.device)
    on_device = kernels.at(frequencies).to(images.dtype.to_complex())  # (S M, R, J, F)
    tables = (on_device, kernels.first, kernels.middle, kernels.weight)
    kernel, first, middle, weight = (values.cpu().numpy() for values in tables)
    phase = np.exp(2j * np.pi * middle[..., None] * u).astype(spectra.dtype)
    spectra = spectra * phase.reshape(scenes, members, 1, -1, len(u))

    def in_slabs(values: Array) -> Array:
        """(S, M, n height, ...) as (S n, M height, ...)."""
        parts = values.reshape(scenes, members, slabs, height, *values.shape[3:])
        return np.moveaxis(parts, 2, 1).reshape(scenes * slabs, members * height, *values.shape[3:])

    kernel, first, weight = (
        in_slabs(values.reshape(scenes, members, *values.shape[1:])) for values in (kernel, first, weight)
    )
    # coefficients of a slab count from the first one of its rows
    place = first - height * np.tile(np.arange(slabs), scenes)[:, None]
    base = place - place.min()
    spectra = in_slabs(np.moveaxis(spectra, 2, 3))
    energy = channels * float((taper**2).sum())
    return SampledRows(
        u, spectra, kernel, base, weight.astype(spectra.real.dtype), int(base.max()) + kernel.shape[2], slabs, energy
    )


def smoothness(scenes: int, frequencies: int, strength: float) -> NDArray[np.float64]:
    """Products (3, 3, S, F) as from ``RowPrior.precision``: correlation 0.9 of neighbouring rows, innovations of 1."""
    products = np.zeros((ORDER + 1, ORDER + 1, scenes, frequencies))
    products[0, 0], products[0, 1], products[1, 0] = strength, strength * 0.9**2, -0.9 * strength
    return products


_STRENGTHS = (2.0, 1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # factors on the prior, from strong to weak
_FREQUENCIES = 24  # at which rows are sampled
_ROWS = 512  # sampled, from the middle of the frames


def _cross_validation(explained: Explained, strengths: tuple[float, ...], allowed: NDArray[np.bool_]) -> Array:
    """Index (S,) of the strength, of those from strong to weak and allowed (n, S), selected by cross-validation.

    ``n |r|^2 / (n - freedom)^2`` of Craven and Wahba (1979) estimates the squared error of predicting a pixel from all
    others. The sum over the frequencies is dominated by those with the largest errors; the geometric mean gives all the
    same weight. The weaker of the two selected priors is used, because one that is too weak has the smaller error.
    """
    residual_freedom = explained.count[:, None] - explained.freedom
    with np.errstate(divide="ignore", invalid="ignore"):
        of_sum = np.log(explained.power.sum(-1)) - 2 * np.log(residual_freedom.sum(-1))
        geometric = (np.log(explained.power) - 2 * np.log(residual_freedom)).mean(-1)
    octaves = np.log2(strengths)[:, None]
    # strength 1 follows from the noise level: another must reduce the logarithm by this much per octave, weaker or
    # stronger
    handicap = np.maximum(-0.014 * octaves, 0.002 * octaves)
    criteria = [np.where(allowed, criterion + handicap, np.inf) for criterion in (of_sum, geometric)]
    index: Array = np.maximum(*(criterion.argmin(0) for criterion in criteria))
    return index


@torch.no_grad()
def prior_strengths(
    images: Tensor,
    kernels: RowKernels,
    prior: RowPrior,
    noise_power: Tensor,
    blur_reach: Array,
    *,
    certain: bool = True,
) -> NDArray[np.float64]:
    """Factors (S,), of a few, on the prior for restoring S scenes.

    The prior is fitted to the power spectrum of the frames minus that of the noise. A weaker one predicts pixels better
    where dense texture is taken for noise, or where the scene differs from its mean spectrum.

    The images (S, M, C, R, W) are in row order; ``noise_power`` (S, 1) is that of images of weight 1, ``blur_reach``
    (S, 1) as in ``RowPrior.precision``. The noise level is ``certain`` if it is given or estimated from several frames:
    that of a single frame includes texture, so that the prior cannot be too weak.
    """
    height, width = images.shape[-2:]
    if min(height, width) < 64:  # too few values for a choice
        return np.ones(len(images))
    count = min(height, _ROWS)
    top = (height - count) // 2
    # 24 frequencies from 0.02 cycles per px, below which the taper mixes them
    number = min(_FREQUENCIES, width // 4)
    chosen = np.linspace(0.02 * width, width // 2, number, dtype=np.float32).astype(np.int64)
    sample = sample_rows(images[..., top : top + count, :], kernels.rows(top, count), chosen)
    place = torch.from_numpy(np.rint(chosen / width * 2 * (prior.power.shape[-1] - 1)).astype(np.int64))
    at = RowPrior(
        *(table[..., place.to(table.device)] for table in (prior.power, prior.reflections, prior.interpolation_power))
    )
    # less noise than 200 times the interpolation error of the kernel cannot be distinguished from it
    above = table(noise_power)[:, 0] > 200.0 * table(prior.interpolation_power.mean((1, 2)))
    products, ratio = at.products().cpu().numpy(), at.ratio(noise_power).cpu().numpy()
    precisions = np.stack([products * bounded_ratio(ratio * strength, blur_reach) for strength in _STRENGTHS])
    return select_strengths(precisions, above & certain, sample.explain)


def select_strengths(
    products: Array, certain: NDArray[np.bool_], explain: Callable[[list[Array]], Explained]
) -> NDArray[np.float64]:
    """The strengths (S,) that cross-validation selects of precisions (n, p + 1, p + 1, S, F) from strong to weak.

    The prior may be stronger than it states where the noise level is ``certain`` (S,). ``explain`` returns residual
    power and degrees of freedom of the data for some of the precisions.
    """
    # a stronger prior is allowed only if the noise level is certain; of those allowed, the three strongest are tried
    # first, and all others only if the weakest of them is selected, which is rare
    order = np.arange(len(products))[:, None]
    allowed = certain | (np.array(_STRENGTHS)[:, None] <= 1.0)
    last = np.where(certain, 2, 3)
    first = int(last.max()) + 1
    tried = explain(list(products[:first]))
    choice = _cross_validation(tried, _STRENGTHS[:first], (allowed & (order <= last))[:first])
    if bool((choice == last).any()):
        others = explain(list(products[first:]))
        power, freedom = (
            np.concatenate([getattr(tried, name), getattr(others, name)]) for name in ("power", "freedom")
        )
        of_all = _cross_validation(Explained(power, freedom, tried.count), _STRENGTHS, allowed)
        choice = np.where(choice == last, of_all, choice)
    strengths: NDArray[np.float64] = np.array(_STRENGTHS)[choice]
    return strengths
