"""A prior that keeps edges: patches of the scene are made of few cosines."""

import math

import torch
from torch import Tensor

from rsvib_torch.restoration.exact.scene_solver import Coefficients, SceneSolver
from rsvib_torch.restoration.scene_model.row_kernel import REACH, kernel_samples

__all__ = ["expectation", "expectation_precision", "shrink_patches", "stages"]

# strength of the pull towards the patches in units of the data's weight, level of what is cut out of them in units of
# the noise, and px between patches; chosen on scenes of four kinds at noise 0.02
_STAGES = ((1.0, 1.0, 2), (3.0, 0.7, 2), (10.0, 0.5, 1))
# a long exposure leaves far more noise in what is hardly seen than white noise of one level: the patches fill that
# first, from what stands out most
_STAGES_OF_BLUR = ((0.03, 5.0, 2), (0.1, 3.0, 2), (0.3, 1.8, 2))
_PATCH = 8  # px
_THRESHOLD = 2.0  # cosines of a patch weaker than this many standard deviations are taken for noise
_ROWS = 64  # of pixels, at a time; a multiple of all steps


def stages(*, blurred: bool) -> tuple[tuple[float, float, int], ...]:
    """Strength, level and step of all pulls towards the patches."""
    return _STAGES_OF_BLUR + _STAGES if blurred else _STAGES


def _cosines(like: Tensor) -> Tensor:
    """Orthonormal cosines (n n, 1, n, n) of a patch; the first is constant."""
    order = torch.arange(_PATCH, dtype=torch.float64)
    waves = torch.cos(torch.pi * order[:, None] * (order + 0.5) / _PATCH) * math.sqrt(2.0 / _PATCH)
    waves[0] /= math.sqrt(2.0)
    patches = torch.einsum("ai,bj->abij", waves, waves).flatten(0, 1)[:, None]
    return patches.to(like)


def shrink_patches(images: Tensor, level: float | Tensor, step: int = 1) -> Tensor:
    """Images (N, H, W) without the weak cosines of any of their overlapping patches of 8 x 8 px.

    Every pixel is the mean of all patches that hold it, those with fewer cosines counting more.

    Args:
        images: The images.
        level: Standard deviation of white noise in them.
        step: Pixels between patches: 1, 2 or 4.
    """
    cosines, rim = _cosines(images), _PATCH - 1
    height, width = images.shape[-2:]
    # patches begin at every ``step``-th row and column; the last ones reach beyond the far ends
    size = [-(-(whole + rim) // step) * step + _PATCH - step for whole in (height, width)]
    ends = (rim, size[1] - width - rim, rim, size[0] - height - rim)
    padded = torch.nn.functional.pad(images[:, None], ends, mode="replicate")
    ones = torch.ones_like(cosines[:1])
    total, weights = torch.zeros_like(padded), torch.zeros_like(padded)
    for begin in range(0, size[0] - rim, _ROWS):
        rows = slice(begin, min(begin + _ROWS - step + _PATCH, size[0]))
        values = torch.nn.functional.conv2d(padded[..., rows, :], cosines, stride=step)
        strong = values.detach().abs() > _THRESHOLD * level
        strong[:, 0] = True
        weight = 1.0 / strong.sum(1, keepdim=True).to(values.dtype)
        total[..., rows, :] += torch.nn.functional.conv_transpose2d(values * strong * weight, cosines, stride=step)
        weights[..., rows, :] += torch.nn.functional.conv_transpose2d(weight, ones, stride=step)
    return (total / weights)[:, 0, rim : rim + height, rim : rim + width]


def expectation(
    solver: SceneSolver, coefficients: Coefficients, level: float | Tensor, strength: float, step: int
) -> Coefficients:
    """What pulls the coefficients towards a scene of few cosines: ``strength E^T z`` for the shrunk scene z.

    Args:
        solver: Of the scene.
        coefficients: Where it stands, (K, C, U') for each chunk of frequencies.
        level: Standard deviation of the noise in it.
        strength: Weight of the pull.
        step: Pixels between patches.
    """
    spectra = torch.cat([_sampled(values) for values in coefficients], dim=-1).movedim(1, 0)
    scene = shrink_patches(torch.fft.irfft(spectra, n=solver.length), level, step)
    shrunk = torch.fft.rfft(scene).movedim(0, 1)
    return [strength * _sampled(shrunk[..., part]) for part in solver.parts]


def _sampled(values: Tensor) -> Tensor:
    """The scene E c on all rows of its coefficients (K, C, U), nothing beyond them; E is symmetric.

    By the kernel itself: more weights, as ``scene_weights`` has, would widen the band of ``E^T E``.
    """
    edge = values.new_zeros(REACH - 1, *values.shape[1:])
    padded = torch.cat([edge, values, edge])
    return sum(
        (weight * padded[k : k + len(values)] for k, weight in enumerate(kernel_samples())),
        start=values.new_zeros(()),
    )


def expectation_precision(strength: float, frequencies: int, like: Tensor) -> Tensor:
    """Products (5, 5, U) as of ``RowPrior.precision``: the bands of ``strength E^T E``."""
    samples = torch.tensor(kernel_samples(), dtype=like.dtype, device=like.device)
    count = len(samples)
    products = like.new_zeros(count, count, frequencies)
    for d in range(count):
        products[d, 0] = strength * (samples[: count - d] * samples[d:]).sum()
    return products
