"""Gaussian prior of scenes on the pixel grid: an autoregressive model across rows, fitted to power spectra of frames.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.numerics.banded_solver import factor_banded
from rsvib_torch.numerics.interpolation import extend_rows, squared_modulus, waves
from rsvib_torch.numerics.tables import Array, constant, tables, without_nan
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.observation import Observation, RowKernels, kernel_spectrum

ORDER = 2  # rows that a row is predicted from
_TINY = float(np.finfo(np.float32).tiny)  # smallest power


@dataclass(frozen=True, eq=False)
class RowPrior:
    """Autoregressive model of the coefficients of the scene rows s, one for each horizontal frequency of N scenes.

    ``c(s) = - a_1 c(s - 1) - ... - a_p c(s - p) + e(s)`` with white ``e``: a stationary process, whose precision
    matrix is banded.
    """

    power: Tensor  # (N, U) variance of a coefficient over the number of columns: that of white noise of variance 1 is 1
    reflections: Tensor  # (2, N, U) partial correlations, within -1 ... 1
    # (N, T, U) power of the interpolation error between rows, which counts as noise, of each frame
    interpolation_power: Tensor

    def of(self, stacks: Tensor, members: Tensor) -> "RowPrior":
        """The priors of scenes restored from frames ``members`` (S, M) of ``stacks`` (S,)."""
        return RowPrior(
            self.power[stacks], self.reflections[:, stacks], self.interpolation_power[stacks[:, None], members]
        )

    def products(self) -> Tensor:
        """Products ``a_k a_(k + d)`` of the whitening filter 1, a_1 ... a_p, (p + 1, p + 1, N, U), 0 for k + d > p.

        The precision of interior rows at distance d is the sum over k. The first and the last rows are predicted from
        fewer rows: for row j it is the sum of the first j + 1 products.
        """
        first, second = self.reflections
        a = torch.stack([torch.ones_like(first), -first * (1 - second), -second])
        later = functional.pad(a, (0, 0, 0, 0, 0, ORDER)).unfold(0, len(a), 1)  # a_(k + d), (d, N, U, k)
        return a * later.movedim(-1, 1)

    def resampled(self, count: int) -> "RowPrior":
        """The prior at ``count`` frequencies spread over the same range."""
        parts = [self.power.log()[:, None], self.reflections.movedim(0, 1), self.interpolation_power.log()]
        stacked = functional.interpolate(torch.cat(parts, 1), count, mode="linear", align_corners=True)
        power, reflections, interpolation = stacked.split([part.shape[1] for part in parts], 1)
        return RowPrior(power[:, 0].exp(), reflections.movedim(1, 0), interpolation.exp())

    def precision(
        self, noise_power: Tensor, strength: Tensor | float = 1.0, blur_reach: Tensor | float = 0.0
    ) -> Tensor:
        """``products`` in units of the data's noise, (N, 1) the variance for data of weight 1.

        ``blur_reach`` is the largest distance along the row in px during an exposure from its middle; it and
        ``strength``, a factor on the precision, are numbers or (N, 1).
        """
        # above 1e3, the systems lose digits in single precision without a gain; below 1e-4, rows displaced by half a
        # pixel lose them. Long exposures observe every place from many rows, and allow a lower bound by the length of
        # the blur in px
        innovation = self.power * (1 - self.reflections.square()).prod(0)
        ratio = (noise_power + self.interpolation_power.mean(1)) / innovation * strength
        lowest = torch.as_tensor(1e-4 / (1 + blur_reach), dtype=ratio.dtype, device=ratio.device)
        return self.products() * ratio.maximum(lowest).clamp(max=1e3)


def _mixing(count: int, weights: Sequence[float], fold: Callable[[Array], Array]) -> Array:
    """Matrix (U, U) of a weighted mean over neighbouring frequencies, whose indices are folded at both ends."""
    matrix = np.zeros((count, count))
    for step, weight in enumerate(weights, -(len(weights) // 2)):
        np.add.at(matrix, (np.arange(count), fold(np.arange(count) + step)), weight)
    return matrix


Values = TypeVar("Values", Array, Tensor)


def autoregressive_prior(
    observed: Values, transfer: Values, aliases: Values, noise_power: Values
) -> tuple[Values, Values, Values, Values]:
    """Fit the prior to the power spectrum of blurred, noisy frames by expectation maximisation.

    Each step computes the expected power spectrum of the scene for the current model, the sum of the squared Wiener
    estimate and of its variance, and fits the autoregressive model to it (Yule-Walker equations). ``observed`` (N, U,
    V) is the power of the frames, ``transfer`` that of the blur, and ``noise_power`` that of the noise. ``aliases`` (N,
    T, U, V) is the power of the interpolation error of the kernel between rows, through the blur of each frame, for a
    wave of power 1. The results are the power, both reflections and the interpolation power of ``RowPrior``. Arrays
    take half of the time of tensors, through which gradients flow.
    """
    _, U, V = observed.shape
    matrices = (
        # cosines of the lags of autocovariances (V, p + 1), and the pooling of the lags over neighbouring frequencies
        np.cos(2 * np.pi * np.fft.fftfreq(V)[:, None] * np.arange(ORDER + 1)),
        _mixing(U, (0.25, 0.5, 0.25), lambda u: np.minimum(np.abs(u), 2 * (U - 1) - np.abs(u))) / V,
        # means over 5 x 5 neighbouring frequencies
        _mixing(U, (0.2,) * 5, lambda u: u.clip(0, U - 1)),
        _mixing(V, (0.2,) * 5, lambda v: v % V),
    )
    cosine, pooling, around_u, around_v = (
        torch.from_numpy(matrix).to(observed) if isinstance(observed, Tensor) else matrix for matrix in matrices
    )
    # steps are small where the noise is stronger than the scene: below half of the noise power, the initial value is
    # pooled over neighbouring frequencies, as that of a single one depends on chance
    excess, level = observed - noise_power, 0.5 * noise_power
    pooled = (around_u @ excess @ around_v.T).clip(None, level)
    excess = excess + (excess < level) * (pooled - excess)
    scene = excess.clip(0.002 * noise_power, None) * transfer / (transfer * transfer + 1e-2)
    through = transfer * observed
    for _ in range(20):
        # the model of the expected spectrum of the scene: Levinson recursion for its autocovariances
        moments = pooling @ (scene @ cosine)
        power = moments[..., 0].clip(_TINY, None)
        first = (moments[..., 1] / power).clip(-0.9995, 0.9995)
        variance = power * (1 - first * first)
        second = ((moments[..., 2] - first * moments[..., 1]) / variance).clip(-0.9995, 0.9995)
        innovation = variance * (1 - second * second)
        # squared modulus of the filter, whose terms are of order 1: at least their rounding error
        a1, a2 = (-first * (1 - second))[..., None], -second[..., None]
        modulus = 1 + a1 * a1 + a2 * a2 + 2 * a1 * (1 + a2) * cosine[:, 1] + 2 * a2 * cosine[:, 2]
        penalty = modulus.clip(1e-14, None) * (noise_power / innovation[..., None])
        # the expected spectrum for this model: variance and square of the Wiener estimate
        gain = 1.0 / (penalty + transfer)
        scene = gain * noise_power + gain * gain * through
    interpolation = (scene[:, None] * aliases).mean(-1)
    return power, first, second, interpolation.clip(_TINY, None)


def brightness(frames: Tensor) -> Tensor:
    """Approximate mean of each image (..., H, W), from every eighth row."""
    return frames[..., ::8, :].mean((-2, -1))


@dataclass(frozen=True, eq=False)
class ObservedSpectrum:
    """Power spectra of pieces of the frames of N stacks, whose rows were moved back by their displacement."""

    u: Tensor  # (U,) horizontal frequencies, cycles per px
    v: Tensor  # (V,) vertical frequencies
    power: Tensor  # (N, T, pieces, U, V) power per pixel: white noise of variance 1 has power 1
    whole: Tensor  # (N, U, V) of whole rows with their boundary extension
    displacement: Tensor  # (N, T, pieces, nodes, 2) px during the exposure of the middle row of each piece
    node_weights: Tensor  # (nodes,)
    levels: Tensor  # (N, T) standard deviation of the noise of each frame, infinite for those that do not count

    def blur(self, u: Tensor, v: Tensor) -> Tensor:
        """Squared transfer functions (N, T, pieces, U, V) of the exposures at frequencies u and v."""
        along = waves(self.displacement[..., 0], u) * self.node_weights[:, None]
        return squared_modulus(along.mT @ waves(self.displacement[..., 1], v))

    def weighted(self, transfer: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Observed power (N, U, V), weights (N, T, pieces, U, V) of sum 1, and power (N, U, V) of the noise.

        Pieces with a stronger squared ``transfer`` and less noise weigh more.
        """
        levels = self.levels.to(torch.float64).view(*self.levels.shape, 1, 1, 1)
        weight, transfer = transfer / levels.square(), torch.where(levels.isinf(), 0.0, transfer)
        total = weight.sum((1, 2)).clamp(min=_TINY)
        # power of whole rows above 25 times that of the pieces is due to the boundary extension and not to chance:
        # without it, regular patterns are lost near the ends of the rows
        observed = torch.maximum((weight * self.power).sum((1, 2)) / total, self.whole / 25.0)
        return observed, weight / total[:, None, None], transfer.sum((1, 2)) / total


