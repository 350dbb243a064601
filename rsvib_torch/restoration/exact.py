"""Exact restoration: all rows of a frame, each with its own PSF, solved together.

Every step treats all stacks of a batch at a time. Scenes with the same kind of missing data are solved together,
as many as memory and threads allow.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.execution.parallel import allowed_threads, at_once, in_parallel, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.numerics.interpolation import extend_rows
from rsvib_torch.numerics.tables import table, take_stacks
from rsvib_torch.options import ExactOptions
from rsvib_torch.restoration.finer_grid import (
    FrameDifference,
    PolynomialPrior,
    finer_scene,
    fit_polynomial_prior,
    warn_of_frames,
)
from rsvib_torch.restoration.frame_motion import MovingFrames, joint_groups
from rsvib_torch.restoration.mosaic_scene import restore_mosaic
from rsvib_torch.restoration.noise import noise_levels
from rsvib_torch.restoration.observation import SCENE_REACH, TAPS, Observation, RowKernels, most_values
from rsvib_torch.restoration.priors import PRIORS, check_prior
from rsvib_torch.restoration.scene_prior import RowPrior, brightness, fit_prior, prior_strengths, sampled_rows
from rsvib_torch.restoration.scene_solver import (
    FILLED_BLUR_REACH,
    MIN_LEVEL,
    MOST_THREADS,
    SceneProblem,
    measured_values,
    scene_period,
    with_extension,
    with_missing_values,
)

_LEAST_MEASURED = 0.05  # share of the pixels of a frame that contributes
_FRAME_BYTES = 2**26  # frames of scenes that are treated at a time on a CPU, beside the systems


def restore_exact(frames: MovingFrames, options: ExactOptions) -> Tensor:
    """Restore frames with all rows coupled: the most probable scene for its frames and a prior.

    The kernel changes from row to row but not along a row. After a Fourier transform along the rows, the frame g is for
    each horizontal frequency a banded matrix K times the coefficients c of the scene across rows, from which a kernel
    of six rows interpolates. Least squares with an autoregressive prior across rows, fitted to the frames, is one
    banded Hermitian positive definite system ``(sum_m w_m K_m^H K_m + P) c = sum_m w_m K_m^H g_m`` per frequency. The
    interpolation error of the kernel counts as noise.

    Values of missing pixels are estimated from all others; those of saturated pixels are lower bounds, which are held
    approximately. Strips of columns of the same frames have one noise level, and one strength of the prior for each
    level. Colour mosaics: ``restore_mosaic``.
    """
    # 1. Check the options, and list the frames of each result.
    if frames.colours is not None:
        return restore_mosaic(frames, frames.colours, options)
    check_prior(options.prior, scale=options.scale)
    groups = joint_groups(frames.images.shape[1], options.joint)

    # 2. Estimate what all scenes of a stack have in common: noise levels and prior.
    model = model_frames(frames, noise=options.noise, scale=options.scale)

    # 3. Build the scenes of all stacks, and select the strength of the prior of each by cross-validation.
    scenes = model.scenes(groups)
    scenes = replace(scenes, strength=options.regularisation * model.strengths(scenes))

    # 4. Fill missing values, and solve the banded systems of all frequencies.
    images, differences = solve_scenes(model, scenes, options)

    # 5. On the finer grid, frames that contradict their scene show that the motion is wrong.
    if options.scale != 1:
        places = frames.motion.mean_displacement.detach()
        warn_of_frames(differences, [places[one, some] for one, some in zip(scenes.stack, scenes.members, strict=True)])
    return images.unflatten(0, (len(frames.images), -1))


@dataclass(frozen=True, eq=False)
class Scenes:
    """N scenes, each restored from M frames of a stack, in the coordinates of one of them."""

    stack: NDArray[np.int64]  # (N, 1) number of the stack
    members: NDArray[np.int64]  # (N, M) numbers of the frames
    shift: NDArray[np.float64]  # (N, 1, 2) px, that of the frame in whose coordinates a scene is restored
    moved: NDArray[np.float64]  # (N, M, 2) px by which the frames are moved relative to that one
    blur_reach: NDArray[np.float64]  # (N,) px, largest distance along the row during an exposure from its middle
    complete: NDArray[np.bool_]  # (N,) whether all pixels of the frames are measured
    contributes: NDArray[np.bool_]  # (N, M) whether the frame has enough measured pixels
    strength: NDArray[np.float64]  # (N,) factor on the prior


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameModel(MovingFrames):
    """The frames of B stacks, and the quantities that the scenes restored from them have in common."""

    weights: Tensor  # (B, T) weights of the frames
    level: Tensor  # (B,) standard deviation of the noise of a frame of weight 1
    mean: Tensor  # (B, C, 1, 1) brightness; the prior is for deviations from it
    prior: RowPrior | list[PolynomialPrior]  # of all frames; on the finer grid, one for each stack
    period: int  # L, the period of the restored scenes in px
    scale: int  # points of the restored scenes per px
    unknown: Tensor | None  # (B, T, C, H, W) bool, pixels without data and saturated ones; None for none
    measured: NDArray[np.float64]  # (B, T) share of the pixels that are not unknown

    def scenes(self, groups: list[tuple[list[int], int]]) -> Scenes:
        """The scenes that are restored from groups of frames (``joint_groups``), stack after stack."""
        count = len(self.images)
        stack = np.arange(count).repeat(len(groups))[:, None]
        members = np.tile([members for members, _ in groups], (count, 1))
        reference = np.tile([[reference] for _, reference in groups], (count, 1))
        shift = table(self.motion.shift)
        blur_reach = 0.5 * self.motion.blur_lengths[stack, members, 0].max(1)
        measured = self.measured[stack, members]
        # frames with few measured pixels do not contribute, unless there are no others
        contributes = measured > _LEAST_MEASURED
        contributes |= ~contributes.any(1, keepdims=True)
        moved = shift[stack, members] - shift[stack, reference]
        complete = (measured == 1).all(1)
        strength = np.ones(len(stack))
        return Scenes(stack, members, shift[stack, reference], moved, blur_reach, complete, contributes, strength)

    def _indices(self, scenes: Scenes) -> tuple[Tensor, Tensor]:
        """Stack (N, 1) and members (N, M), to index frames."""
        device = self.images.device
        return torch.as_tensor(scenes.stack, device=device), torch.as_tensor(scenes.members, device=device)

    def _row_kernels(self, scenes: Scenes) -> RowKernels:
        """Kernels of the frames of scenes, in the coordinates of their reference; 0 where frames do not contribute."""
        index = self._indices(scenes)
        displacement, node_weights = self.motion.exposures
        shift = torch.as_tensor(scenes.shift[:, :, None, None], device=displacement.device)
        weights = self.weights[index] * torch.as_tensor(scenes.contributes, device=displacement.device)
        displacements = (displacement[index] - shift).flatten(0, 1)
        height = self.images.shape[-2]
        return RowKernels.of_rows(displacements, node_weights, weights.flatten(), height, points=self.scale)

    def strengths(self, scenes: Scenes) -> NDArray[np.float64]:
        """Factors (N,) on the priors: one for each stack, or strips of the same frames, estimated from its first scene.

        Those of its frames whose columns are the same as in the restored one are used.
        """
        if not isinstance(self.prior, RowPrior):
            return np.ones(len(scenes.stack))  # the strength of other priors is not selected
        _, first, of_scenes = np.unique(scenes.stack[:, 0] // self.strips, return_index=True, return_inverse=True)
        first_scenes = take_stacks([scenes], first)
        first_scenes = replace(first_scenes, contributes=first_scenes.contributes & (first_scenes.moved == 0).all(-1))
        stack_of, member_of = self._indices(first_scenes)
        rows = sampled_rows(self.images.shape[-2])
        strengths = prior_strengths(
            self.images[..., rows, :][stack_of, member_of],
            self._row_kernels(first_scenes).rows(rows),
            self.prior.of(stack_of[:, 0], member_of),
            self.level[stack_of].square(),
            torch.as_tensor(first_scenes.blur_reach[:, None], device=self.images.device),
        )
        return strengths[of_scenes]

    def kinds(self, scenes: Scenes) -> list[str]:
        """What is missing in the data of each scene: ``"pixels"``, only the ``"extension"``, or ``"nothing"``.

        The boundary extension of blurred rows is missing, but not that of inner strips of columns, which end where they
        have no weight. On the finer grid, extensions of different frames contradict each other beyond half a cycle per
        px: filled, 49.9 dB become 53.9 dB (8 frames of 256 px, noise 0.002).
        """
        outer = np.isin(scenes.stack[:, 0] % self.strips, (0, self.strips - 1))
        ends = (outer & (scenes.blur_reach > FILLED_BLUR_REACH)) | (self.scale > 1)
        pixels = ~scenes.complete | scenes.moved[..., 0].any(1)
        whole = np.where(ends, "pixels and ends", "pixels")
        kinds: list[str] = np.where(pixels, whole, np.where(ends, "extension", "nothing")).tolist()
        return kinds

    def problem(self, scenes: Scenes, kind: str) -> SceneProblem:
        """The least-squares problem of scenes of one kind, with its missing values filled."""
        index = self._indices(scenes)
        stack_of, width = index[0][:, 0], self.images.shape[-1]

        # Data with zero mean, rows extended to a period.
        data = extend_rows(self.images[index] - self.mean[stack_of][:, None], self.period)

        # Observation operator, and precision of the prior.
        kernels = self._row_kernels(scenes)
        observation = Observation(kernels, self.images.shape[-2], self.period, data.dtype, len(data))
        level = self.level[stack_of]
        if isinstance(self.prior, RowPrior):
            factors = np.stack([scenes.strength, scenes.blur_reach])[..., None]
            strength, reach = torch.as_tensor(factors, dtype=data.dtype, device=data.device)
            prior = self.prior.of(stack_of, index[1])
            precision = prior.precision(level[:, None].square(), strength, reach)
        else:
            polynomial = self.prior[int(scenes.stack[0, 0])]
            precision = polynomial.precision(level[0].square(), float(scenes.strength[0]), kernels.blur_reach)
        problem = SceneProblem(data, observation, precision, level)

        # Values that are missing: the boundary extension of blurred rows, and pixels without data.
        if kind == "nothing":
            return problem
        if kind == "extension":
            return with_extension(problem, width)
        along = torch.as_tensor(scenes.moved[..., 0], device=data.device)
        unknown = None if self.unknown is None else self.unknown[index]
        measured = measured_values(along, unknown, data.shape, width, ends=kind.endswith("ends"))
        floor = None
        if self.clipped is not None:  # saturated pixels are at least as bright as their value
            floor = torch.full_like(data, -torch.inf)
            floor[..., :width] = torch.where(self.clipped[index], data[..., :width], -torch.inf)
        return with_missing_values(problem, problem.solver(keep=True), measured, floor)


def model_frames(moving: MovingFrames, *, noise: float | Literal["auto"] = "auto", scale: int = 1) -> FrameModel:
    """Noise levels, period and prior of frames; ``noise`` and ``scale`` are those of ``restore``."""
    frames, motion, strips, ignore, clipped = moving.images, moving.motion, moving.strips, moving.ignore, moving.clipped
    B, T, _, _, W = frames.shape
    unknown = ignore if clipped is None else clipped if ignore is None else ignore | clipped

    # Noise level of each frame. That of a single frame may include texture. Two strips of the same frames give their
    # noise as well as all of them, in a fraction of the time. Saturated pixels have no noise: with a quarter of a frame
    # saturated, the level was 0, and the PSNR 4 dB lower.
    if noise == "auto":
        strips_for_noise = sorted({strips // 4, strips - 1 - strips // 4})
        parts = [first + strip for first in range(0, B, strips) for strip in strips_for_noise]
        estimated = noise_levels(frames[parts], motion.of(parts), None if unknown is None else unknown[parts])
        powers = estimated.square().unflatten(0, (-1, len(strips_for_noise))).mean(1).repeat_interleave(strips, 0)
    else:
        powers = frames.new_full((B, T), noise**2)
    powers = powers.clamp(min=MIN_LEVEL**2)
    frame_weights = powers.reciprocal()
    unit_variance = frame_weights.mean(1).reciprocal()

    # Prior, fitted to the frames that contribute: an empty one would make it too strong, by 0.4 dB beside two others.
    measured = np.ones((B, T)) if unknown is None else 1.0 - table(unknown.double().flatten(2).mean(2))
    few = torch.from_numpy((measured <= _LEAST_MEASURED) & (measured > _LEAST_MEASURED).any(1, keepdims=True))
    levels, period = powers.sqrt().masked_fill(few.to(powers.device), math.inf), scene_period(motion, W)
    prior: RowPrior | list[PolynomialPrior]
    if scale == 1:
        prior = fit_prior(frames, motion, levels, period)
    else:
        of_stacks = ([stack] for stack in range(B))
        prior = [fit_polynomial_prior(frames[one], motion.of(one), levels[one], period) for one in of_stacks]
    return FrameModel(
        **vars(moving),
        weights=frame_weights * unit_variance[:, None],
        level=unit_variance.sqrt(),
        mean=brightness(frames).mean(1)[..., None, None],
        prior=prior,
        period=period,
        scale=scale,
        unknown=unknown,
        measured=measured,
    )


def solve_scenes(model: FrameModel, scenes: Scenes, options: ExactOptions) -> tuple[Tensor, list[FrameDifference]]:
    """Images (N, C, S H, S W) of scenes, and, on the finer grid, the differences of the frames of each scene."""
    width = model.images.shape[-1]
    blocks = _blocks(model, scenes)
    images: dict[int, Tensor] = {}
    differences: list[FrameDifference] = []
    advance = steps(len(scenes.stack), "frames")

    def solve(block: tuple[str, list[int]]) -> None:
        """Solve the scenes of a block."""
        kind, numbers = block
        solved = take_stacks([scenes], np.array(numbers))
        problem = model.problem(solved, kind)
        if model.scale == 1:
            deviations = PRIORS[options.prior](problem, options.regularisation)
        else:
            deviations, difference = finer_scene(problem, width, model.motion.neglected)
            differences.append(difference)
        means = model.mean[solved.stack[:, 0]]
        images.update(zip(numbers, deviations[..., : model.scale * width] + means, strict=True))
        advance(len(numbers))

    if torch.is_grad_enabled() and (model.images.requires_grad or model.motion.exposures[0].requires_grad):
        for block in blocks:
            solve(block)
    else:
        in_parallel(solve, blocks, model.images.device, at_most=MOST_THREADS)
    return torch.stack([images[number] for number in range(len(scenes.stack))]), differences


def _blocks(model: FrameModel, scenes: Scenes) -> list[tuple[str, list[int]]]:
    """Kinds and numbers of the scenes that are solved together: as many as memory and threads allow."""
    kinds = model.kinds(scenes)
    of_kind = {kind: [number for number, other in enumerate(kinds) if other == kind] for kind in dict.fromkeys(kinds)}
    if model.scale != 1:
        return [(kind, [number]) for kind, numbers in of_kind.items() for number in numbers]
    # values of the systems and of the data of a scene
    height, device = model.images.shape[-2], model.images.device
    frequencies, rows = model.period // 2 + 1, height + 2 * SCENE_REACH
    across = math.ceil(float(model.motion.blur_lengths[..., 1].max()))
    systems = rows * (2 * (TAPS - 1 + across) + 1) * frequencies
    most = most_values(device) // systems
    scene_bytes = 4 * scenes.members.shape[1] * model.images.shape[2] * height * model.period
    most = max(1, min(most, at_once(scene_bytes, device, cpu_bytes=_FRAME_BYTES)))
    threads = min(allowed_threads(), MOST_THREADS) if device.type == "cpu" else 1
    return [
        (kind, numbers[part])
        for kind, numbers in of_kind.items()
        for part in runs(len(numbers), max(1, min(most, -(-len(numbers) // threads))))
    ]
