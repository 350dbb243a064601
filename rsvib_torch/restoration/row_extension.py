"""How rows go on beyond their ends, so that neither their Fourier transform nor a displacement wraps around."""

import torch
from torch import Tensor

from rsvib_torch.core.chunking import gathered
from rsvib_torch.core.fourier import fast_length
from rsvib_torch.core.splines import bspline_coefficient_rows

__all__ = ["continue_rows", "period_of_rows", "spline_spectra"]

_MARGIN = 8  # px beyond what a displacement shows that either end goes on by itself


def period_of_rows(width: int, reach: int) -> int:
    """Length of a period that rows of ``width`` px fit in, moved by up to ``reach`` px: see ``continue_rows``."""
    return fast_length(width + 4 * (_MARGIN + reach))


def continue_rows(images: Tensor, length: int) -> Tensor:
    """Continue rows at their right end to a period of ``length``.

    Both ends go on by odd reflection, which keeps value and slope; from a quarter of the gap on one smoothly takes over
    from the other, so that what lies near one end is never seen from the other.

    Args:
        images: (..., W).
        length: Length of the period, more than W.

    Returns:
        Tensor (..., length) whose first W columns are the image.
    """
    width = images.shape[-1]
    steps = torch.arange(1, length - width + 1, device=images.device)
    back = steps.flip(0)
    after = 2 * images[..., -1:] - images[..., (width - 1 - steps).clamp(min=0)]
    before = 2 * images[..., :1] - images[..., back.clamp(max=width - 1)]
    progress = ((steps / (length - width + 1) - 0.25) * 2).clamp(0, 1)
    share = (0.5 + 0.5 * torch.cos(torch.pi * progress)).to(images.dtype)
    return torch.cat([images, share * after + (1 - share) * before], dim=-1)


def spline_spectra(images: Tensor, degree: int, length: int) -> Tensor:
    """Transforms (..., H, U) along rows, continued to ``length``, of spline coefficients across images (..., H, W)."""
    pieces = (
        (rows, torch.fft.rfft(continue_rows(coefficients, length)))
        for rows, coefficients in bspline_coefficient_rows(images, degree)
    )
    return gathered(pieces, images.shape[-2], images.ndim - 2)
