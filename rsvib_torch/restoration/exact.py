"""Exact restoration: all rows of a frame, each with its own PSF, solved together."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.checks import check_number, check_whole_number
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.banded_solver import solve_skewed
from rsvib_torch.restoration.disagreement import noise_levels
from rsvib_torch.restoration.missing import fill_roughly, measured_values
from rsvib_torch.restoration.motion import FrameMotion
from rsvib_torch.restoration.prior import ORDER, RowPrior, fit_prior
from rsvib_torch.restoration.row_kernel import REACH, kernel_samples
from rsvib_torch.restoration.row_system import RowKernels, row_kernels, smooth_band, smooth_kernels
from rsvib_torch.restoration.rows import continue_rows
from rsvib_torch.spectral import fast_length

__all__ = ["restore_exact"]

_MARGIN = 16  # px beyond what the motion shows, more than the reach of a deconvolution filter
_FILL_ITERATIONS = 8  # of filling values that were not measured
_MOSTLY = 0.9  # frames with at least this part of the most complete one start the filling
_QUIETEST = 1e-5  # lowest noise level assumed, of full scale
_CHUNK_ELEMENTS = {"cpu": 3 << 18, "cuda": 1 << 26}  # rows times frequencies solved at a time


def _groups(count: int, joint: bool | int) -> list[tuple[list[int], int]]:
    """Frames restored together, and the frame whose coordinates the result has, for every result."""
    if joint is True:
        return [(list(range(count)), count // 2)]
    size = 1 if joint is False else min(check_whole_number("joint", joint, at_least=1), count)
    starts = [min(max(frame - (size - 1) // 2, 0), count - size) for frame in range(count)]
    return [(list(range(first, first + size)), frame) for frame, first in enumerate(starts)]


def _of_whole_frames(kernels: RowKernels, valid: Tensor) -> RowKernels:
    """Let only those frames count of which most is of the scene: what the others lack can be filled from them."""
    share = valid.flatten(1).to(kernels.weight.dtype).mean(1)
    return replace(kernels, weight=kernels.weight * (share >= _MOSTLY * share.amax())[:, None])


@dataclass(frozen=True, eq=False)
class _Problem:
    """One scene, seen by M frames.

    Attributes:
        kernels: How the frames see it.
        prior: What it is like.
        noise_power: Power of the noise of a frame of weight 1 in the spectra of its rows.
        strength: Factor on the prior.
    """

    kernels: RowKernels
    prior: RowPrior
    noise_power: Tensor
    strength: float


def _restore_group(data: Tensor, valid: Tensor | None, problem: _Problem, chunk: int) -> Tensor:
    """Restore one scene from M frames.

    Args:
        data: (M, C, R, L) rows continued to a period.
        valid: Which values were measured, or None for all; the rest is filled with what the solution predicts.
        problem: The scene.
        chunk: Frequencies solved at a time.

    Returns:
        (C, R, L) scene rows.
    """
    num_rows, length = data.shape[-2:]
    kernels = problem.kernels
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=data.device)
    rows = kernels.scene_rows(num_rows)
    width = max(kernels.taps.shape[-2] - 1, ORDER)
    parts = [slice(begin, min(begin + chunk, len(u))) for begin in range(0, len(u), chunk)]
    seen = smooth_kernels(kernels, data.dtype)
    base = (kernels.first - rows.top).flatten()
    precision = problem.prior.precision(problem.noise_power, problem.strength)

    def solve(values: Tensor, weight: Tensor) -> list[Tensor]:
        spectra = torch.fft.rfft(values)
        normal = smooth_band(replace(kernels, weight=weight), rows, width, ORDER, data.dtype)
        memory = normal.memory(chunk)
        solutions = []
        for part in parts:
            turned = spectra[..., part] * kernels.phases(length, part, data.dtype)[:, None]
            turned = (turned * weight.to(data.dtype)[:, None, :, None]).transpose(1, 2).flatten(0, 1).conj()
            right = turned.new_zeros(rows.count, *turned.shape[1:])
            for i, kernel in enumerate(seen.taps(u[part])):
                right = right.index_add_(0, base + i, kernel[:, None] * turned)
            full = normal.at(u[part], precision[..., part], memory)
            solutions.append(solve_skewed(full, right.conj().resolve_conj()))
        return solutions

    def predict(coefficients: list[Tensor]) -> Tensor:
        spectra = []
        for part, values in zip(parts, coefficients, strict=True):
            seen_rows = sum(
                (kernel[:, None] * values[base + i] for i, kernel in enumerate(seen.taps(u[part]))),
                start=values.new_zeros(()),
            )
            phases = kernels.phases(length, part, data.dtype).conj()
            spectra.append(seen_rows.unflatten(0, phases.shape[:2]) * phases[:, :, None])
        images: Tensor = torch.fft.irfft(torch.cat(spectra, dim=-1).transpose(1, 2), n=length)
        return images

    if valid is None:
        coefficients = solve(data, kernels.weight)
    else:
        coefficients = solve(data, _of_whole_frames(kernels, valid).weight)
        for _ in range(_FILL_ITERATIONS):
            coefficients = solve(torch.where(valid, data, predict(coefficients)), kernels.weight)
    spectra = torch.cat([_evaluate(values, 1 - REACH - rows.top, num_rows) for values in coefficients], dim=-1)
    scene: Tensor = torch.fft.irfft(spectra, n=length)
    return scene


def _evaluate(coefficients: Tensor, first: int, count: int) -> Tensor:
    """Spectra (C, count, U) of scene rows from coefficients (K, C, U)."""
    rows = sum(
        (weight * coefficients[first + k : first + k + count] for k, weight in enumerate(kernel_samples())),
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
    each horizontal frequency the frame is a banded matrix times the coefficients of the scene across rows, of which a
    kernel of six rows makes the scene between its rows. Least squares with an autoregressive prior across rows, fitted
    to the frames themselves, is one banded Hermitian system per frequency. What that kernel cannot follow counts as
    noise. Several frames of one scene add their normal matrices.

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
    levels = _noise_levels(frames, motion, noise)
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
            kernels = row_kernels(moved, node_weights, weights[members], H, _MARGIN)
            along = motion.shift[stack, members, 0] - motion.shift[stack, reference, 0]
            hidden = None if ignore is None else ignore[stack, members]
            valid = measured_values(along, hidden, data[stack, members].shape, W)
            problem = _Problem(kernels, prior, typical * length, factor)
            restored.append(_restore_group(data[stack, members], valid, problem, chunk))
    stacked: Tensor = torch.stack(restored).unflatten(0, (B, len(groups)))[..., :W]
    return stacked + mean


def _noise_levels(frames: Tensor, motion: FrameMotion, noise: float | Literal["auto"]) -> Tensor:
    """Noise level of each frame, (B, T)."""
    if noise != "auto":
        level = check_number("noise", noise, at_least=0.0)
        return torch.full(frames.shape[:2], max(level, _QUIETEST), dtype=frames.dtype, device=frames.device)
    levels = [noise_levels(stack.detach(), motion, index) for index, stack in enumerate(frames)]
    return torch.stack(levels).clamp(min=_QUIETEST)
