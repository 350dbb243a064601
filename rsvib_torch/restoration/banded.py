"""Row-banded restoration: every row is deconvolved within a slab of rows with the PSF of that row (Sec. 3.2).

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.execution.chunking import at_once, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.numerics.fourier import extend_rows, extended_length, squared_modulus, waves
from rsvib_torch.numerics.splines import bspline_weights, mirrored
from rsvib_torch.options import BandedOptions
from rsvib_torch.restoration.frame_motion import MovingFrames
from rsvib_torch.restoration.noise import estimate_noise

_DEGREE = 3  # of the B-spline across rows
_KEPT = 2  # central rows of a slab; takes half the time of 1 and costs 0.02 dB (paper camera, noise 0.003)
_ALIGNED_ROWS = 256  # moved at a time; bounds the memory


def _spline_transfer(places: Tensor, frequencies: Tensor) -> Tensor:
    """Transfer function (..., U) of shifting by ``places`` px with a cubic B-spline."""
    cell = places.detach().floor()
    taps = torch.arange(_DEGREE + 1, dtype=places.dtype, device=places.device) - _DEGREE // 2
    samples = bspline_weights(torch.zeros((), dtype=places.dtype, device=places.device), _DEGREE)
    at_rest = samples @ waves(taps, frequencies).real
    weights = bspline_weights(places - cell, _DEGREE)[..., None]
    return (weights * waves(cell[..., None] + taps, frequencies)).sum(-2) / at_rest


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


def restore_banded(given: MovingFrames, options: BandedOptions) -> Tensor:
    """Restore frames slab by slab (Sec. 3.2 of Liu et al. 2023).

    Scene row k appears at frame row r(k). The slab of rows r(k) - l ... r(k) + l, l = ``half_rows``, is assumed to have
    the PSF of that row. It is deconvolved by the Wiener filter ``H* / (|H|^2 + w (4 sin^2 pi u + 4 sin^2 pi v))``, w =
    ``noise_to_signal``, and its central rows are kept. The prior penalises image gradients, which preserves the mean.
    Whole pixels of the displacement shift the slab. Rows are extended smoothly at their ends and mirrored above and
    below. All pixels count, those without data with their local means.
    """
    frames, motion = given.images, given.motion
    B, T, C, H, W = frames.shape
    half_rows = check_whole_number("half_rows", options.half_rows, at_least=1, at_most=max(16, H))
    weights = _noise_to_signal(frames, options.noise_to_signal)
    length = extended_length(W, motion.displacement_bound() + 8)  # px by which a Wiener filter extends beyond it
    size = 2 * half_rows + 1
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=frames.device)
    v = torch.fft.fftfreq(size, dtype=torch.float64, device=frames.device).to(frames.dtype)

    # 1. One slab for every `_KEPT` scene rows: the frame row in its middle, and the motion relative to it.
    centres = torch.arange(0, H, _KEPT, device=frames.device)
    frame_rows, displaced = motion.frame_rows(centres.to(torch.float64))
    displacement, node_weights = exposure_trajectory(
        motion.vibration, motion.row_starts(frame_rows), motion.timing, "gauss"
    )
    rows = frame_rows.detach().round()
    along = displaced[..., 0] + motion.shift[..., 0, None]
    moved = torch.stack([along, rows - centres + motion.shift[..., 1, None]], dim=-1)
    displacement = (displacement - moved[..., None, :]).flatten(0, 2).to(frames.dtype)
    slab_rows = rows.flatten().to(torch.int64)
    image = torch.arange(B * T, device=frames.device).repeat_interleave(len(centres))
    weight = weights.repeat_interleave(T * len(centres))

    # 2. Fourier transforms of the rows, each moved back by its own mean displacement along it, (B T, H, C, U).
    every_row = torch.arange(H, dtype=torch.float64, device=frames.device).expand(B, T, H)
    mean = motion.mean_displacement(every_row)[..., 0].flatten()
    lines = torch.fft.rfft(extend_rows(frames, length)).transpose(-3, -2).flatten(0, 2)
    aligned = [
        part * waves(places, -u).to(part.dtype)[:, None]
        for part, places in zip(lines.split(_ALIGNED_ROWS), mean.split(_ALIGNED_ROWS), strict=True)
    ]
    spectra = torch.cat(aligned).unflatten(0, (B * T, H))

    # 3. The Wiener filters of some slabs at a time, at all lags across rows, and the rows that they restore.
    u = u.to(frames.dtype)
    prior = 4 * (torch.sin(math.pi * v).square()[:, None] + torch.sin(math.pi * u).square())
    lags = torch.fft.fftfreq(size, d=1.0 / size, device=frames.device, dtype=torch.float32).round().to(torch.int64)
    kept = torch.arange(_KEPT, device=frames.device)
    restored = frames.new_empty(len(slab_rows), _KEPT, C, W)
    chunks = runs(len(slab_rows), at_once(16 * size * len(u), frames.device))  # bytes of the filters
    advance = steps(len(chunks), "chunks")
    for chunk in chunks:
        across = _spline_transfer(displacement[chunk, :, 1], v) * node_weights.to(v)[:, None]
        transfer = across.mT @ waves(displacement[chunk, :, 0], u)  # (n, V, U)
        damped = torch.addcmul(squared_modulus(transfer), weight[chunk, None, None], prior)
        response = transfer.conj() / damped.clamp(min=torch.finfo(u.dtype).tiny)
        filters = torch.fft.ifft(response, dim=-2)
        source = mirrored(slab_rows[chunk, None, None] + kept[:, None] - lags, H)  # (n, kept rows, V)
        rows_out = (spectra[image[chunk, None, None], source] * filters[:, None, :, None]).sum(2)
        restored[chunk] = torch.fft.irfft(rows_out, n=length)[..., :W]
        advance()
    stacked: Tensor = restored.unflatten(0, (B, T, len(centres))).flatten(2, 3)[:, :, :H]
    return stacked.movedim(3, 2)
