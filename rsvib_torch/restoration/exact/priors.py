"""Priors of the exact restoration: their table, the Gaussian one and the one of sparse patches."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.restoration.exact.scene_solver import SceneProblem, SceneSolver
from rsvib_torch.restoration.scene_model.observation import REACH, kernel_samples

__all__ = ["PRIORS", "Prior", "PriorOptions", "shrink_patches"]

_PATCH = 8  # px; chosen together with the stages of the prior


@dataclass(frozen=True)
class PriorOptions:
    """Options of every prior.

    Attributes:
        regularisation: Factor > 0 on the strength of the prior; 1: as estimated from the frames. The precision of the
            problem already includes it.
    """

    regularisation: float = 1.0


Prior = Callable[[SceneProblem, PriorOptions], Tensor]


def gaussian(problem: SceneProblem, options: PriorOptions) -> Tensor:
    """The autoregressive prior across rows, whose precision the problem contains: one solution."""
    solver = problem.solver()
    return solver.scene(solver.fit(problem.data))


def edges(problem: SceneProblem, options: PriorOptions) -> Tensor:
    """Every patch of 8 x 8 px is a sum of few cosines, which keeps edges and flat areas free of noise.

    Half-quadratic splitting (Geman and Yang 1995): alternately, the patches z of the scene E c are shrunk, and
    ``sum_m w_m |g_m - K_m c|^2 + c^H P' c + s |E c - z|^2`` is minimised for increasing s and a weak Gaussian prior.
    """
    kernels = problem.observation.kernels
    solver = replace(problem, precision=0.3 * problem.precision).solver()
    coefficients = solver.fit(problem.data)
    weight = float(kernels.weight.detach().mean(-1).sum())
    # strength s in units of the weight of the data, threshold level in units of the noise, px between patches: best on
    # scenes of four kinds at noise 0.02
    stages = [(1.0, 1.0, 2), (3.0, 0.7, 2), (10.0, 0.5, 1)]
    if kernels.blurred:  # deconvolved noise is far above that of the data: 1 to 2 dB, see the ablations
        stages = [(0.03, 5.0, 2), (0.1, 3.0, 2), (0.3, 1.8, 2), *stages]
    for relative, threshold, step in stages:
        strength = relative * weight * options.regularisation
        level = threshold * options.regularisation**0.5 * problem.level / weight**0.5
        spectra = torch.fft.rfft(shrink_patches(_sampled_scene(solver, coefficients), level, step))
        expected = strength * _sampled(spectra.movedim(0, 1))
        precision = _sampling_precision(strength, problem.precision)
        order = len(problem.precision)
        precision[:order, :order] += 0.03 * problem.precision
        solver = replace(problem, precision=precision).solver()
        coefficients = solver.fit(problem.data, expected)
    return solver.scene(coefficients)


# A prior is a function (problem, options) -> scene. It returns the deviation of the scene from the mean brightness of
# the frames, (C, R, L) real: rows 0 ... R - 1 in the coordinates of the restored frame, L the period of problem.data,
# in units of full scale. problem.data (M, C, R, L) are complete (missing values are filled) and have zero mean
# brightness. It may solve with problem.solver(), and with replace(problem, precision=...).solver(): products
# (p + 1, p + 1, U) as from RowPrior.precision define P in c^H P c, which is added to sum_m w_m |g_m - K_m c|^2, so in
# units of the noise power of data of weight 1 (standard deviation problem.level). It must be differentiable with
# respect to the data and the precision, must not write to its arguments, and is called from several threads at a time.
PRIORS: dict[str, Prior] = {"gaussian": gaussian, "edges": edges}


def _cosines(like: Tensor) -> Tensor:
    """Orthonormal cosines (n n, 1, n, n) of a patch; the first is constant."""
    order = torch.arange(_PATCH, dtype=torch.float64, device="cpu")
    waves = torch.cos(torch.pi * order[:, None] * (order + 0.5) / _PATCH) * math.sqrt(2.0 / _PATCH)
    waves[0] /= math.sqrt(2.0)
    patches = torch.einsum("ai,bj->abij", waves, waves).flatten(0, 1)[:, None]
    return patches.to(like)


def shrink_patches(images: Tensor, level: float | Tensor, step: int = 1) -> Tensor:
    """Images (N, H, W) without the weak cosines of their overlapping patches of 8 x 8 px.

    Cosines of at most two standard deviations are set to zero. Every pixel is the mean of all patches that contain it,
    weighted by the inverse of their numbers of remaining cosines.

    Args:
        images: The images.
        level: Standard deviation of white noise in them.
        step: Pixels between patches: 1, 2 or 4.
    """
    cosines, rim = _cosines(images).flatten(1), _PATCH - 1  # (n n, n n)
    height, width = images.shape[-2:]
    # patches begin at every step-th row and column; the last ones extend beyond the image
    size = [-(-(whole + rim) // step) * step + _PATCH - step for whole in (height, width)]
    ends = (rim, size[1] - width - rim, rim, size[0] - height - rim)
    padded = torch.nn.functional.pad(images[:, None], ends, mode="replicate")
    total, weights, ones = torch.zeros_like(padded), torch.zeros_like(padded), padded.new_ones(1, 1, _PATCH, 1)
    for begin in range(0, size[0] - rim, 64):  # rows at a time, a multiple of all steps: less memory
        rows = slice(begin, min(begin + 64 - step + _PATCH, size[0]))
        part = padded[..., rows, :]
        # products of matrices: several times as fast as convolutions with one channel
        values = cosines @ torch.nn.functional.unfold(part, _PATCH, stride=step)  # (N, n n, patches)
        strong = values.detach().abs() > 2.0 * level
        strong[:, 0] = True
        weight = 1.0 / strong.sum(1, keepdim=True).to(values.dtype)
        shrunk = cosines.T @ (values * strong * weight)
        total[..., rows, :] += torch.nn.functional.fold(shrunk, part.shape[-2:], _PATCH, stride=step)
        spread = weight.unflatten(-1, (-1, (size[1] - _PATCH) // step + 1))
        for kernel, stride in ((ones, (step, 1)), (ones.mT, (1, step))):  # every patch on its 8 x 8 px
            spread = torch.nn.functional.conv_transpose2d(spread, kernel, stride=stride)
        weights[..., rows, :] += spread
    return (total / weights)[:, 0, rim : rim + height, rim : rim + width]


def _sampled(values: Tensor) -> Tensor:
    """The scene ``E c`` on the rows of its coefficients (K, C, U), zero outside; E is symmetric.

    With the samples of the kernel: the more numerous ``scene_weights`` would widen the band of ``E^T E``.
    """
    edge = values.new_zeros(REACH - 1, *values.shape[1:])
    padded = torch.cat([edge, values, edge])
    shifted = (weight * padded[k : k + len(values)] for k, weight in enumerate(kernel_samples()))
    return sum(shifted, start=values.new_zeros(()))


def _sampled_scene(solver: SceneSolver, coefficients: Tensor) -> Tensor:
    """``E c`` as an image (C, K, L)."""
    scene: Tensor = torch.fft.irfft(_sampled(coefficients).movedim(1, 0), n=solver.length)
    return scene


def _sampling_precision(strength: float, like: Tensor) -> Tensor:
    """Products (5, 5, U) as of ``RowPrior.precision``: the bands of ``strength E^T E``."""
    samples = torch.tensor(kernel_samples(), dtype=like.dtype, device=like.device)
    count = len(samples)
    products = like.new_zeros(count, count, like.shape[-1])
    for d in range(count):
        products[d, 0] = strength * (samples[: count - d] * samples[d:]).sum()
    return products
