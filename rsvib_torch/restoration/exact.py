"""Exact restoration: all rows of a frame, each with its own PSF, solved together."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.checks import check_number, check_whole_number
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.banded_solver import solve_banded
from rsvib_torch.restoration.missing import fill_roughly, measured_values
from rsvib_torch.restoration.motion import FrameMotion
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.prior import RowPrior, fit_prior
from rsvib_torch.restoration.rows import continue_rows
from rsvib_torch.spectral import fast_length
from rsvib_torch.splines import bspline_weights

__all__ = ["restore_exact"]

_MARGIN = 16  # px beyond what the motion shows, more than the reach of a deconvolution filter
_FILL_ITERATIONS = 8  # of filling values that were not measured
_MOSTLY = 0.9  # frames with at least this part of the most complete one start the filling
_SPLINE = (1 / 6, 4 / 6, 1 / 6)  # cubic B-spline at the integers
_QUIETEST = 1e-5  # lowest noise level assumed, of full scale
_CHUNK_ELEMENTS = {"cpu": 3 << 18, "cuda": 1 << 26}  # rows times frequencies solved at a time


@dataclass(frozen=True, eq=False)
class _RowKernels:
    """How the rows of M frames see the spline coefficients of the scene.

    Attributes:
        first: (M, R) first scene row of each row's kernel.
        taps: (M, R, J, N) weights of J scene rows at N nodes of the exposure.
        along: (M, R, N) displacement along the row at the nodes in px, float64.
        weight: (M, R) how much each row counts.
    """

    first: Tensor
    taps: Tensor
    along: Tensor
    weight: Tensor

    def transfer(self, member: int, u: Tensor) -> Tensor:
        """Kernels (R, J, U) of one frame at horizontal frequencies ``u``."""
        turns = self.along[member, ..., None] * u
        angle = ((turns.detach().round() - turns) * (2 * math.pi)).to(self.taps.dtype)
        return torch.complex(self.taps[member] @ angle.cos(), self.taps[member] @ angle.sin())


def _row_kernels(displacement: Tensor, node_weights: Tensor, weight: Tensor, num_rows: int) -> _RowKernels:
    """Kernels of rows whose scene moved by ``displacement`` (M, R, N, 2); rows that look elsewhere do not count."""
    rows = torch.arange(displacement.shape[-3], dtype=displacement.dtype, device=displacement.device)
    place = rows[:, None] - displacement[..., 1]
    cell = place.detach().floor()
    first = cell.amin(-1)
    spline = bspline_weights(place - cell, 3) * node_weights[:, None]
    offset = (cell - first[..., None]).to(torch.int64)[..., None] + torch.arange(4, device=place.device)
    count = int(offset.amax()) + 1
    taps = spline.new_zeros(*spline.shape[:-1], count).scatter(-1, offset, spline).transpose(-2, -1)
    first = first.to(torch.int64) - 1
    near = (first > -_MARGIN - count) & (first < num_rows + _MARGIN)
    first = first.clamp(-_MARGIN - count, num_rows + _MARGIN)
    return _RowKernels(first, taps.to(weight.dtype), displacement[..., 0], weight[:, None] * near)


def _prior_band(whitening: Tensor, width: int) -> Tensor:
    """Lower band (K, width + 1, U) of the precision of the spline coefficients of K scene rows."""
    count = whitening.shape[0]
    spline = whitening.new_tensor(_SPLINE).repeat(count, 1)  # on coefficients s + 1, s, s - 1
    spline[0] = spline.new_tensor([_SPLINE[0], _SPLINE[1] + _SPLINE[2], 0.0])
    spline[-1] = spline[0].flip(0)
    residual = whitening.new_zeros(count, 5, whitening.shape[-1])  # on coefficients s + 1 ... s - 3
    for i in range(3):
        for k in range(3):
            residual[i:, i + k] += whitening[i:, i] * spline[: count - i, k, None]
    band = whitening.new_zeros(count, width + 1, whitening.shape[-1])
    for d in range(5):
        for i in range(5 - d):
            # row s holds coefficients s + 1 - i and s + 1 - i - d
            begin = max(0, i + d - 1)
            end = count - 1 if i == 0 else count
            band[begin + 1 - i - d : end + 1 - i - d, d] += residual[begin:end, i] * residual[begin:end, i + d]
    return band


def _solve(spectra: Tensor, kernels: _RowKernels, whitening: Tensor, u: Tensor, rows: tuple[int, int]) -> Tensor:
    """Spline coefficients (K, C, U) of the scene.

    Args:
        spectra: (M, C, R, U) row spectra of M frames of one scene.
        kernels: How the frames see it.
        whitening: (K, 3, U) of the prior, in units of the noise of a frame of weight 1.
        u: (U,) cycles per px.
        rows: First scene row and number K of rows.
    """
    top, count = rows
    reach = kernels.taps.shape[-2]
    width = max(reach - 1, 4)
    band = _prior_band(whitening, width).to(spectra.dtype).flatten(0, 1)
    right = spectra.new_zeros(count, spectra.shape[1], len(u))
    for member in range(len(spectra)):
        kernel = kernels.transfer(member, u)
        back = kernel.conj().resolve_conj() * kernels.weight[member][:, None, None]
        base = kernels.first[member] - top
        data = spectra[member].movedim(1, 0)
        for i in range(reach):
            right.index_add_(0, base + i, back[:, i, None] * data)
            for j in range(i + 1):
                band.index_add_(0, (base + j) * (width + 1) + i - j, back[:, i] * kernel[:, j])
    return solve_banded(band.unflatten(0, (count, width + 1)), right)


def _groups(count: int, joint: bool | int) -> list[tuple[list[int], int]]:
    """Frames restored together, and the frame whose coordinates the result has, for every result."""
    if joint is True:
        return [(list(range(count)), count // 2)]
    size = 1 if joint is False else min(check_whole_number("joint", joint, at_least=1), count)
    starts = [min(max(frame - (size - 1) // 2, 0), count - size) for frame in range(count)]
    return [(list(range(first, first + size)), frame) for frame, first in enumerate(starts)]


def _of_whole_frames(kernels: _RowKernels, valid: Tensor) -> _RowKernels:
    """Let only those frames count of which most is of the scene: what the others lack can be filled from them."""
    share = valid.flatten(1).to(kernels.weight.dtype).mean(1)
    return replace(kernels, weight=kernels.weight * (share >= _MOSTLY * share.amax())[:, None])


def _restore_group(
    data: Tensor, valid: Tensor | None, kernels: _RowKernels, prior: tuple[RowPrior, Tensor], chunk: int
) -> Tensor:
    """Restore one scene from M frames.

    Args:
        data: (M, C, R, L) rows continued to a period.
        valid: Which values were measured, or None for all; the rest is filled with what the solution predicts.
        kernels: How the frames see the scene.
        prior: Prior of the scene, and the power of the noise of a frame of weight 1 that it competes with.
        chunk: Frequencies solved at a time.

    Returns:
        (C, R, L) scene rows.
    """
    num_rows, length = data.shape[-2:]
    scene_prior, noise_power = prior
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=data.device)
    reach = kernels.taps.shape[-2]
    top = min(int(kernels.first.amin()), -1)
    count = max(int(kernels.first.amax()) + reach, num_rows + 1) - top
    parts = [slice(begin, min(begin + chunk, len(u))) for begin in range(0, len(u), chunk)]

    def solve(values: Tensor, seen_by: _RowKernels) -> list[Tensor]:
        spectra = torch.fft.rfft(values)
        return [
            _solve(spectra[..., part], seen_by, scene_prior.whitening(noise_power, part, count), u[part], (top, count))
            for part in parts
        ]

    def predict(coefficients: list[Tensor], member: int) -> Tensor:
        rows = []
        for part, values in zip(parts, coefficients, strict=True):
            kernel = kernels.transfer(member, u[part])
            base = kernels.first[member] - top
            rows.append(
                (kernel.movedim(1, 0)[:, :, None] * values[base + torch.arange(reach, device=u.device)[:, None]]).sum(0)
            )
        image: Tensor = torch.fft.irfft(torch.cat(rows, dim=-1).movedim(0, 1), n=length)
        return image

    if valid is None:
        coefficients = solve(data, kernels)
    else:
        coefficients = solve(data, _of_whole_frames(kernels, valid))
        for _ in range(_FILL_ITERATIONS):
            filled = [torch.where(valid[m], data[m], predict(coefficients, m)) for m in range(len(data))]
            coefficients = solve(torch.stack(filled), kernels)
    spectra = torch.cat([_evaluate(values, -1 - top, num_rows) for values in coefficients], dim=-1)
    scene: Tensor = torch.fft.irfft(spectra, n=length)
    return scene


def _evaluate(coefficients: Tensor, first: int, count: int) -> Tensor:
    """Spectra (C, count, U) of scene rows from spline coefficients (K, C, U)."""
    rows = sum(
        (weight * coefficients[first + k : first + k + count] for k, weight in enumerate(_SPLINE)),
        start=coefficients.new_zeros(()),
    )
    return rows.movedim(1, 0)


def restore_exact(
    frames: Tensor,
    motion: FrameMotion,
    *,
    joint: bool | int = False,
    noise: float | Literal["auto"] = "auto",
    regularisation: float = 1.0,
    ignore: Tensor | None = None,
    chunk_frequencies: int | None = None,
) -> Tensor:
    """Restore frames with all rows coupled: the most probable scene for its frames and a prior.

    The kernel changes from row to row but not along a row. So the Fourier transform is taken along rows only, and for
    each horizontal frequency the frame is a banded matrix times the cubic B-spline coefficients of the scene across
    rows. Least squares with an autoregressive prior of the scene across rows, fitted to the frames themselves, is one
    banded Hermitian system per frequency. Several frames of one scene add their normal matrices.

    Args:
        frames: (B, T, C, H, W) in row order.
        motion: Motion of the frames.
        joint: ``True``: one image from all frames, in the coordinates of the middle one (the time axis keeps length
            1); a number K: every frame from K neighbouring ones; ``False``: every frame from itself. Where image
            motion moves frames, only what they have in common with the restored one is joined.
        noise: Standard deviation of the noise (full scale 1); ``"auto"`` estimates it for every frame.
        regularisation: Factor on the prior; 1 is what the frames ask for.
        ignore: Boolean mask shaped like the frames of pixels that do not count (no data, saturated); they may hold
            anything, and are filled with what the others say.
        chunk_frequencies: Frequencies solved at a time; bounds the memory, does not change the result.

    Returns:
        Restored frames of the same shape, or (B, 1, C, H, W).
    """
    B, T, _, H, W = frames.shape
    factor = check_number("regularisation", regularisation, above=0.0)
    groups = _groups(T, joint)
    length = fast_length(W + 4 * (_MARGIN + motion.reach(H)))
    if chunk_frequencies is None:
        chunk_frequencies = max(1, _CHUNK_ELEMENTS.get(frames.device.type, 1 << 22) // H)
    chunk = check_whole_number("chunk_frequencies", chunk_frequencies, at_least=1)
    if ignore is not None:
        frames = fill_roughly(frames, ignore)
    levels = _noise_levels(frames, noise)
    mean = frames.mean((1, 3, 4), keepdim=True)  # the prior is for deviations from it
    data = continue_rows(frames - mean, length)
    starts = motion.row_starts(torch.arange(H, dtype=torch.float64, device=frames.device)).expand(B, T, H)
    displacement, node_weights = exposure_trajectory(motion.vibration, starts, motion.timing, "gauss")
    restored = []
    for stack in range(B):
        weights = levels[stack].square().reciprocal()
        typical = weights.mean().reciprocal()
        weights = weights * typical
        prior = fit_prior(frames[stack], motion, stack, levels[stack], length)
        for members, reference in groups:
            moved = displacement[stack, members] - motion.shift[stack, reference]
            kernels = _row_kernels(moved, node_weights, weights[members], H)
            along = motion.shift[stack, members, 0] - motion.shift[stack, reference, 0]
            hidden = None if ignore is None else ignore[stack, members]
            valid = measured_values(along, hidden, data[stack, members].shape, W)
            restored.append(
                _restore_group(data[stack, members], valid, kernels, (prior, typical * length * factor), chunk)
            )
    stacked: Tensor = torch.stack(restored).unflatten(0, (B, len(groups)))[..., :W]
    return stacked + mean


def _noise_levels(frames: Tensor, noise: float | Literal["auto"]) -> Tensor:
    """Noise level of each frame, (B, T)."""
    if noise != "auto":
        level = check_number("noise", noise, at_least=0.0)
        return torch.full(frames.shape[:2], max(level, _QUIETEST), dtype=frames.dtype, device=frames.device)
    levels: Tensor = estimate_noise(frames.detach()).square().mean(-1).sqrt().clamp(min=_QUIETEST)
    return levels
