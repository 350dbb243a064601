"""Restoration methods of single frames: dewarping, slabs of rows (the paper), and Richardson-Lucy iterations.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from rsvib_torch.checks.arguments import check_tensor, checks_arguments
from rsvib_torch.checks.values import check_single, check_whole_number
from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.prepare import frames_from_row_order, frames_to_row_order
from rsvib_torch.imaging.blur import RowPSF, RowVaryingBlur, trajectory_psf
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.motion.motion import Motion, check_two_axes
from rsvib_torch.motion.timing import MAX_ROWS, SensorTiming, check_timing
from rsvib_torch.numerics.interpolation import (
    bspline_coefficients,
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
from rsvib_torch.restoration.frame_motion import FrameMotion, MovingFrames, frame_motion
from rsvib_torch.restoration.noise import estimate_noise

_DEWARP_DEGREE = 5  # of the B-spline across rows
_CHUNK_ROWS = 512  # interpolated at a time; 128 take 1.2 times as long for 256 rows


def restore_dewarp(moving: MovingFrames, options: DewarpOptions = DewarpOptions()) -> Tensor:  # noqa: B008
    """Undo the displacement of every row of frames, not its blur: sufficient for short exposures.

    Scene row s is interpolated at frame row r(s) by a quintic B-spline across rows and moved back along the row by the
    mean displacement (Eq. 2) of that row with a phase ramp. Noise is not amplified.
    """
    (B, T, _, H, W), dtype = moving.images.shape, moving.images.dtype
    length = extended_length(W, moving.motion.displacement_bound())
    taps, weights, displacement = _shown_rows(moving.motion, dtype)
    spectra = torch.view_as_real(spline_spectra(moving.images, _DEWARP_DEGREE, length)).movedim(2, 3)

    def restored(part: slice) -> Tensor:
        """Some rows (B T, R, C, W) of all images."""
        phases = shift_phases(displacement[:, part], length, slice(0, length // 2 + 1), dtype.to_complex())
        rows = _moved_back(spectra, taps[:, part], weights[:, part], torch.view_as_real(phases))
        return torch.fft.irfft(torch.view_as_complex(rows), n=length)[..., :W]

    parts = [restored(part) for part in runs(H, _CHUNK_ROWS)]
    return torch.cat(parts, dim=1).unflatten(0, (B, T)).movedim(3, 2)


def _shown_rows(motion: FrameMotion, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (B T, H, 6) of frames from which those of restored frames are interpolated, their weights, and (B T, H) px.

    The last one is the mean displacement along the row at its place in the frame.
    """
    rows, shift = motion.frame_rows(torch.arange(motion.num_rows, dtype=torch.float64, device=motion.shift.device))
    cell = rows.detach().floor()
    weights = bspline_weights(rows - cell, _DEWARP_DEGREE).to(dtype)
    first = -(_DEWARP_DEGREE // 2)
    offsets = torch.arange(first, first + _DEWARP_DEGREE + 1, device=rows.device)
    taps = mirrored(cell.to(torch.int64)[..., None] + offsets, motion.num_rows)
    return taps.flatten(0, 1), weights.flatten(0, 1), shift[..., 0].flatten(0, 1)


def _moved_back(spectra: Tensor, taps: Tensor, weights: Tensor, phases: Tensor) -> Tensor:
    """Moved transforms (N, R, C, U, 2) of R rows of N images, from those of spline coefficients (B, T, H, C, U, 2).

    Rows at ``taps`` (N, R, 6) are summed with ``weights`` and multiplied by ``phases`` (N, R, U, 2). Shapes are changed
    as real tensors: ONNX has no complex ones.
    """
    height, channels, frequencies = spectra.shape[2:5]
    images, count = taps.shape[:2]
    flat = spectra.reshape(images * height, -1)  # one entry per row, with all channels
    places = taps + height * torch.arange(images, device=taps.device)[:, None, None]
    fetched = embedding_bag(places.flatten(0, 1), flat, per_sample_weights=weights.flatten(0, 1), mode="sum")
    fetched = torch.view_as_complex(fetched.view(images, count, channels, frequencies, 2))
    return torch.view_as_real(fetched * torch.view_as_complex(phases[:, :, None]))


class FixedDewarp(nn.Module):
    """Restoration by method ``"dewarp"`` with a vibration that does not change, as a fixed graph of tensor operations.

    All that depends on the vibration is computed once. The result is that of ``restore(..., method="dewarp",
    check=False)``. Frames are float32 tensors without missing pixels. ``torch.compile(fullgraph=True)``,
    ``torch.export.export`` and ``torch.onnx.export`` accept the module. Rows are transformed by products with two
    matrices of about W^2 numbers, and columns are filtered by one of H^2: runtimes of ONNX transform most lengths
    slowly, with errors of up to 6e-4.

    Args:
        timing: The sensor.
        vibration: One motion along x and y, in image axes.
        size: (height, width) of the frames in px.
        num_frames: Frames of a stack.

    Raises:
        ValueError: If the vibration is a batch or has roll, zoom or a camera, or ``restore`` refuses this size.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, vibration = example_frames()
        >>> dewarp = rsv.FixedDewarp(timing, vibration, frames.shape[-2:], num_frames=2)
        >>> program = torch.export.export(dewarp, (frames,))
        >>> expected = rsv.restore(frames, timing, vibration, method="dewarp", check=False)
        >>> torch.allclose(program.module()(frames), expected, atol=1e-5)
        True
    """

    taps: Tensor  # buffers, see ``_shown_rows``
    weights: Tensor
    phases: Tensor  # (T, H, U, 2)
    to_coefficients: Tensor  # (H, H)
    to_spectra: Tensor  # (W, 2 U)
    to_rows: Tensor  # (2 U, W)

    @checks_arguments
    def __init__(self, timing: SensorTiming, vibration: Motion, size: tuple[int, int], num_frames: int) -> None:
        super().__init__()
        check_timing(timing)
        check_two_axes(vibration, "FixedDewarp")
        check_single("vibration", vibration.batch_shape)
        check_whole_number("num_frames", num_frames, at_least=1)
        sides = [check_whole_number("size", side, at_least=1, at_most=MAX_ROWS) for side in size]
        height, width = sides if timing.scan_axis == -2 else sides[::-1]
        rowwise, in_rows = vibration.detached().to_row_order(timing).expanded(1), timing.in_row_order()
        in_rows.check_rows(height)
        motion = frame_motion(rowwise, in_rows, in_rows.frame_starts(num_frames, vibration.device), height)
        motion.check_fits(width)
        self.timing, self.shape = timing, (num_frames, *sides)
        length = extended_length(width, motion.displacement_bound())
        taps, weights, displacement = _shown_rows(motion, torch.float32)
        phases = shift_phases(displacement, length, slice(0, length // 2 + 1), torch.complex64)
        # Both transforms of unit vectors, in float64.
        units = torch.eye(width, dtype=torch.float64, device=motion.shift.device)
        of_rows = torch.view_as_real(torch.fft.rfft(extend_rows(units, length))).flatten(1)
        of_spectra = torch.eye(of_rows.shape[1], dtype=torch.float64, device=units.device).unflatten(1, (-1, 2))
        rows = torch.fft.irfft(torch.view_as_complex(of_spectra), n=length)[:, :width]
        buffers = {"taps": taps, "weights": weights, "phases": torch.view_as_real(phases)}
        columns = bspline_coefficients(torch.eye(height, dtype=torch.float64, device=units.device), _DEWARP_DEGREE, -2)
        matrices = {"to_coefficients": columns.float(), "to_spectra": of_rows.float(), "to_rows": rows.float()}
        for name, values in (buffers | matrices).items():
            self.register_buffer(name, values)

    def extra_repr(self) -> str:
        """The frames that it restores."""
        return "{} frames of {} x {} px".format(*self.shape)

    def forward(self, frames: Tensor) -> Tensor:
        """Restore frames (T, H, W), (T, C, H, W) or (B, T, C, H, W)."""
        if not torch.compiler.is_compiling():
            check_tensor("frames", frames)
        if frames.dtype != self.to_spectra.dtype:
            raise TypeError(
                f"frames must be {self.to_spectra.dtype} as the module, got {frames.dtype}; pass frames.float()"
            )
        batch = frames[None, :, None] if frames.ndim == 3 else frames[None] if frames.ndim == 4 else frames
        if batch.ndim != 5 or (batch.shape[1], *batch.shape[-2:]) != self.shape:
            raise ValueError(
                f"frames must be stacks of (frames, height, width) = {self.shape}, got shape {tuple(frames.shape)}"
            )
        coefficients = self.to_coefficients @ frames_to_row_order(batch, self.timing)
        spectra = (coefficients @ self.to_spectra).unflatten(-1, (-1, 2)).movedim(2, 3)
        buffers = (self.taps, self.weights, self.phases)
        taps, weights, phases = (values.expand(len(batch), *values.shape).flatten(0, 1) for values in buffers)
        rows = _moved_back(spectra, taps, weights, phases).flatten(-2) @ self.to_rows
        restored = rows.unflatten(0, batch.shape[:2]).movedim(3, 2)
        return frames_from_row_order(restored, self.timing).reshape(frames.shape)


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


def restore_banded(moving: MovingFrames, options: BandedOptions) -> Tensor:
    """Restore frames slab by slab (Sec. 3.2 of Liu et al. 2023).

    Scene row k appears at frame row r(k). The slab of rows r(k) - l ... r(k) + l, l = ``half_rows``, is assumed to have
    the PSF of that row. It is deconvolved by the Wiener filter ``H* / (|H|^2 + w (4 sin^2 pi u + 4 sin^2 pi v))``, w =
    ``noise_to_signal``, and its central rows are kept. The prior penalises image gradients, which preserves the mean.
    Whole pixels of the displacement shift the slab. Rows are extended smoothly at their ends and mirrored above and
    below. All pixels count, those without data with their local means.
    """
    frames, motion = moving.images, moving.motion
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


def restore_richardson_lucy(moving: MovingFrames, options: RichardsonLucyOptions) -> Tensor:
    """Restore frames by Richardson-Lucy iterations on the row-varying blur; negative values count as 0.

    ``c <- c K^T(m g / K c) / K^T m`` increases the likelihood of the scene for Poisson counts g of the measured pixels
    m (Richardson 1972; Lucy 1974), and preserves the total intensity. The unknowns c are cubic B-spline coefficients:
    B-splines are positive, hence the scene is non-negative, and they do not add the blur of linear interpolation. The
    initial scene is the result of ``restore_dewarp``; fewer iterations amplify less noise.
    """
    frames, motion = moving.images, moving.motion
    # 1. The operator: kernels of all channels of a frame, which act on the coefficients themselves (degree 1).
    psf = trajectory_psf(*motion.exposures, interpolation="cubic")
    first_tap = psf.first_tap - motion.shift.to(torch.int64)[:, :, None]
    kernels = RowPSF(first_tap[:, :, None], psf.weights.to(frames.dtype)[:, :, None], 1)
    blur = RowVaryingBlur(kernels)

    # 2. Counts of the measured pixels, and the coefficients that affect them by more than a tenth of a pixel; others
    # keep their initial value.
    tiny = torch.finfo(frames.dtype).tiny
    measured = torch.ones_like(frames) if moving.ignore is None else (~moving.ignore).to(frames.dtype)
    counts = frames.clamp(min=0.0) * measured
    sensitivity = blur.A_adjoint(measured)
    visible = sensitivity > 0.1
    total, pixels = (values.sum((-2, -1), keepdim=True) for values in (counts, measured))
    mean = (total / pixels.clamp(min=1.0)).clamp(min=tiny)

    # 3. The iterations; from a lower value than the least initial one, multiplicative updates need many of them.
    scene = torch.maximum(restore_dewarp(moving), 1e-4 * mean)
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
