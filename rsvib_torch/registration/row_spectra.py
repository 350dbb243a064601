"""Fourier transforms along the rows of frames, and the frames warped by a motion in them."""

import math
from copy import copy

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.chunking import gathered, runs
from rsvib_torch.core.fourier import extend_rows, fast_length, shift_phases
from rsvib_torch.core.splines import bspline_coefficient_rows, bspline_weights

__all__ = ["DEGREE", "MARGIN", "RowSpectra", "chunks", "combined", "differences", "inner_columns", "mean_over_frames"]

DEGREE = 7  # of the spline across rows: what it smooths, and the noise it colours, lie above the pass band
MARGIN = 8  # px from the ends of rows and columns that do not count
_EXTENSION = 32  # px that rows are continued by, so that their Fourier transform closes smoothly
_CHUNK = {"cpu": 2**23}  # bytes that stay in a cache
_LARGE_CHUNK = 2**30  # bytes at a time elsewhere


def chunks(count: int, bytes_of_one: int, multiple: int, device: torch.device) -> list[slice]:
    """Slices of consecutive rows or columns, a multiple of ``multiple`` each, that are worked on at a time."""
    size = max(1, _CHUNK.get(device.type, _LARGE_CHUNK) // (bytes_of_one * multiple)) * multiple
    return runs(count, size)


class RowSpectra:
    """Fourier transforms along the rows of frames, of spline coefficients across rows.

    Args:
        frames: (B, T, H, W) in row order.
        valid: (B, T, H, W) bool, pixels that count; None for all.
        level: (B, T, 1, 1) to take off each frame.
        contrast: (B, T, 1, 1) to divide what is left by.
    """

    def __init__(
        self,
        frames: Tensor,
        valid: Tensor | None = None,
        level: Tensor | float = 0.0,
        contrast: Tensor | float = 1.0,
    ) -> None:
        self.height, self.width = frames.shape[-2:]
        self.length = fast_length(self.width + 2 * _EXTENSION)
        pieces = (
            (rows, torch.fft.rfft(extend_rows(coefficients.sub_(level).div_(contrast), self.length)))
            for rows, coefficients in bspline_coefficient_rows(frames, DEGREE)
        )
        self.values = gathered(pieces, self.height, frames.ndim - 2)
        self._point_at_rows()
        self.frequencies = torch.fft.rfftfreq(self.length, dtype=torch.float64, device=frames.device)
        self.valid = None
        if valid is not None and not bool(valid.all()):
            # what interpolation takes from a bad pixel does not count either
            spoilt = functional.max_pool2d((~valid).to(frames.dtype), 2 * (DEGREE // 2) + 1, 1, DEGREE // 2)
            self.valid = spoilt == 0

    def _point_at_rows(self) -> None:
        """All rows of all frames one after the other, and the first of each frame, which parts share."""
        frames = self.values.shape[:2]
        self._all_rows = torch.view_as_real(self.values).view(-1, 2 * self.values.shape[-1])
        self._first_rows = self.height * torch.arange(frames.numel(), device=self.values.device).view(frames)

    def part(self, frames: slice) -> "RowSpectra":
        """Those of some of the frames."""
        part = copy(self)
        part.values, part._first_rows = self.values[:, frames], self._first_rows[:, frames]
        part.valid = None if self.valid is None else self.valid[:, frames]
        return part

    def warped(self, rows: Tensor, shift: Tensor) -> Tensor:
        """Spectra (B, T, S, U) of frame rows at fractional places ``rows``, moved back by ``shift``, both (B, T, S)."""
        cell = rows.floor()
        weights = bspline_weights((rows - cell).to(self._all_rows.dtype), DEGREE)
        first = cell.to(torch.int64) - DEGREE // 2
        taps = torch.arange(DEGREE + 1, device=rows.device)
        index = self._first_rows[..., None, None] + (first[..., None] + taps).clamp(0, self.height - 1)
        picked = functional.embedding_bag(
            index.flatten(0, 2), self._all_rows, per_sample_weights=weights.flatten(0, 2), mode="sum"
        )
        result: Tensor = torch.view_as_complex(picked.unflatten(-1, (-1, 2))).unflatten(0, rows.shape)
        for part in self.runs(rows.shape[-1], 1):
            result[..., part, :] *= self.ramp(shift[..., part])
        return result

    def runs(self, count: int, arrays: int) -> list[slice]:
        """Runs of ``count`` rows of which so many arrays like these spectra are worked on at a time."""
        row = self.values[:, :, 0]
        return chunks(count, arrays * row.element_size() * row.numel(), 1, row.device)

    def ramp(self, shift: Tensor) -> Tensor:
        """exp(2 pi i u shift) for all frequencies u (..., U)."""
        return shift_phases(shift, self.length, slice(0, len(self.frequencies)), self.values.dtype)

    def subtract(self, pattern: Tensor) -> None:
        """Take a pattern (B, U) out of every row of these frames; those of other parts stay as they are."""
        self.values = self.values - pattern[:, None, None].to(self.values.dtype)
        self._point_at_rows()

    def warped_valid(self, rows: Tensor, shift: Tensor) -> Tensor | None:
        """(B, S, W) bool, pixels of the scene that count in all frames; None for all."""
        if self.valid is None:
            return None
        place = rows.round().to(torch.int64).clamp(0, self.height - 1)
        columns = torch.arange(self.width, device=rows.device)
        result = torch.ones(1, dtype=torch.bool, device=rows.device)
        for frame in range(rows.shape[1]):  # one at a time: indices take eight times the memory of the flags
            picked = self.valid[:, frame].gather(1, place[:, frame, :, None].expand(-1, -1, self.width))
            column = (columns + shift[:, frame, :, None].round().to(torch.int64)).clamp(0, self.width - 1)
            result = result & picked.gather(2, column)
        return result


def combined(spectra: Tensor, factors: Tensor) -> Tensor:
    """Sum (B, S, U) over the frames of spectra (B, G, S, U), each row with its factor (B, G, S)."""
    parts = torch.view_as_real(spectra)
    factors = factors.to(parts.dtype)[..., None, None]
    total = parts[:, 0] * factors[:, 0]
    for frame in range(1, spectra.shape[1]):
        total.addcmul_(parts[:, frame], factors[:, frame])
    return torch.view_as_complex(total)


def mean_over_frames(spectra: Tensor, seen: Tensor) -> Tensor:
    """Mean (B, S, U) of spectra (B, G, S, U) over the frames that see a row."""
    return combined(spectra, seen / seen.sum(1, keepdim=True).clamp(min=1.0))


def differences(spectra: Tensor, seen: Tensor) -> Tensor:
    """What rows of each frame differ by from their mean over the frames that see them, (B, G, S, U).

    Of two frames the first alone, (B, 1, S, U): the other differs by the opposite. A frame that does not see a row does
    not differ.

    Args:
        spectra: (B, G, S, U).
        seen: (B, G, S) float64, 1 where a frame sees the row.
    """
    if spectra.shape[1] == 2:
        half = 0.5 * seen.prod(1, keepdim=True)
        return combined(spectra, torch.cat([half, -half], 1))[:, None]
    different = spectra - mean_over_frames(spectra, seen)[:, None]
    return different.mul_(seen[..., None].to(spectra.real.dtype))


def inner_columns(width: int, shift: Tensor, like: Tensor) -> Tensor:
    """(1, 1, W) weight of columns that all frames of the group show, falling to 0 over a few px."""
    edge = math.ceil(float(shift.abs().amax())) + MARGIN
    place = torch.arange(width, dtype=like.dtype, device=like.device)
    inside = torch.minimum(place, width - 1 - place) - edge
    return (inside / MARGIN).clamp(0.0, 1.0)[None, None]
