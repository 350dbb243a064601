"""Exact restoration: all rows of a frame, each with its own PSF, solved together.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.core.fourier import extend_rows, extended_length, fast_length
from rsvib_torch.core.parallel import in_parallel
from rsvib_torch.core.progress import steps
from rsvib_torch.options import ExactOptions
from rsvib_torch.restoration.exact.filling import FILLED_BLUR_REACH, Extended, Incomplete, filled, measured_values
from rsvib_torch.restoration.exact.finer_scene import FrameDifference, finer_scene, warn_of_frames
from rsvib_torch.restoration.exact.priors import PRIORS, Prior, check_prior
from rsvib_torch.restoration.exact.scene_solver import SIDE_BY_SIDE, Partition, SceneProblem, SolversSideBySide
from rsvib_torch.restoration.frame_motion import FrameMotion, joint_groups
from rsvib_torch.restoration.noise import noise_levels
from rsvib_torch.restoration.scene_model.cross_validation import StrengthCache, prior_strength
from rsvib_torch.restoration.scene_model.observation import GRIDS, RowKernels
from rsvib_torch.restoration.scene_model.scene_prior import (
    PolynomialPrior,
    RowPrior,
    brightness,
    fit_polynomial_prior,
    fit_prior,
)

__all__ = ["SceneTask", "StackModel", "given_level", "model_stacks", "restore_exact", "scene_periods", "solve_scenes"]

_MIN_LEVEL = 1e-5  # of full scale, lowest noise level assumed; below, the systems lose digits in single precision


def restore_exact(
    frames: Tensor,
    motion: FrameMotion,
    options: ExactOptions,
    *,
    ignore: Tensor | None = None,
    clipped: Tensor | None = None,
    strips: int = 1,
) -> Tensor:
    """Restore frames with all rows coupled: the most probable scene for its frames and a prior.

    The kernel changes from row to row but not along a row. So the Fourier transform is taken along rows only, and for
    each horizontal frequency the frame g is a banded matrix K times the coefficients c of the scene across rows, from
    which a kernel of six rows interpolates. Least squares with an autoregressive prior across rows, fitted to the
    frames, is one banded Hermitian positive definite system ``(sum_m w_m K_m^H K_m + P) c = sum_m w_m K_m^H g_m`` per
    frequency. The interpolation error of the kernel counts as noise. Several frames of one scene add their normal
    matrices.

    Args:
        frames: (B, T, C, H, W) in row order, with local means at missing pixels.
        motion: Motion of the frames.
        options: Options of the method.
        ignore: Boolean mask shaped like the frames of missing pixels, whose values are estimated from all others.
        clipped: Boolean mask of saturated pixels, whose values are lower bounds, which are held approximately.
        strips: Number of neighbouring stacks of the batch that are strips of columns of the same frames. They have one
            period, one noise level, and one strength of the prior for each level.

    Returns:
        Restored frames of the same shape, or (B, 1, C, H, W); with ``scale=2``, of twice the rows and columns, point
        (2 i, 2 j) at pixel (i, j).
    """
    # 1. Check the options, and select the frames of each scene.
    factor, scale, prior = options.regularisation, options.scale, options.prior
    check_prior(prior, scale=scale)
    groups = joint_groups(frames.shape[1], options.joint)
    partition = Partition(options.chunk_frequencies, options.segments)

    # 2. Estimate what all scenes of a stack have in common: displacement, period, noise levels and prior.
    stacks = model_stacks(
        frames, motion, noise=options.noise, ignore=ignore, clipped=clipped, scale=scale, strips=strips
    )

    # 3. Select the strength of the prior of each scene, by cross-validation.
    tasks = [task for stack in stacks for task in stack.tasks(groups, factor)]

    # 4. Fill missing values, and solve the banded systems of all frequencies.
    images, differences = solve_scenes(tasks, PRIORS[prior], factor, partition, motion.neglected)

    # 5. On the finer grid, frames that contradict their scene show that the motion is wrong.
    if scale != 1:
        warn_of_frames(differences, (task.stack.places(task.members) for task in tasks))
    restored: Tensor = images.unflatten(0, (len(frames), -1))
    return restored


@dataclass(frozen=True, eq=False)
class StackModel:
    """One stack of frames, and the quantities that the scenes restored from it have in common.

    Attributes:
        frames: (T, C, H, W).
        displacement: (T, H, N, 2) during the exposures, at N nodes with weights ``node_weights``.
        node_weights: (N,).
        shift: (T, 2) reference shifts of the frames.
        weights: (T,) weights of the frames.
        level: Standard deviation of the noise of a frame of weight 1.
        level_is_certain: Whether it is given or estimated from several frames.
        mean: (C, 1, 1) brightness; the prior is for deviations from it.
        prior: Of all frames.
        strength_cache: Factors on the prior that were already selected.
        period: L, the period of the restored scenes in px.
        scale: Points of the restored scenes per px.
        unknown: (T, C, H, W) bool, pixels without data and saturated ones; None for none.
        clipped: (T, C, H, W) bool, the saturated ones.
        fills_ends: Whether the boundary extension may be filled: not that of inner strips of columns, which end where
            they have no weight (half the time, 0.00 dB).
    """

    frames: Tensor
    displacement: Tensor
    node_weights: Tensor
    shift: Tensor
    weights: Tensor
    level: Tensor
    level_is_certain: bool
    mean: Tensor
    prior: RowPrior | PolynomialPrior
    strength_cache: StrengthCache
    period: int
    scale: int
    unknown: Tensor | None
    clipped: Tensor | None
    fills_ends: bool

    def kernels(self, members: list[int], reference: int) -> RowKernels:
        """Kernels of some frames, in the coordinates of one of them."""
        moved = self.displacement[members] - self.shift[reference]
        return GRIDS[self.scale][0](moved, self.node_weights, self.weights[members], self.frames.shape[-2])

    def places(self, members: list[int]) -> Tensor:
        """Mean displacement (M, R, 2) of the rows of some frames."""
        return (self.displacement[members].detach() * self.node_weights[:, None]).sum(-2)

    def tasks(self, groups: list[tuple[list[int], int]], regularisation: float) -> list["SceneTask"]:
        """The scenes that are restored from groups of frames (``joint_groups``), with the strengths of their priors."""
        if self.unknown is not None:
            # frames with at most 5 % measured pixels do not contribute, unless there are no others
            share = (~self.unknown).double().flatten(1).mean(1).tolist()
            groups = [([m for m in members if share[m] > 0.05] or members, reference) for members, reference in groups]
        return [
            SceneTask(self, members, reference, regularisation * self.strength_of(members, reference))
            for members, reference in groups
        ]

    def strength_of(self, members: list[int], reference: int) -> float:
        """Factor on the prior, estimated from those frames whose columns are the same as in the restored one."""
        if isinstance(self.prior, PolynomialPrior):
            return 1.0  # its strength is not selected
        same_columns = [frame for frame in members if torch.equal(self.shift[frame], self.shift[reference])]
        prior, power = self.prior.of(members), self.level.square()

        def choose() -> float:
            kernels = self.kernels(same_columns, reference)
            return prior_strength(self.frames[same_columns], kernels, prior, power, certain=self.level_is_certain)

        noise = power / self.weights[same_columns].mean() + prior.interpolation_power.mean()
        return self.strength_cache.of(noise, choose)


def model_stacks(
    frames: Tensor,
    motion: FrameMotion,
    *,
    noise: float | Literal["auto"] = "auto",
    ignore: Tensor | None = None,
    clipped: Tensor | None = None,
    scale: int = 1,
    strips: int = 1,
) -> list[StackModel]:
    """Displacement, period, noise levels and prior of each stack; arguments as in ``restore_exact``."""
    B, T, _, H, W = frames.shape
    unknown = ignore if clipped is None else clipped if ignore is None else ignore | clipped
    mean = brightness(frames).mean(1)[..., None, None]

    # Displacement of each row during its exposure, and the period of the scene that it requires.
    displacement, node_weights = motion.exposures(H)
    periods = scene_periods(motion, displacement, W)

    # Noise level of each frame. That of a single frame may include texture.
    given = None if noise == "auto" else given_level(noise)
    powers = frames.new_full((B, T), 1.0 if given is None else given**2)
    if given is None:
        # Two strips of the same frames give their noise as well as all of them, in a fraction of the time. Saturated
        # pixels have no noise: with a quarter of a frame saturated, the level was 0, and the PSNR 4 dB lower.
        chosen = sorted({strips // 4, strips - 1 - strips // 4})
        for first in range(0, B, strips):
            measured = [
                noise_levels(frames[index].detach(), motion, index, None if unknown is None else unknown[index])
                for index in (first + strip for strip in chosen)
            ]
            powers[first : first + strips] = torch.stack(measured).square().mean(0)
    levels = powers.sqrt().clamp(min=_MIN_LEVEL)
    frame_weights = levels.square().reciprocal()
    unit_variance = frame_weights.mean(1).reciprocal()

    # Prior of each stack, fitted to its frames.
    fit = fit_prior if scale == 1 else fit_polynomial_prior
    stacks: list[StackModel] = []
    for index in range(B):
        strip = index % strips
        period = max(periods[index - strip : index - strip + strips])
        stacks.append(
            StackModel(
                frames=frames[index],
                displacement=displacement[index],
                node_weights=node_weights,
                shift=motion.shift[index],
                weights=frame_weights[index] * unit_variance[index],
                level=unit_variance[index].sqrt(),
                level_is_certain=given is not None or T > 1,
                mean=mean[index],
                prior=fit(frames[index], motion, index, levels[index], period),
                strength_cache=stacks[-1].strength_cache if strip else StrengthCache(),
                period=period,
                scale=scale,
                unknown=None if unknown is None else unknown[index],
                clipped=None if clipped is None else clipped[index],
                fills_ends=strip in (0, strips - 1),
            )
        )
    return stacks


def scene_periods(motion: FrameMotion, displacement: Tensor, width: int) -> list[int]:
    """Period of the scenes of each stack of ``width`` px with displacement (B, T, R, N, 2) during the exposures."""
    along = displacement[..., 0].detach()
    # the boundary extension of blurred rows is filled; that of others is longer
    filled = ((along.amax(-1) - along.amin(-1)).amax((1, 2)) > 2 * FILLED_BLUR_REACH).tolist()
    # px beyond the displacement that influence the ends
    margins = [8 + bound for bound in motion.displacement_bounds(displacement.shape[2])]
    return [
        fast_length(width + 2 * margin) if is_filled else extended_length(width, margin)
        for is_filled, margin in zip(filled, margins, strict=True)
    ]


def given_level(noise: float) -> float:
    """A stated noise level, at least the lowest that single precision supports."""
    return max(noise, _MIN_LEVEL)


@dataclass(frozen=True, eq=False)
class SceneTask:
    """A scene that is to be restored from frames of one stack.

    Attributes:
        stack: The stack.
        members: Its frames that contribute.
        reference: The frame in whose coordinates the scene is restored.
        strength: Factor on the prior.
    """

    stack: StackModel
    members: list[int]
    reference: int
    strength: float

    def problem(self, partition: Partition) -> SceneProblem | Incomplete | Extended:
        """The least-squares problem of the scene, with the values that are missing."""
        stack, members = self.stack, self.members
        height, width = stack.frames.shape[-2:]

        # Data with zero mean, rows extended to a period.
        data = extend_rows(stack.frames[members] - stack.mean, stack.period)

        # Observation operator, and precision of the prior.
        kernels = stack.kernels(members, self.reference)
        observation = GRIDS[stack.scale][1](kernels, height, stack.period, data.dtype)
        precision = stack.prior.of(members).precision(
            stack.level.square(), strength=self.strength, blur_reach=kernels.blur_reach
        )
        problem = SceneProblem(data, observation, precision, stack.level, partition)

        # Values that are missing: the boundary extension of blurred rows, and pixels without data.
        along = stack.shift[members, 0] - stack.shift[self.reference, 0]
        unknown = None if stack.unknown is None else stack.unknown[members]
        ends = (kernels.blur_reach > FILLED_BLUR_REACH and stack.fills_ends) or stack.scale > 1
        if unknown is None and ends and not bool(along.any()):
            # on the finer grid, extensions of different frames contradict each other beyond half a cycle per px:
            # filled, 49.9 dB become 53.9 dB (8 frames of 256 px, noise 0.002)
            return Extended(problem, width)
        measured = measured_values(along, unknown, data.shape, width, ends=ends)
        if measured is None:
            return problem
        floor = None
        if stack.clipped is not None:  # saturated pixels are at least as bright as their value
            floor = torch.full_like(data, -torch.inf)
            floor[..., :width] = torch.where(stack.clipped[members], data[..., :width], -torch.inf)
        return Incomplete(problem, measured, floor)


_FILLED_TOGETHER = 8  # batches; four frames of 1024 rows take 0.79 s together, 1.19 s two by two in two threads


def solve_scenes(
    tasks: list[SceneTask],
    prior: Prior,
    regularisation: float,
    partition: Partition,
    neglected: float = 0.0,
    filled_together: int = _FILLED_TOGETHER,
) -> tuple[Tensor, list[FrameDifference]]:
    """Images of scenes of one size.

    Args:
        tasks: The scenes.
        prior: Prior of all scenes.
        regularisation: Factor on the strength of the prior.
        partition: Parts solved at a time.
        neglected: As in ``FrameMotion``.
        filled_together: Batches whose missing values are filled together: more are faster and need more memory.

    Returns:
        Images (N, C, S H, S W), and, on the finer grid, the differences of the frames of each scene.
    """
    stack = tasks[0].stack
    device, (_, channels, height, width) = stack.frames.device, stack.frames.shape
    solve = partial(_solutions, stack=stack, prior=prior, regularisation=regularisation, neglected=neglected)

    # With gradients, one scene after the other.
    inputs = (value for task in tasks for value in (task.stack.frames, task.stack.displacement))
    if torch.is_grad_enabled() and any(value.requires_grad for value in inputs):
        solutions = [solution for task in tasks for solution in solve(filled([task.problem(partition)]))]
        restored = torch.stack([image + task.stack.mean for task, (image, _) in zip(tasks, solutions, strict=True)])
        return restored, [difference for _, difference in solutions if difference is not None]

    batches = _batches(tasks, together=prior.is_precision and stack.scale == 1)
    threads = min(Partition.threads(device), len(batches))
    # each thread has its own memory
    partitions = [partition, *(Partition(partition.chunk, partition.segments) for _ in range(threads - 1))]
    images = stack.frames.new_empty(len(tasks), channels, stack.scale * height, stack.scale * width)
    differences: list[FrameDifference] = []
    advance = steps(len(batches), "frames")

    def solve_share(block: list[list[int]], problems: dict[int, SceneProblem], thread: int) -> None:
        """Solve the batches of a block that a thread takes."""
        for batch in block[thread::threads]:
            solutions = solve([replace(problems[number], partition=partitions[thread]) for number in batch])
            for number, (image, difference) in zip(batch, solutions, strict=True):
                images[number] = image + tasks[number].stack.mean
                if difference is not None:
                    differences.append(difference)
            advance()

    for place in runs(len(batches), filled_together):
        # Build the problems of a block of batches.
        numbers = [number for batch in batches[place] for number in batch]
        incomplete = in_parallel(lambda number: tasks[number].problem(partition), numbers, device)
        # Fill missing values before the threads share the block: the extensions of all its scenes are solved together.
        with torch.no_grad():
            problems = dict(zip(numbers, filled(incomplete), strict=True))
        # Solve the systems of the complete data.
        in_parallel(partial(solve_share, batches[place], problems), range(threads), device)
    return images, differences


def _batches(tasks: list[SceneTask], *, together: bool) -> list[list[int]]:
    """Numbers of the scenes whose systems are solved in one batch, or of single scenes.

    Scenes of few frequencies are solved together, as many as two threads leave for each. Those in the coordinates of
    the same frame have systems of about one size, and need no extension.
    """
    size = 1
    if together:
        frequencies = max(task.stack.period for task in tasks) // 2 + 1
        threads = Partition.threads(tasks[0].stack.frames.device)
        size = max(1, min(SIDE_BY_SIDE // frequencies, -(-len(tasks) // threads)))
    batches: list[list[int]] = []
    for reference in sorted({task.reference for task in tasks}):
        numbers = [number for number, task in enumerate(tasks) if task.reference == reference]
        batches += [numbers[place] for place in runs(len(numbers), size)]
    return batches


def _solutions(
    problems: list[SceneProblem], stack: StackModel, prior: Prior, regularisation: float, neglected: float
) -> list[tuple[Tensor, FrameDifference | None]]:
    """Deviations (C, S H, S W) of scenes from their brightness for complete data, and differences on the finer grid."""
    width = stack.frames.shape[-1]
    solutions: list[tuple[Tensor, FrameDifference | None]]
    if stack.scale != 1:
        solutions = [finer_scene(problem, width, neglected) for problem in problems]
    elif prior.is_precision and len(problems) > 1:
        images = SolversSideBySide(problems).images([problem.data for problem in problems])
        solutions = [(image, None) for image in images]
    else:
        solutions = [(prior.function(problem, regularisation), None) for problem in problems]
    return [(image[..., : stack.scale * width], difference) for image, difference in solutions]
