"""Restoration of the geometry only: every row is moved back by its mean displacement during the exposure.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from rsvib_torch.core.chunking import gathered, runs
from rsvib_torch.core.fourier import extended_length, phase_products, phase_tables, spline_spectra
from rsvib_torch.core.splines import bspline_weights, mirrored
from rsvib_torch.options import DewarpOptions
from rsvib_torch.restoration.frame_motion import FrameMotion

__all__ = ["restore_dewarp"]


_CHUNK_ROWS = 128  # interpolated at a time


def restore_dewarp(frames: Tensor, motion: FrameMotion, options: DewarpOptions = DewarpOptions()) -> Tensor:  # noqa: B008
    """Undo the displacement of every row, not its blur: fast, and sufficient for short exposures.

    Scene row s is interpolated at frame row r(s) by a quintic B-spline across rows and moved back along the row by the
    mean displacement (Eq. 2) of that row with a phase ramp. Noise is not amplified.

    Args:
        frames: (B, T, C, H, W) in row order.
        motion: Motion of the frames.
        options: Options of the method.

    Returns:
        Restored frames of the same shape.
    """
    degree = 5
    B, T, C, H, W = frames.shape
    rows = motion.frame_rows(torch.arange(H, dtype=torch.float64, device=frames.device))
    along, rows = motion.mean_displacement(rows)[..., 0].flatten(0, 1), rows.flatten(0, 1)

    length = extended_length(W, motion.displacement_bound())
    spectra = spline_spectra(frames, degree, length)
    count = spectra.shape[-1]
    cell = rows.detach().floor()
    weights = bspline_weights(rows - cell, degree).to(frames.dtype)
    taps = cell.to(torch.int64)[..., None] + torch.arange(degree + 1, device=frames.device) - degree // 2
    image = torch.arange(B * T, device=frames.device)[:, None, None]
    taps = mirrored(taps, H) + image * H
    # one entry per row, with all channels
    flat = torch.view_as_real(spectra.movedim(2, 3)).reshape(B * T * H, -1)

    coarse, fine = phase_tables(along, length, slice(0, count), frames.dtype.to_complex())

    def restored(part: slice) -> Tensor:
        fetched = embedding_bag(
            taps[:, part].flatten(0, 1), flat, per_sample_weights=weights[:, part].flatten(0, 1), mode="sum"
        )
        moved = torch.view_as_complex(fetched.view(B * T, -1, C, count, 2))
        moved = moved * phase_products(coarse[:, part], fine[:, part], count)[:, :, None]
        image: Tensor = torch.fft.irfft(moved, n=length)[..., :W]
        return image

    parts = ((part, restored(part)) for part in runs(H, options.chunk_rows or _CHUNK_ROWS))
    stacked: Tensor = gathered(parts, H, 1).unflatten(0, (B, T)).movedim(3, 2)
    return stacked
