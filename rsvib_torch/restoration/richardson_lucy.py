"""Restoration by Richardson-Lucy iterations on the row-varying blur; the result is non-negative.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from rsvib_torch.execution.progress import steps
from rsvib_torch.imaging.blur import RowPSF, RowVaryingBlur, trajectory_psf
from rsvib_torch.numerics.splines import correlated, mirrored
from rsvib_torch.options import RichardsonLucyOptions
from rsvib_torch.restoration.dewarp import restore_dewarp
from rsvib_torch.restoration.frame_motion import MovingFrames, joint_groups


def restore_richardson_lucy(given: MovingFrames, options: RichardsonLucyOptions) -> Tensor:
    """Restore frames by Richardson-Lucy iterations on the row-varying blur; negative values count as 0.

    ``c <- c K^T(m g / K c) / K^T m`` increases the likelihood of the scene for Poisson counts g of the measured pixels
    m (Richardson 1972; Lucy 1974), and preserves the total intensity. The unknowns c are cubic B-spline coefficients:
    B-splines are positive, hence the scene is non-negative, and they do not add the blur of linear interpolation. The
    initial scene is the result of ``restore_dewarp``; fewer iterations amplify less noise. For several frames of one
    scene, ``sum K^T(m g / K c) / sum K^T m`` is used, and their mean is the initial scene.
    """
    frames, motion, iterations = given.images, given.motion, options.iterations
    B, T, _, _, W = frames.shape
    groups = joint_groups(T, options.joint)
    psf = trajectory_psf(*motion.exposures, interpolation="cubic")
    weights = psf.weights.to(frames.dtype)[:, :, None]
    measured = torch.ones_like(frames) if given.ignore is None else (~given.ignore).to(frames.dtype)
    counts = frames.clamp(min=0.0)
    dewarped, shift = restore_dewarp(given), motion.shift.to(torch.int64)
    # degree 1: the kernels act on the coefficients themselves
    if all(members == [reference] for members, reference in groups):
        kernels = RowPSF((psf.first_tap - shift[:, :, None])[:, :, None, None], weights[:, :, None], 1)
        alone = _iterate(counts.unsqueeze(2), measured.unsqueeze(2), dewarped.unsqueeze(2), kernels, iterations)
        return _at_pixels(alone.squeeze(2))
    restored = []
    for stack in range(B):
        for members, reference in groups:
            first = psf.first_tap[stack, members] - shift[stack, reference]
            kernels = RowPSF(first[:, None], weights[stack, members], 1)
            elsewhere = torch.tensor([member != reference for member in members], device=frames.device)
            used = measured[stack, members] * ~(elsewhere[:, None, None, None] & _depends_on_boundary(kernels, W))
            apart = (shift[stack, members] - shift[stack, reference]).tolist()
            start = _mean_of_overlap(dewarped[stack, members], apart)
            restored.append(_iterate(counts[stack, members], used, start, kernels, iterations))
    return _at_pixels(torch.cat(restored).unflatten(0, (B, len(groups))))


def _iterate(counts: Tensor, measured: Tensor, start: Tensor, kernels: RowPSF, iterations: int) -> Tensor:
    """Iterate the coefficients ``start`` (..., 1, C, H, W) of the scene of frames (..., M, C, H, W)."""
    blur, size = RowVaryingBlur(kernels, origin=(0, 0)), tuple(start.shape)
    tiny = torch.finfo(counts.dtype).tiny
    counts = counts * measured
    total, pixels = (values.sum((-4, -2, -1), keepdim=True) for values in (counts, measured))
    mean = (total / pixels.clamp(min=1.0)).clamp(min=tiny)
    sensitivity = blur.adjoint(measured, size)
    visible = sensitivity > 0.1  # of one pixel; a coefficient that affects the pixels less keeps its initial value
    scene = torch.maximum(start, 1e-4 * mean)  # from a lower value, multiplicative updates need many iterations
    advance = steps(iterations, "iterations")
    for _ in range(iterations):
        ratio = counts / blur(scene).clamp(min=tiny)
        scene = torch.where(visible, scene * blur.adjoint(ratio, size) / sensitivity.clamp(min=tiny), scene)
        advance()
    return scene


def _depends_on_boundary(kernels: RowPSF, width: int) -> Tensor:
    """Pixels (..., R, W) that depend on the mirrored extension of a scene of R rows and W columns."""
    inside = torch.ones((), dtype=torch.bool, device=kernels.first_tap.device)
    num_rows = kernels.weights.shape[-3]
    places = torch.arange(num_rows, device=inside.device)[:, None], torch.arange(width, device=inside.device)
    for axis, place, length in ((1, places[0], num_rows), (0, places[1], width)):
        used = (kernels.weights != 0).any(-2 if axis == 0 else -1)
        last_tap = (used * torch.arange(used.shape[-1], device=used.device)).amax(-1)
        nearest = place - kernels.first_tap[..., axis, None]
        inside = inside & (nearest < length) & (nearest >= last_tap[..., None])
    return ~inside


def _mean_of_overlap(dewarped: Tensor, apart: Sequence[Sequence[int]]) -> Tensor:
    """Mean (1, C, H, W) of frames (M, C, H, W), pixel by pixel, over the frames that contain the pixel.

    Their content is ``apart`` (x, y) px from that of the mean.
    """
    height, width = dewarped.shape[-2:]
    total, number = torch.zeros_like(dewarped[:1]), torch.zeros_like(dewarped[:1])
    for image, (x, y) in zip(dewarped, apart, strict=True):
        here = (..., _overlap(height, y), _overlap(width, x))
        total[here] += image[..., _overlap(height, -y), _overlap(width, -x)]
        number[here] += 1.0
    return total / number


def _overlap(length: int, step: int) -> slice:
    """Part of an axis whose content is found ``step`` px further on in another image of that length."""
    return slice(max(-step, 0), max(length - step, 0))


def _at_pixels(coefficients: Tensor) -> Tensor:
    """Values at the pixels of cubic B-splines with mirrored ends, (..., H, W)."""
    for dim in (-2, -1):
        length = coefficients.shape[dim]
        near = mirrored(torch.arange(-1, length + 1, device=coefficients.device), length)
        samples = coefficients.new_tensor([[1 / 6, 4 / 6, 1 / 6]])
        coefficients = correlated(coefficients.index_select(dim, near), samples, dim)[0]
    return coefficients
