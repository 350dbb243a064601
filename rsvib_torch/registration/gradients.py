"""What every row tells of its remaining offset once both frames are warped back to the scene by a known motion."""

import math

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.spectral import extend_rows, fast_length
from rsvib_torch.splines import bspline_coefficients, bspline_weights

__all__ = ["RowSpectra", "remaining_offsets"]

_SMOOTHING = 1.0  # px, sigma of the Gaussian both warped frames are seen through
_REACH = 4  # rows of the Gaussian either side
_MARGIN = 8  # px from the ends of rows and columns that do not count
_EXTENSION = 32  # px that rows are continued by, so that their Fourier transform closes smoothly


class RowSpectra:
    """Fourier transforms of the rows of frames (L, T, H, U): cubic B-spline coefficients across rows, once per stack.

    Args:
        frames: (L, T, H, W) in row order.
    """

    def __init__(self, frames: Tensor) -> None:
        self.width = frames.shape[-1]
        self.length = fast_length(self.width + 2 * _EXTENSION)
        coefficients = bspline_coefficients(frames, 3, -2)
        self.values = torch.fft.rfft(extend_rows(coefficients, self.length))
        self.frequencies = torch.fft.rfftfreq(self.length, dtype=torch.float64, device=frames.device)

    def warped(self, frame: int, rows: Tensor, shift: Tensor) -> Tensor:
        """Spectra (L, S, U) of a frame's rows at fractional places ``rows``, moved back by ``shift``, both (L, S)."""
        height = self.values.shape[-2]
        cell = rows.floor()
        weights = bspline_weights(rows - cell, 3).to(self.values.real.dtype)
        first = cell.to(torch.int64) - 1
        stack = torch.arange(len(rows), device=rows.device)[:, None]
        result = torch.zeros((), dtype=self.values.dtype, device=rows.device)
        for tap in range(4):
            picked = self.values[stack, frame, (first + tap).clamp(0, height - 1)]
            result = result + weights[..., tap, None] * picked
        angle = 2 * math.pi * shift[..., None] * self.frequencies
        ramp = torch.polar(torch.ones_like(angle), angle).to(self.values.dtype)
        return result * ramp


def remaining_offsets(
    spectra: RowSpectra,
    frames: tuple[int, int],
    rows: tuple[Tensor, Tensor],
    shifts: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Remaining offset of every scene row between two warped frames, with its information.

    Both frames are warped to the scene by what is known of the motion: neither is favoured, so that interpolation does
    not drag the offset to whole or half pixels. With g the gradient of their mean and e the later less the earlier
    frame, each row gives ``H = sum g g^T`` and ``b = -sum g e``, and the remaining offset is ``H^-1 b`` (one
    Gauss-Newton step of the brightness constancy of this row).

    Args:
        spectra: Rows of the stacks.
        frames: Index of the earlier and of the later frame.
        rows: Frame rows (L, S) that show the S scene rows, in each frame.
        shifts: Displacement along the rows (L, S) in px to be taken out of each.

    Returns:
        Offsets (L, S, 2) px in axes (x, y), and information (L, S, 2, 2); both 0 for rows that a frame does not show
        or that have no detail.
    """
    early, late = (spectra.warped(*arguments) for arguments in zip(frames, rows, shifts, strict=True))
    u = spectra.frequencies
    blur = torch.exp(-2 * (math.pi * _SMOOTHING * u).square()).to(early.real.dtype)
    steps = torch.arange(-_REACH, _REACH + 1, dtype=torch.float64, device=u.device)
    gauss = torch.exp(-steps.square() / (2 * _SMOOTHING**2))
    gauss = gauss / gauss.sum()
    slope = gauss * steps / (gauss * steps.square()).sum()

    def image(spectrum: Tensor, taps: Tensor) -> Tensor:
        """Smoothed rows, combined across rows with ``taps`` (correlation), valid part."""
        count = spectrum.shape[-2] - 2 * _REACH
        combined = sum(
            weight * spectrum.narrow(-2, index, count) for index, weight in enumerate(taps.tolist()) if weight != 0
        )
        assert isinstance(combined, Tensor)
        pixels: Tensor = torch.fft.irfft(combined, n=spectra.length)[..., : spectra.width]
        return pixels

    mean, difference = 0.5 * (early + late) * blur, (late - early) * blur
    ramp = (2j * math.pi * u).to(mean.dtype)
    gradient = (image(mean * ramp, gauss), image(mean, slope))
    change = image(difference, gauss)

    reach = max(float(shift.abs().max()) for shift in shifts)
    edge = math.ceil(reach) + _MARGIN
    height = spectra.values.shape[-2]
    if 2 * edge >= spectra.width:
        zeros = rows[0].new_zeros(*rows[0].shape, 2)
        return zeros, zeros[..., None].expand(*zeros.shape, 2)
    inner = slice(edge, spectra.width - edge)
    gx, gy, e = gradient[0][..., inner], gradient[1][..., inner], change[..., inner]
    products = [(a * b).sum(-1, dtype=torch.float64) for a, b in ((gx, gx), (gx, gy), (gy, gy), (gx, e), (gy, e))]
    hxx, hxy, hyy, bx, by = (functional.pad(p, (_REACH, _REACH)) for p in products)
    determinant = hxx * hyy - hxy.square()
    shown = torch.ones_like(hxx, dtype=torch.bool)
    for place in rows:
        shown &= (place >= _MARGIN) & (place <= height - 1 - _MARGIN)
    # rows whose neighbours are not shown were smoothed with what is not there
    window = 2 * _REACH + 1
    shown = -functional.max_pool1d(-shown.to(hxx.dtype), window, stride=1, padding=_REACH) > 0.5
    known = shown & (determinant > 1e-4 * (hxx * hyy)) & (determinant > 0)
    safe = torch.where(known, determinant, 1.0)
    offsets = -torch.stack([hyy * bx - hxy * by, hxx * by - hxy * bx], dim=-1) / safe[..., None]
    information = torch.stack([hxx, hxy, hxy, hyy], dim=-1).unflatten(-1, (2, 2))
    return torch.where(known[..., None], offsets, 0.0), torch.where(known[..., None, None], information, 0.0)
