"""Restoration by Richardson-Lucy iterations on the row-varying blur; the result is non-negative.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import torch
from torch import Tensor

from rsvib_torch.execution.progress import steps
from rsvib_torch.imaging.blur import RowPSF, RowVaryingBlur, trajectory_psf
from rsvib_torch.numerics.splines import correlated, mirrored
from rsvib_torch.options import RichardsonLucyOptions
from rsvib_torch.restoration.dewarp import restore_dewarp
from rsvib_torch.restoration.frame_motion import MovingFrames


def restore_richardson_lucy(given: MovingFrames, options: RichardsonLucyOptions) -> Tensor:
    """Restore frames by Richardson-Lucy iterations on the row-varying blur; negative values count as 0.

    ``c <- c K^T(m g / K c) / K^T m`` increases the likelihood of the scene for Poisson counts g of the measured pixels
    m (Richardson 1972; Lucy 1974), and preserves the total intensity. The unknowns c are cubic B-spline coefficients:
    B-splines are positive, hence the scene is non-negative, and they do not add the blur of linear interpolation. The
    initial scene is the result of ``restore_dewarp``; fewer iterations amplify less noise.
    """
    frames, motion = given.images, given.motion
    # 1. The operator: kernels of all channels of a frame, which act on the coefficients themselves (degree 1).
    psf = trajectory_psf(*motion.exposures, interpolation="cubic")
    first_tap = psf.first_tap - motion.shift.to(torch.int64)[:, :, None]
    kernels = RowPSF(first_tap[:, :, None], psf.weights.to(frames.dtype)[:, :, None], 1)
    blur, size = RowVaryingBlur(kernels, origin=(0, 0)), tuple(frames.shape)

    # 2. Counts of the measured pixels, and the coefficients that affect them by more than a tenth of a pixel; others
    # keep their initial value.
    tiny = torch.finfo(frames.dtype).tiny
    measured = torch.ones_like(frames) if given.ignore is None else (~given.ignore).to(frames.dtype)
    counts = frames.clamp(min=0.0) * measured
    sensitivity = blur.adjoint(measured, size)
    visible = sensitivity > 0.1
    total, pixels = (values.sum((-2, -1), keepdim=True) for values in (counts, measured))
    mean = (total / pixels.clamp(min=1.0)).clamp(min=tiny)

    # 3. The iterations; from a lower value than the least initial one, multiplicative updates need many of them.
    scene = torch.maximum(restore_dewarp(given), 1e-4 * mean)
    advance = steps(options.iterations, "iterations")
    for _ in range(options.iterations):
        ratio = counts / blur(scene).clamp(min=tiny)
        scene = torch.where(visible, scene * blur.adjoint(ratio, size) / sensitivity.clamp(min=tiny), scene)
        advance()

    # 4. Values at the pixels of the splines, with mirrored ends.
    for dim in (-2, -1):
        length = scene.shape[dim]
        near = mirrored(torch.arange(-1, length + 1, device=scene.device), length)
        samples = scene.new_tensor([[1 / 6, 4 / 6, 1 / 6]])
        scene = correlated(scene.index_select(dim, near), samples, dim)[0]
    return scene
