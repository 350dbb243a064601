"""Row-banded restoration: every row is deconvolved within a slab of rows with the PSF of that row (Sec. 3.2).

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.execution.chunking import at_once, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.imaging.trajectory import Quadrature, exposure_trajectory
from rsvib_torch.numerics.fourier import extend_rows, extended_length, squared_modulus, waves
from rsvib_torch.numerics.splines import bspline_weights, mirrored
from rsvib_torch.options import BandedOptions
from rsvib_torch.restoration.frame_motion import FrameMotion, MovingFrames
from rsvib_torch.restoration.noise import estimate_noise


def _spline_transfer(places: Tensor, frequencies: Tensor, degree: int) -> Tensor:
    """Transfer function (..., U) of shifting by ``places`` px with a B-spline of ``degree``."""
    cell = places.detach().floor()
    samples = bspline_weights(torch.zeros((), dtype=places.dtype, device=places.device), degree)
    taps = torch.arange(degree + 1, dtype=places.dtype, device=places.device) - degree // 2
    at_rest = samples @ waves(taps, frequencies).real if degree > 1 else torch.ones_like(frequencies)
    weights = bspline_weights(places - cell, degree)[..., None]
    return (weights * waves(cell[..., None] + taps, frequencies)).sum(-2) / at_rest


_TRANSFERS: dict[str, tuple[Callable[[Tensor, Tensor], Tensor], int, Quadrature]] = {
    "linear": (lambda places, u: _spline_transfer(places, u, 1), 1, "midpoint"),
    "cubic": (waves, 3, "gauss"),
}


def _noise_to_signal(frames: Tensor, value: float | Literal["auto"]) -> Tensor:
    """Weight of the gradient prior of each stack, (B,); estimated from the frames for ``"auto"``."""
    if value != "auto":
        return torch.full((frames.shape[0],), value, dtype=frames.dtype, device=frames.device)
    variance = estimate_noise(frames).square().flatten(1).mean(1)
    energy = frames.new_zeros(frames.shape[:-2])
    for dim in (-2, -1):
        squares = frames.diff(dim=dim).square()
        energy += 0.5 * squares.sum((-2, -1)) / max(math.prod(squares.shape[-2:]), 1)
    gradients = energy.flatten(1).mean(1) - 2.0 * variance
    tiny = torch.finfo(frames.dtype).tiny
    lowest, highest = 5e-3, 10.0  # below, errors of the slab approximation are amplified more than noise
    return (variance / gradients.clamp(min=tiny)).clamp(lowest, highest)


def _filters(
    displacement: Tensor, node_weights: Tensor, grid: tuple[Tensor, Tensor], weight: Tensor, interpolation: str
) -> Tensor:
    """Wiener filters (n, V, U) of slabs at all lags across rows, of displacement (n, N, 2) in the exposure."""
    u, v = grid
    along_rows, degree, _ = _TRANSFERS[interpolation]
    along = along_rows(displacement[..., 0], u)
    across = _spline_transfer(displacement[..., 1], v, degree) * node_weights.to(v)[:, None]
    transfer = across.mT @ along
    prior = 4 * (torch.sin(math.pi * v).square()[:, None] + torch.sin(math.pi * u).square())
    damped = torch.addcmul(squared_modulus(transfer), weight[:, None, None], prior)
    response = transfer.conj() / damped.clamp(min=torch.finfo(u.dtype).tiny)
    return torch.fft.ifft(response, dim=-2)


def _aligned_spectra(frames: Tensor, motion: FrameMotion, u: Tensor, length: int) -> Tensor:
    """Fourier transform of the rows, each moved back by its own mean displacement along it, (B T, H, C, U)."""
    B, T, _, H, _ = frames.shape
    rows = torch.arange(H, dtype=torch.float64, device=frames.device).expand(B, T, H)
    mean = motion.mean_displacement(rows)[..., 0]
    spectra = torch.fft.rfft(extend_rows(frames, length)).transpose(-3, -2).flatten(0, 2)
    aligned_rows = 256  # at a time; bounds the memory
    moved = [
        lines * waves(places, -u).to(lines.dtype)[:, None]
        for lines, places in zip(spectra.split(aligned_rows), mean.flatten().split(aligned_rows), strict=True)
    ]
    return torch.cat(moved).unflatten(0, (B * T, H))


def restore_banded(given: MovingFrames, options: BandedOptions) -> Tensor:
    """Restore frames slab by slab (Sec. 3.2 of Liu et al. 2023).

    Scene row k appears at frame row r(k). The slab of rows r(k) - l ... r(k) + l, l = ``half_rows``, is assumed to have
    the PSF of that row. It is deconvolved by the Wiener filter ``H* / (|H|^2 + w (4 sin^2 pi u + 4 sin^2 pi v))``, w =
    ``noise_to_signal``, and its central rows are kept. The prior penalises image gradients, which preserves the mean.
    Whole pixels of the displacement shift the slab. Rows are extended smoothly at their ends and mirrored above and
    below. All pixels count, those without data with their local means.
    """
    frames, motion = given.images, given.motion
    half_rows = check_whole_number("half_rows", options.half_rows, at_least=1, at_most=max(16, frames.shape[-2]))
    stride = check_whole_number("stride", options.stride, at_least=1, at_most=max(2, frames.shape[-2]))
    interpolation = options.interpolation
    weights = _noise_to_signal(frames, options.noise_to_signal)
    B, T, C, H, W = frames.shape
    length = extended_length(W, motion.displacement_bound() + 8)  # px by which a Wiener filter extends beyond it
    size = 2 * half_rows + 1
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=frames.device)
    v = torch.fft.fftfreq(size, dtype=torch.float64, device=frames.device)

    # one slab for every `stride` scene rows: its middle, the frame row at which it appears, the motion relative to it
    centres = torch.arange((stride - 1) // 2, H + stride - 1, stride, device=frames.device)[: -(-H // stride)]
    frame_rows, displaced = motion.frame_rows(centres.to(torch.float64))
    displacement, node_weights = exposure_trajectory(
        motion.vibration, motion.row_starts(frame_rows), motion.timing, _TRANSFERS[interpolation][2]
    )
    rows = frame_rows.detach().round()
    along = displaced[..., 0] + motion.shift[..., 0, None]
    moved = torch.stack([along, rows - centres + motion.shift[..., 1, None]], dim=-1)
    displacement = (displacement - moved[..., None, :]).flatten(0, 2).to(frames.dtype)
    grid = (u.to(frames.dtype), v.to(frames.dtype))
    slab_rows = rows.flatten().to(torch.int64)
    image = torch.arange(B * T, device=frames.device).repeat_interleave(len(centres))
    weight = weights.repeat_interleave(T * len(centres))

    lags = torch.fft.fftfreq(size, d=1.0 / size, device=frames.device, dtype=torch.float32).round().to(torch.int64)
    kept = torch.arange(stride, device=frames.device) - (stride - 1) // 2
    spectra = _aligned_spectra(frames, motion, u, length)
    restored = frames.new_empty(B * T * len(centres), stride, C, W)
    chunks = runs(len(slab_rows), at_once(16 * size * len(u), frames.device))  # bytes of a filter bank
    advance = steps(len(chunks), "chunks")
    for chunk in chunks:
        bank = _filters(displacement[chunk], node_weights, grid, weight[chunk], interpolation)
        source = mirrored(slab_rows[chunk, None, None] + kept[:, None] - lags, H)  # (n, stride, V)
        rows_out = (spectra[image[chunk, None, None], source] * bank[:, None, :, None]).sum(2)  # (n, stride, C, U)
        restored[chunk] = torch.fft.irfft(rows_out, n=length)[..., :W]
        advance()
    stacked: Tensor = restored.unflatten(0, (B, T, len(centres))).flatten(2, 3)[:, :, :H]
    return stacked.movedim(3, 2)
