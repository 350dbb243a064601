"""Restoration by Richardson-Lucy iterations: what was never negative stays so."""

import torch
from torch import Tensor

from rsvib_torch.checks import check_whole_number
from rsvib_torch.imaging.blur import RowVaryingBlur
from rsvib_torch.imaging.psf import RowPSF, row_psf
from rsvib_torch.restoration.dewarp import restore_dewarp
from rsvib_torch.restoration.missing import fill_roughly
from rsvib_torch.restoration.motion import FrameMotion

__all__ = ["restore_richardson_lucy"]

_LEAST = 1e-4  # of the mean: values that start lower would stay there for long


def restore_richardson_lucy(
    frames: Tensor, motion: FrameMotion, *, iterations: int = 20, ignore: Tensor | None = None
) -> Tensor:
    """Restore frames by Richardson-Lucy iterations on the row-varying blur.

    ``c <- c K^T(m g / K c) / K^T m`` climbs to the most probable scene for Poisson counts g of the pixels m that were
    measured (Richardson 1972; Lucy 1974). The unknowns c are cubic B-spline coefficients of the scene: splines are
    positive, so that the scene is, and they do not blur as linear interpolation does. Every step conserves the flux.
    It starts from the frames with their geometry undone; fewer iterations amplify less noise.

    Args:
        frames: (B, T, C, H, W) in row order; negative values count as 0.
        motion: Motion of the frames.
        iterations: How many.
        ignore: Boolean mask shaped like the frames of pixels that do not count.

    Returns:
        Restored frames of the same shape, nowhere negative.
    """
    iterations = check_whole_number("iterations", iterations, at_least=1)
    height = frames.shape[-2]
    starts = motion.row_starts(torch.arange(height, dtype=torch.float64, device=frames.device))
    psf = row_psf(
        motion.vibration,
        starts.expand(*frames.shape[:2], height),
        motion.timing,
        interpolation="cubic",
        quadrature="gauss",
    )
    first = psf.first_tap - motion.shift.to(torch.int64)[:, :, None]
    # degree 1: the kernels act on the coefficients themselves
    blur = RowVaryingBlur(RowPSF(first[:, :, None], psf.weights.to(frames.dtype)[:, :, None], 1), origin=(0, 0))
    measured = torch.ones_like(frames)
    if ignore is not None:
        frames, measured = fill_roughly(frames, ignore), (~ignore).to(frames.dtype)
    counts = frames.clamp(min=0.0) * measured
    size = tuple(frames.shape)
    sensitivity = blur.adjoint(measured, size)
    seen = sensitivity > torch.finfo(frames.dtype).eps
    tiny = torch.finfo(frames.dtype).tiny
    mean = (counts.sum((-2, -1), keepdim=True) / measured.sum((-2, -1), keepdim=True).clamp(min=1.0)).clamp(min=tiny)
    scene = torch.maximum(restore_dewarp(frames, motion), _LEAST * mean)
    for _ in range(iterations):
        ratio = counts / blur(scene).clamp(min=tiny)
        scene = torch.where(seen, scene * blur.adjoint(ratio, size) / sensitivity.clamp(min=tiny), scene)
    return _at_pixels(scene)


def _at_pixels(coefficients: Tensor) -> Tensor:
    """Cubic B-splines with mirrored ends at the pixels, (..., H, W)."""
    for dim in (-2, -1):
        length = coefficients.shape[dim]
        before = coefficients.narrow(dim, min(1, length - 1), 1)
        after = coefficients.narrow(dim, max(length - 2, 0), 1)
        padded = torch.cat([before, coefficients, after], dim)
        sides = padded.narrow(dim, 0, length) + padded.narrow(dim, 2, length)
        coefficients = (4.0 * coefficients + sides) / 6.0
    return coefficients
