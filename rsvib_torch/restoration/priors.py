"""Priors of the exact restoration: their table, the Gaussian one and the one of sparse patches."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.values import check_choice
from rsvib_torch.execution.parallel import in_parallel, runs
from rsvib_torch.restoration.observation import KERNEL_REACH, kernel_samples
from rsvib_torch.restoration.scene_solver import SceneProblem

_PATCH, _STEP = 8, 2  # px, size and distance of patches; chosen together with the stages of the prior
_NEIGHBOURS = _PATCH // _STEP  # patches that begin before the next one that shares no pixel
_LINES = 4  # of patches, each of neighbours, at a time


def gaussian(problem: SceneProblem, regularisation: float) -> Tensor:
    """The autoregressive prior across rows, whose precision the problem contains: one solution."""
    solver = problem.solver()
    return solver.image(solver.fit(problem.data))


def edges(problem: SceneProblem, regularisation: float) -> Tensor:
    """Every patch of 8 x 8 px is a sum of few cosines, which keeps edges and flat areas free of noise.

    Half-quadratic splitting (Geman and Yang 1995): alternately, the patches z of the scene E c are shrunk, and
    ``sum_m w_m |g_m - K_m c|^2 + c^H P' c + s |E c - z|^2`` is minimised for increasing s and a weak Gaussian prior.
    """
    kernels = problem.observation.kernels
    solver = replace(problem, precision=0.3 * problem.precision).solver()
    right_side = problem.observation.A_adjoint(problem.data)
    coefficients = solver.solve(right_side)
    # total weight of the frames of each scene
    weight = kernels.weight.detach().mean(-1).unflatten(0, (len(problem.data), -1)).sum(-1)
    # strength s in units of the weight of the data and threshold level in units of the noise: best on scenes of four
    # kinds at noise 0.02
    stages = [(1.0, 1.0), (3.0, 0.7), (10.0, 0.5)]
    if kernels.blurred:  # deconvolved noise is far above that of the data: 1 to 2 dB, see the ablations
        stages = [(0.03, 5.0), (0.1, 3.0), (0.3, 1.8), *stages]
    # other patches in each stage: 0.1 to 0.2 dB, as much as patches at every pixel in the last one; steps behind an
    # exposure of 100 or 400 rows: 0.1 to 3 dB more
    offsets = itertools.cycle([(0, 0), (1, 1)])
    for (relative, threshold), offset in zip(stages, offsets, strict=False):
        strength = relative * weight * regularisation
        level = threshold * regularisation**0.5 * problem.level / weight.sqrt()
        scenes = torch.fft.irfft(_sampled(coefficients).permute(2, 1, 0, 3), n=problem.observation.period)
        levels = level.to(scenes.dtype).repeat_interleave(scenes.shape[1])[:, None, None]
        shrunk = shrink_patches(scenes.flatten(0, 1), levels, offset).view_as(scenes)
        strength = strength.to(scenes.dtype)[:, None]
        expected = strength * _sampled(torch.fft.rfft(shrunk).permute(2, 1, 0, 3))
        precision = _sampling_precision(strength, problem.precision)
        order = len(problem.precision)
        precision[:order, :order] += 0.03 * problem.precision
        solver = replace(problem, precision=precision).solver()
        coefficients = solver.solve(right_side + expected)
    return solver.image(coefficients)


# A prior is called as function(problem, regularisation) -> scenes, with the factor > 0 on its strength that the
# precision of the problem already includes. It returns the deviations of N scenes from the mean brightness of their
# frames, (N, C, R, L) real: rows 0 ... R - 1 in the coordinates of the restored frame, L the period of problem.data, in
# units of full scale. problem.data (N, M, C, R, L) are complete (missing values are filled) and have zero mean
# brightness. It may solve with problem.solver(), and with replace(problem, precision=...).solver(): products
# (p + 1, p + 1, N, U) as from RowPrior.precision define P in c^H P c, which is added to sum_m w_m |g_m - K_m c|^2, so
# in units of the noise power of data of weight 1 (standard deviation problem.level). It must be differentiable with
# respect to the data and the precision, must not write to its arguments, and is called from several threads at a time.
# The finer grid and mosaics have the Gaussian prior only, and solve without calling its function.
PRIORS: dict[str, Callable[[SceneProblem, float], Tensor]] = {"gaussian": gaussian, "edges": edges}
# bytes per pixel and channel of the frames, memory of a prior beyond that of the Gaussian one; measured by
# scripts/benchmark.py --only streaming
PRIOR_BYTES = 12


def check_prior(prior: str, *, scale: int = 1, mosaic: bool = False) -> None:
    """Refuse a prior that does not exist, or not on the finer grid or for mosaics where they are used."""
    check_choice("prior", prior, tuple(PRIORS))
    if prior != "gaussian" and (scale != 1 or mosaic):
        option = "mosaic" if mosaic else f"scale={scale}"
        raise ValueError(f"{option} has prior='gaussian' only, got {prior!r}")


def _cosines_of_neighbours(like: Tensor) -> Tensor:
    """Orthonormal cosines (neighbours x 8, 14) of neighbouring patches along a side; the first of a patch is constant.

    One product transforms four patches, and one with the transpose adds them up: 3/4 of the time of single patches.
    """
    order = torch.arange(_PATCH, dtype=torch.float64, device="cpu")
    waves = torch.cos(torch.pi * order[:, None] * (order + 0.5) / _PATCH) * math.sqrt(2.0 / _PATCH)
    waves[0] /= math.sqrt(2.0)
    ends = [(_STEP * k, _STEP * (_NEIGHBOURS - 1 - k)) for k in range(_NEIGHBOURS)]
    return torch.cat([functional.pad(waves, before_and_after) for before_and_after in ends]).to(like)


def shrink_patches(images: Tensor, level: float | Tensor, offset: tuple[int, int] = (0, 0)) -> Tensor:
    """Images (N, H, W) without the weak cosines of their overlapping patches of 8 x 8 px.

    Cosines of at most two standard deviations of white noise of a level are set to zero. Every pixel is the mean of the
    patches that contain it, weighted by the inverse of their numbers of remaining cosines. Patches begin at every
    second row and column, from an offset of 0 or 1.
    """
    cosines, shared = _cosines_of_neighbours(images), _PATCH - _STEP
    before = [shared + begin for begin in offset]
    counts = [-(-(size + begin) // _PATCH) for size, begin in zip(images.shape[1:], before, strict=True)]
    sides = [_PATCH * count + shared for count in counts]
    after = [side - begin - size for side, begin, size in zip(sides, before, images.shape[1:], strict=True)]
    padded = functional.pad(images[:, None], (before[1], after[1], before[0], after[0]), mode="replicate")[:, 0]

    def shrunk(part: slice) -> tuple[Tensor, Tensor]:
        """Sums of the patches of some lines of neighbours, and the weights of the patches."""
        rows = slice(_PATCH * part.start, _PATCH * part.stop + shared)
        # cosines along the rows, then across them, in units of the threshold
        along = (padded[:, rows].unfold(-1, len(cosines[0]), _PATCH) @ cosines.mT).flatten(-2) / (2.0 * level)
        lines, weights = torch.zeros_like(along), []
        for line in range(part.stop - part.start):
            place = slice(_PATCH * line, _PATCH * line + len(cosines[0]))
            values = (cosines @ along[:, place]).view(len(along), -1, _PATCH, _NEIGHBOURS * counts[1], _PATCH)
            strong = functional.hardshrink(values, 1.0)
            strong[:, :, 0, :, 0] = 1.0
            weight = 1.0 / strong.detach().abs().clamp_(max=1.0).sum(2).sum(-1)  # (N, patches, patches)
            strong[:, :, 0, :, 0] = values[:, :, 0, :, 0]
            strong *= weight[:, :, None, :, None]
            lines[:, place] += (2.0 * level) * (cosines.mT @ strong.view(len(along), len(cosines), -1))
            weights.append(weight)
        pixels = lines.unflatten(-1, (counts[1], -1)) @ cosines
        total = functional.pad(pixels[..., :_PATCH].flatten(-2), (0, shared))
        total[..., _PATCH:] += functional.pad(pixels[..., _PATCH:], (0, _PATCH - shared)).flatten(-2)[..., :-_STEP]
        return total, torch.cat(weights, 1)

    parts = runs(counts[0], _LINES)  # less memory, and faster
    if torch.is_grad_enabled() and images.requires_grad:
        results = [shrunk(part) for part in parts]
    else:
        results = in_parallel(shrunk, parts, images.device)
    total, weights = torch.zeros_like(padded), torch.cat([weight for _, weight in results], 1)
    for part, (pixels, _) in zip(parts, results, strict=True):
        total[:, _PATCH * part.start :][:, : pixels.shape[1]] += pixels
    reach = _NEIGHBOURS - 1
    sums = functional.avg_pool2d(functional.pad(weights, (reach,) * 4), _NEIGHBOURS, stride=1) * _NEIGHBOURS**2
    mean = total / sums.repeat_interleave(_STEP, 1).repeat_interleave(_STEP, 2)
    return mean[:, before[0] : before[0] + images.shape[1], before[1] : before[1] + images.shape[2]]


def _sampled(values: Tensor) -> Tensor:
    """The scenes ``E c`` on the rows of their coefficients (K, C, N, U), zero outside; E is symmetric.

    With the samples of the kernel: the more numerous ``scene_weights`` would widen the band of ``E^T E``.
    """
    edge = values.new_zeros(KERNEL_REACH - 1, *values.shape[1:])
    padded, total = torch.cat([edge, values, edge]), torch.zeros_like(values)
    for k, weight in enumerate(kernel_samples()):
        total.add_(padded[k : k + len(values)], alpha=weight)
    return total


def _sampling_precision(strength: Tensor, like: Tensor) -> Tensor:
    """Products (5, 5, N, U) as of ``RowPrior.precision``: the bands of ``strength E^T E``, with ``strength`` (N, 1)."""
    samples = torch.tensor(kernel_samples(), dtype=like.dtype, device=like.device)
    count = len(samples)
    products = like.new_zeros(count, count, *like.shape[-2:])
    for d in range(count):
        products[d, 0] = strength * (samples[: count - d] * samples[d:]).sum()
    return products
