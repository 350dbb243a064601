"""A pattern of columns that is fixed to the sensor.

It stays where it is while the scene moves, and would pull displacements to zero.
"""

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.fourier import squared_modulus
from rsvib_torch.registration.row_spectra import RowSpectra, differences, inner_columns

__all__ = ["EVERY", "column_pattern"]

EVERY = 4  # rows of which one is enough
_ASKED = 2  # of those, one that tells whether there is a pattern at all
_LARGEST = 3.0  # variance of a row over the typical one
_NEIGHBOURS = 17  # frequencies judged together
_SIGNIFICANT = 3.0  # power over what noise gives


def column_pattern(groups: list[tuple[RowSpectra, Tensor, Tensor, Tensor, Tensor]]) -> Tensor | None:
    """Spectrum of what every row of every frame has added at the same columns.

    In frames warped back by the motion, a pattern p shows as ``p(x + shift)`` while the scene stands still: what the
    frames differ by is regressed on that, frequency by frequency, so that the scene has no part in it.

    Args:
        groups: Spectra of each group of frames with the rows (B, G, S), shifts (B, G, S) and visibility (B, G, S) that
            warp some of it, and the variance (B, S) that these rows leave: those that leave far more than others show
            something else and are not asked.

    Returns:
        (B, U) spectrum of the pattern, shrunk by its noise; None where none stands above it.
    """
    return None if _pattern_of(groups, _ASKED) is None else _pattern_of(groups, 1)


def _pattern_of(groups: list[tuple[RowSpectra, Tensor, Tensor, Tensor, Tensor]], step: int) -> Tensor | None:
    """``column_pattern`` as every ``step``-th row tells it."""
    found, power, noise, count = (torch.zeros(()) for _ in range(4))
    for spectra, *places in groups:
        rows, shift, seen, variance = (values[..., ::step] for values in places)
        typical = torch.where(variance > 0, variance, torch.nan).nanmedian(dim=-1, keepdim=True).values
        seen = seen * ((variance > 0) & (variance < _LARGEST * typical))[:, None]
        visible = seen * (seen.sum(1, keepdim=True) > 1)
        # the ends of the rows stay where they are as well, but are no pattern
        inner = inner_columns(spectra.width, shift, spectra.values.real)[0]
        for run in spectra.runs(rows.shape[-1], 5):
            warped, ramp = spectra.warped(rows[..., run], shift[..., run]), spectra.ramp(shift[..., run])
            pixels = torch.fft.irfft(differences(warped, visible[..., run]), n=spectra.length)
            difference = torch.fft.rfft(pixels[..., : spectra.width] * inner, n=spectra.length)
            moved = differences(ramp, visible[..., run])
            found = found + (moved.conj() * difference).sum((1, 2))
            power = power + squared_modulus(moved).sum((1, 2))
            noise = noise + squared_modulus(difference).sum((1, 2))
        count = count + (visible.sum((1, 2)) - (visible.sum(1) > 0).sum(-1)).to(noise.dtype)[:, None]
    pattern = found / power.clamp(min=1e-6)
    strength = pattern.abs().square() * power / (noise / count.clamp(min=1.0)).clamp(min=1e-30)
    half = _NEIGHBOURS // 2
    strength = functional.avg_pool1d(functional.pad(strength[:, None], (half, half), mode="replicate"), _NEIGHBOURS, 1)
    share = torch.where(strength[:, 0] > _SIGNIFICANT, 1 - 1 / strength[:, 0].clamp(min=1.0), 0.0)
    return pattern * share if bool((share > 0).any()) else None
