"""Restoration methods of single frames: dewarping, slabs of rows (the paper), and Richardson-Lucy iterations.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.imaging.blur import RowPSF, RowVaryingBlur, trajectory_psf
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.numerics.interpolation import (
    bspline_weights,
    correlated,
    extend_rows,
    extended_length,
    mirrored,
    shift_phases,
    spline_spectra,
    squared_modulus,
    waves,
)
from rsvib_torch.options import BandedOptions, DewarpOptions, RichardsonLucyOptions
from rsvib_torch.restoration.frame_motion import MovingFrames
from rsvib_torch.restoration.noise import estimate_noise

_DEWARP_DEGREE = 5  # of the B-spline across rows
_CHUNK_ROWS = 512  # interpolated at a time; 128 take 1.2 times as long for 256 rows


def restore_dewarp(given: MovingFrames, options: DewarpOptions = DewarpOptions()) -> Tensor:  # noqa: B008
    """Undo the displacement of every row of frames, not its blur: sufficient for short exposures.

    Scene row s is interpolated at frame row r(s) by a quintic B-spline across rows and moved back along the row by the
    mean displacement (Eq. 2) of that row with a phase ramp. Noise is not amplified.
    """
    (B, T, C, H, W), dtype, motion = given.images.shape, given.images.dtype, given.motion
    length = extended_length(W, motion.displacement_bound())
    # 1. Frame rows that show the scene rows, the six rows from which each is interpolated, and their weights.
    rows, moved = motion.frame_rows(torch.arange(H, dtype=torch.float64, device=motion.shift.device))
    cell = rows.detach().floor()
    weights = bspline_weights(rows - cell, _DEWARP_DEGREE).to(dtype).flatten(0, 1)
    offsets = torch.arange(_DEWARP_DEGREE + 1, device=rows.device) - _DEWARP_DEGREE // 2
    taps = mirrored(cell.to(torch.int64)[..., None] + offsets, H).flatten(0, 1)
    taps = taps + H * torch.arange(B * T, device=taps.device)[:, None, None]  # of all frames, one after the other
    # 2. Transforms of the spline coefficients along rows, with all channels of a row in one line of real numbers.
    spectra = torch.view_as_real(spline_spectra(given.images, _DEWARP_DEGREE, length)).movedim(2, 3)
    lines, along = spectra.reshape(B * T * H, -1), moved[..., 0].flatten(0, 1)
    # 3. Some rows (B T, R, C, W) of all frames at a time: their weighted sums, moved back.
    parts = []
    for part in runs(H, _CHUNK_ROWS):
        summed = embedding_bag(
            taps[:, part].flatten(0, 1), lines, per_sample_weights=weights[:, part].flatten(0, 1), mode="sum"
        )
        phases = shift_phases(along[:, part], length, slice(0, length // 2 + 1), dtype.to_complex())
        moved_back = torch.view_as_complex(summed.view(*phases.shape[:2], C, -1, 2)) * phases[:, :, None]
        parts.append(torch.fft.irfft(moved_back, n=length)[..., :W])
    return torch.cat(parts, dim=1).unflatten(0, (B, T)).movedim(3, 2)


_SLAB_DEGREE = 3  # of the B-spline across rows
_KEPT = 2  # central rows of a slab; takes half the time of 1 and costs 0.02 dB (paper camera, noise 0.003)


def _spline_transfer(places: Tensor, frequencies: Tensor) -> Tensor:
    """Transfer function (..., U) of shifting by ``places`` px with a cubic B-spline."""
    cell = places.detach().floor()
    taps = torch.arange(_SLAB_DEGREE + 1, dtype=places.dtype, device=places.device) - _SLAB_DEGREE // 2
    samples = bspline_weights(torch.zeros((), dtype=places.dtype, device=places.device), _SLAB_DEGREE)
    at_rest = samples @ waves(taps, frequencies).real
    weights = bspline_weights(places - cell, _SLAB_DEGREE)[..., None]
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
    mean = motion.mean_displacement[..., 0].flatten(0, 1)
    spectra = torch.fft.rfft(extend_rows(frames, length)).transpose(-3, -2).flatten(0, 1)
    spectra = spectra * shift_phases(mean, length, slice(0, len(u)), spectra.dtype)[:, :, None]

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
    blur = RowVaryingBlur(kernels)

    # 2. Counts of the measured pixels, and the coefficients that affect them by more than a tenth of a pixel; others
    # keep their initial value.
    tiny = torch.finfo(frames.dtype).tiny
    measured = torch.ones_like(frames) if given.ignore is None else (~given.ignore).to(frames.dtype)
    counts = frames.clamp(min=0.0) * measured
    sensitivity = blur.A_adjoint(measured)
    visible = sensitivity > 0.1
    total, pixels = (values.sum((-2, -1), keepdim=True) for values in (counts, measured))
    mean = (total / pixels.clamp(min=1.0)).clamp(min=tiny)

    # 3. The iterations; from a lower value than the least initial one, multiplicative updates need many of them.
    scene = torch.maximum(restore_dewarp(given), 1e-4 * mean)
    advance = steps(options.iterations, "iterations")
    for _ in range(options.iterations):
        ratio = counts / blur(scene).clamp(min=tiny)
        scene = torch.where(visible, scene * blur.A_adjoint(ratio) / sensitivity.clamp(min=tiny), scene)
        advance()

    # 4. Values at the pixels of the splines, with mirrored ends.
    for dim in (-2, -1):
        length = scene.shape[dim]
        near = mirrored(torch.arange(-1, length + 1, device=scene.device), length)
        samples = scene.new_tensor([[1 / 6, 4 / 6, 1 / 6]])
        scene = correlated(scene.index_select(dim, near), samples, dim)[0]
    return scene