def taper(count: int) -> Array:
    """Hann window (count,), under which the power of white noise is its variance."""
    window = np.hanning(count + 2)[1:-1]
    return window / np.linalg.norm(window)


_PIECE = (64, 256)  # px, rows and columns of the pieces
_PIECES = 128  # of a frame, at most


def observed_spectrum(frames: Tensor, motion: FrameMotion, levels: Tensor, length: int) -> ObservedSpectrum:
    """Power spectra of pieces of 64 x 256 px of frames (N, T, C, H, W) with noise levels (N, T).

    Rows are moved back by their displacement, so that neighbours correlate as in the scene. ``length`` is that of the
    Fourier transform along rows.
    """
    # places of the pieces, which overlap by half if possible, their tapers and frequencies
    shape = frames.shape[-2:]
    size = (min(_PIECE[0], shape[0]), min(_PIECE[1], shape[1]))
    counts = [-(-2 * (whole - extent) // extent) + 1 for whole, extent in zip(shape, size, strict=True)]
    excess = max(1.0, math.sqrt(counts[0] * counts[1] / _PIECES))
    tops, lefts = (
        np.rint(np.linspace(0, whole - extent, max(1, round(count / excess)))).astype(np.int64)
        for whole, extent, count in zip(shape, size, counts, strict=True)
    )
    tapers = [constant(taper, extent, dtype=frames.dtype, device=frames.device) for extent in size]
    u = constant(np.fft.rfftfreq, size[1], dtype=torch.float64, device=frames.device)
    v = constant(np.fft.fftfreq, size[0], dtype=torch.float64, device=frames.device)

    # phases that move rows back by their displacement, and the taper across rows
    displacement, node_weights = motion.exposures
    rows, columns = (
        torch.as_tensor(starts[:, None] + np.arange(extent), device=frames.device)
        for starts, extent in zip((tops, lefts), size, strict=True)
    )
    mean = (displacement[:, :, rows, :, 0] * node_weights).sum(-1)
    back = waves(mean, -u).to(frames.dtype.to_complex()) * tapers[0][:, None]  # (N, T, n, rows, U)
    # power of the pieces, mean over channels and columns of pieces, some rows of pieces at a time
    bright = brightness(frames).view(*frames.shape[:3], 1, 1, 1)
    piece_bytes = 8 * frames[..., 0, 0].numel() * len(lefts) * size[0] * size[1]
    step = at_once(piece_bytes, frames.device, cpu_bytes=2**24)
    powers = []
    for part in runs(len(tops), step):
        pieces = frames[..., rows[part, None, :, None], columns[:, None]]  # (N, T, C, n, m, rows, columns)
        spectra = torch.fft.rfft(pieces.sub_(bright[..., None]).mul_(tapers[1])).mul_(back[:, :, None, part, None])
        powers.append(squared_modulus(torch.fft.fft(spectra, dim=-2)).mean((2, 4)).transpose(-2, -1))
    power = torch.cat(powers, dim=2).to(torch.float64)
    # Power of a few strips of whole rows with their boundary extension, pooled to the frequencies of the pieces. Rows
    # are not moved back by their displacement: it does not matter at the low frequencies of the extension.
    few = np.rint(np.linspace(0, len(tops) - 1, min(4, len(tops)))).astype(np.int64)
    strips = extend_rows((frames[..., rows[few], :] - bright) * tapers[0][:, None], length)  # (N, T, C, n, rows, L)
    of_strips = squared_modulus(torch.fft.fft(torch.fft.rfft(strips), dim=-2)).mean((1, 2, 3))
    whole = functional.adaptive_avg_pool1d(of_strips, len(u)).mT.to(torch.float64) / length
    # blur of the middle row of each piece
    return ObservedSpectrum(u, v, power, whole, displacement[:, :, rows[:, size[0] // 2]], node_weights, levels)


def fit_prior(frames: Tensor, motion: FrameMotion, levels: Tensor, length: int) -> RowPrior:
    """Fit the priors to the frames of N stacks: to their ``observed_spectrum``, whose arguments it has."""
    spectrum = observed_spectrum(frames, motion, levels, length)
    # blur at the vertical frequencies, and at those of the two strongest aliases across rows: all others together have
    # less than 4 % of their power
    v = spectrum.v + torch.tensor([[0.0], [-1.0], [1.0]], dtype=spectrum.v.dtype, device=spectrum.v.device)
    blur, power = spectrum.blur(spectrum.u, v.flatten()).unflatten(-1, (3, -1)), kernel_spectrum(v).square()
    transfer = blur[..., 0, :] * power[0]
    aliases: Tensor = (blur[..., 1:, :].mean(2) * power[1:]).sum(-2)
    observed, weight, noise = spectrum.weighted(transfer)
    passed: Tensor = (weight * transfer).sum((1, 2))
    spectra = observed, passed, aliases, noise
    differentiable = torch.is_grad_enabled() and (observed.requires_grad or passed.requires_grad)
    fitted = autoregressive_prior(*spectra) if differentiable else autoregressive_prior(*tables(*spectra))
    power, first, second, interpolation = (torch.as_tensor(values, device=frames.device) for values in fitted)
    return RowPrior(power, torch.stack([first, second]), interpolation).resampled(length // 2 + 1)


@torch.no_grad()
def unexplained(
    images: Tensor, kernels: RowKernels, cycles: NDArray[np.int64], precisions: Tensor
) -> tuple[Array, Array]:
    """Residuals of fits to S scenes of images (S, M, C, R, W) with each of some priors, frequency by frequency.

    ``kernels`` are those of the rows of S M images; the frequencies ``cycles`` (F,) are in cycles in W px. The priors P
    are products (p + 1, p + 1, P S, F) as from ``RowPrior.precision``, of all scenes one after the other. The results
    (P, S, F) are the squared residuals of all rows, mean over channels, in units of the noise of one pixel; and the
    number of rows of a weight above 0, less the degrees of freedom of the fit.
    """
    scenes, members, channels, height, width = images.shape
    # 1. Spectra of the tapered rows, minus the mean of the image, with the phase of each row's middle taken off.
    taper = np.hanning(width + 2)[1:-1]
    u = torch.from_numpy(cycles / width)
    deviations = (images - images.mean((-2, -1), keepdim=True)) * torch.from_numpy(taper).to(images)
    spectra = torch.fft.rfft(deviations)[..., torch.from_numpy(cycles).to(images.device)]
    phases = waves(-kernels.middle, u.to(images.device)).to(spectra.dtype)
    spectra = spectra * phases.unflatten(0, (scenes, members))[:, :, None]
    centred = replace(kernels, middle=torch.zeros_like(kernels.middle))
    observation = Observation(centred, height, width, images.dtype, scenes).at_frequencies(u, width)
    # 2. One system for each prior and frequency. Those with a prior that is stronger by a factor s give the degrees of
    # freedom n - d log det A / d log s: a difference quotient.
    shape, step = (precisions.shape[2] // scenes, scenes, len(u)), 1.2
    normal = observation.normal(len(precisions) - 1).in_windows([slice(0, observation.count)])
    system = normal.at(u, torch.cat([precisions, step * precisions], 2))
    factor, stronger = factor_banded(system, observation.count).split(2)
    growth = (stronger.log_determinant() - factor.log_determinant()).view(shape)
    freedom = observation.count - growth / math.log(step)
    # 3. The residuals of the rows with each prior, which are channels of the scenes that are fitted.
    whole = slice(0, len(u))
    fitted = factor.solve(observation.adjoint(spectra, whole).flatten(2).repeat(1, 1, shape[0])).unflatten(2, shape)
    predicted = observation.forward(fitted.flatten(1, 2), whole).unflatten(2, (-1, shape[0]))
    weight = kernels.weight.unflatten(0, (scenes, members))
    residual = squared_modulus(spectra[:, :, :, None] - predicted)
    energy = channels * float((taper**2).sum())
    power = torch.einsum("smr,smcprf->psf", weight.to(residual.dtype), residual) / energy
    counted = (weight > 0).double().sum((1, 2))
    unexplained_power, freedom_left = tables(power, counted[:, None] - freedom)
    return unexplained_power, freedom_left


_STRENGTHS = np.array([1.0, 2.0, 4.0, 8.0, 16.0])  # factors on the prior
_FREQUENCIES = 16  # at which rows are sampled; 12 and 24 give the same results, 8 loses 0.4 dB in three cases of 61
_ROWS = 256  # sampled, from the middle of the frames


def sampled_rows(height: int) -> slice:
    """The rows of frames by which the strength of the prior is selected."""
    count = min(height, _ROWS)
    return slice((height - count) // 2, (height - count) // 2 + count)


@torch.no_grad()
def prior_strengths(
    images: Tensor, kernels: RowKernels, prior: RowPrior, noise_power: Tensor, blur_reach: Tensor
) -> NDArray[np.float64]:
    """Factors (S,), of a few, on the prior for restoring S scenes, selected by cross-validation.

    The prior is fitted to the power spectrum of the frames minus that of the noise, which is measured where a frame is
    quiet. A stronger one predicts pixels better where the noise is correlated, stronger in bright areas, or due to
    compression.

    The images (S, M, C, R, W) and kernels are those of the ``sampled_rows``; ``noise_power`` (S, 1) is that of images
    of weight 1.
    """
    height, width = images.shape[-2:]
    if min(height, width) < 64:  # too few values for a choice
        return np.ones(len(images))
    # 1. Fits with the prior at all strengths, at frequencies from 0.02 cycles per px, below which the taper mixes them.
    cycles = np.linspace(0.02 * width, width // 2, min(_FREQUENCIES, width // 4), dtype=np.float32).astype(np.int64)
    place = torch.from_numpy(np.rint(cycles / width * 2 * (prior.power.shape[-1] - 1)).astype(np.int64))
    scenes, members, number = *prior.interpolation_power.shape[:2], len(_STRENGTHS)
    at = RowPrior(*(values[..., place.to(values.device)] for values in vars(prior).values()))
    stacks, frames = (torch.arange(count, device=images.device) for count in (scenes, members))
    of_all = at.of(stacks.repeat(number), frames)
    strength = torch.from_numpy(_STRENGTHS.repeat(scenes)[:, None]).to(noise_power)
    precisions = of_all.precision(noise_power.repeat(number, 1), strength, blur_reach.repeat(number, 1))
    power, freedom = unexplained(images, kernels, cycles, precisions)
    # 2. ``n |r|^2 / (n - freedom)^2`` of Craven and Wahba (1979) estimates the squared error of predicting a pixel from
    # all others. The sum over the frequencies is dominated by those with the largest errors; the geometric mean gives
    # all the same weight. The weaker of the two selected priors is used: with the sum alone, five of 124 restorations
    # lose 0.2 to 2.8 dB; with the mean alone, ten of 98 with white noise lose 0.1 to 0.9 dB.
    with np.errstate(divide="ignore", invalid="ignore"):  # frames without content have no scores
        of_sum = np.log(power.sum(-1)) - 2 * np.log(freedom.sum(-1))
        geometric = (np.log(power) - 2 * np.log(freedom)).mean(-1)
    selected = [without_nan(score, math.inf).argmin(0) for score in (of_sum, geometric)]
    return _STRENGTHS[np.minimum(*selected)]
