"""Exact restoration: all rows of a frame, each with its own PSF, solved together.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.core.checks import MAX_NUMBER, check_choice, check_number
from rsvib_torch.core.fourier import extend_rows, extended_length, fast_length
from rsvib_torch.core.parallel import in_parallel
from rsvib_torch.core.progress import steps
from rsvib_torch.frames.pixels import fill_with_means
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.exact.filling import (
    FILLED_REACH,
    Extended,
    Incomplete,
    filled,
    measured_values,
)
from rsvib_torch.restoration.exact.finer_scene import Misfit, finer_scene, warn_of_frames
from rsvib_torch.restoration.exact.priors import PRIORS, PriorOptions, check_prior
from rsvib_torch.restoration.exact.scene_solver import Partition, SceneProblem, SolversSideBySide
from rsvib_torch.restoration.exact.strength import Strengths, prior_strength
from rsvib_torch.restoration.frame_motion import FrameMotion, joint_groups
from rsvib_torch.restoration.noise import noise_levels
from rsvib_torch.restoration.scene_model.observation import (
    SCALE,
    FinerObservation,
    Observation,
    RowKernels,
    finer_kernels,
    row_kernels,
)
from rsvib_torch.restoration.scene_model.polynomial_prior import PolynomialPrior, fit_polynomial_prior
from rsvib_torch.restoration.scene_model.row_prior import RowPrior, brightness, fit_prior

__all__ = ["given_level", "restore_exact", "row_exposures", "scene_period"]

_MIN_LEVEL = 1e-5  # of full scale, lowest noise level assumed; below, the systems lose digits in single precision


def restore_exact(
    frames: Tensor,
    motion: FrameMotion,
    *,
    joint: bool | int = False,
    prior: str = "gaussian",
    noise: float | Literal["auto"] = "auto",
    regularisation: float = 1.0,
    ignore: Tensor | None = None,
    clipped: Tensor | None = None,
    chunk_frequencies: int | None = None,
    segments: int | None = None,
    scale: Literal[1, 2] = 1,
) -> Tensor:
    """Restore frames with all rows coupled: the most probable scene for its frames and a prior.

    The kernel changes from row to row but not along a row. So the Fourier transform is taken along rows only, and for
    each horizontal frequency the frame g is a banded matrix K times the coefficients c of the scene across rows, from
    which a kernel of six rows interpolates. Least squares with an autoregressive prior across rows, fitted to the
    frames, is one banded Hermitian positive definite system ``(sum_m w_m K_m^H K_m + P) c = sum_m w_m K_m^H g_m`` per
    frequency. The interpolation error of the kernel counts as noise. Several frames of one scene add their normal
    matrices.

    Args:
        frames: (B, T, C, H, W) in row order.
        motion: Motion of the frames.
        joint: ``True``: one image from all frames, in the coordinates of the middle one (the time axis keeps length
            1); a number K: every frame from K neighbouring ones; ``False``: every frame from itself. With image motion,
            only what a frame has in common with the restored one is used.
        prior: Name in ``PRIORS``. ``"gaussian"``: rows predict their neighbours, one fast solution; ``"edges"``:
            moreover, every patch of 8 x 8 px is a sum of few cosines, which separates edges and flat areas from noise;
            several times slower.
        noise: Standard deviation of the noise (full scale 1); ``"auto"`` estimates it for every frame. Noise and
            texture are distinguished with two frames or with blur, and only within bounds with one sharp frame, see
            ``noise_levels``.
        regularisation: Factor on the prior; 1 is the strength estimated from the frames.
        ignore: Boolean mask shaped like the frames of missing pixels; their values are not used, and are estimated from
            all others.
        clipped: Boolean mask of saturated pixels, whose values are lower bounds.
        chunk_frequencies: Frequencies solved at a time; bounds the memory, does not change the result. None: as many
            as take 8 times the memory of the spectrum of the scene, or 16 times where the displacement changes by more
            than a pixel during an exposure.
        segments: Overlapping segments of rows that are solved side by side, which changes the result by about 1e-5;
            None: segments of at least 512 rows on a CPU, 256 on a GPU.
            Always one where the displacement changes by more than a pixel during an exposure: rows then depend on
            distant rows.
        scale: Points of the restored frames per pixel along both axes, 1 or 2. With 2, the unknown is the scene after
            optics and pixel on a grid of half pixels, and aliasing is part of the model: several frames that sample
            between each other's pixels contain detail beyond half a cycle per px, one frame does not. The prior is then
            a polynomial in the Laplacians of both axes (``PolynomialPrior``). ``restoration_mtf`` measures which detail
            the restored frames contain.

    Returns:
        Restored frames of the same shape, or (B, 1, C, H, W); with ``scale=2``, of twice the rows and columns, point
        (2 i, 2 j) at pixel (i, j).
    """
    # 1. Options. Missing pixels hold local means until step 6.
    B, T, _, H, W = frames.shape
    factor = check_number("regularisation", regularisation, above=0.0)
    check_choice("scale", scale, (1, SCALE))
    check_prior(prior, scale=scale)
    groups = joint_groups(T, joint)
    partition = Partition.of_options(chunk_frequencies, segments)
    if ignore is not None:
        frames = fill_with_means(frames, ignore)
    missing = ignore if clipped is None else clipped if ignore is None else ignore | clipped

    # 2. Displacement of each row during its exposure, and the period of the scene that it requires.
    displacement, node_weights = row_exposures(motion, frames)
    periods = _periods(W, motion.strips, motion.reaches(H), displacement)

    # 3. Noise level of each frame, which determines the weights of the frames.
    levels = _noise_levels(frames, motion, noise, ignore)
    mean = brightness(frames).mean(1)[..., None, None]

    # 4. Prior of each stack, fitted to its frames, and the scenes that are restored from the stack.
    fit = fit_prior if scale == 1 else fit_polynomial_prior
    scenes: list[_Scene] = []
    for index in range(B):
        if index % motion.strips == 0:
            strengths = Strengths()  # strips of the same frames share them
        weights = levels[index].square().reciprocal()
        typical = weights.mean().reciprocal()
        length = periods[index // motion.strips]
        stack = _Stack(
            frames=frames[index],
            displacement=displacement[index],
            node_weights=node_weights,
            shift=motion.shift[index],
            weights=weights * typical,
            level=typical.sqrt(),
            mean=mean[index],
            prior=fit(frames[index], motion, index, levels[index], length),
            length=length,
            scale=scale,
            missing=None if missing is None else missing[index],
            clipped=None if clipped is None else clipped[index],
            at_ends=index % motion.strips in (0, motion.strips - 1),
        )
        # 5. Strength of the prior of each scene, by cross-validation.
        for members, reference in groups if missing is None else _without_empty_frames(groups, missing[index]):
            strength = stack.strength(members, reference, strengths, certain=noise != "auto" or T > 1)
            scenes.append(_Scene(stack, members, reference, factor * strength))

    # 6. Missing values are filled, and the banded systems of all frequencies solved.
    solve = _Solution(prior, factor, motion.neglected)
    if torch.is_grad_enabled() and (frames.requires_grad or displacement.requires_grad):
        images = torch.stack([solve([scene], filled([scene.problem(partition)]))[0] for scene in scenes])
    else:
        together = motion.strips if PRIORS[prior].is_precision and scale == 1 else 1
        images = _solve_in_parallel(scenes, solve, _tasks(len(scenes), len(scenes) // B, together), partition)

    # 7. On the finer grid, frames that contradict their scene show that the motion is wrong.
    if scale != 1:
        warn_of_frames(solve.misfits, (scene.stack.places(scene.members) for scene in scenes))
    return images.view(B, -1, *images.shape[1:])


class _Solution:
    """Images of scenes without missing values.

    Args:
        prior: Name in ``PRIORS``.
        regularisation: Factor on the prior.
        neglected: As in ``FrameMotion``.

    Attributes:
        misfits: Of the scenes solved so far on the finer grid.
    """

    def __init__(self, prior: str, regularisation: float, neglected: float) -> None:
        self._prior, self._options, self._neglected = PRIORS[prior], PriorOptions(regularisation), neglected
        self.misfits: list[Misfit] = []

    def __call__(self, scenes: list["_Scene"], problems: list[SceneProblem]) -> list[Tensor]:
        """Images (C, scale R, scale W) of scenes that are solved together; several are those of strips."""
        stack = scenes[0].stack
        if stack.scale != 1:
            finer, misfit = finer_scene(problems[0], stack.width, self._neglected)
            solved = [finer]
            self.misfits.append(misfit)
        elif len(problems) > 1:
            solved = SolversSideBySide(problems).scenes([problem.data for problem in problems])
        else:
            solved = [self._prior.function(problems[0], self._options)]
        return [
            image[..., : stack.scale * stack.width] + scene.stack.mean
            for image, scene in zip(solved, scenes, strict=True)
        ]


def _tasks(scenes: int, of_stack: int, together: int) -> list[list[int]]:
    """Numbers of the scenes that are solved together: those of so many neighbouring stacks with the same frames."""
    return [
        list(range(first + scene, first + together * of_stack, of_stack))
        for first in range(0, scenes, together * of_stack)
        for scene in range(of_stack)
    ]


_FILLED_TOGETHER = 8  # tasks; four frames of 1024 rows take 0.79 s together, 1.19 s two by two in two threads


def _solve_in_parallel(
    scenes: list["_Scene"], solve: _Solution, tasks: list[list[int]], partition: Partition
) -> Tensor:
    """Images of the scenes of all tasks, which are solved side by side, each thread in its own memory."""
    stack = scenes[0].stack
    _, channels, height, width = stack.frames.shape
    images = stack.frames.new_empty(len(scenes), channels, stack.scale * height, stack.scale * width)
    device = images.device
    threads = min(Partition.threads(device), len(tasks))
    partitions = [Partition(partition.chunk, partition.segments) for _ in range(threads)]
    advance = steps(len(tasks), "frames")

    def build(share: tuple[Partition, list[list[int]]]) -> list[SceneProblem | Incomplete | Extended]:
        return [scenes[number].problem(share[0]) for numbers in share[1] for number in numbers]

    def solve_share(share: tuple[list[SceneProblem], list[list[int]]]) -> None:
        problems = iter(share[0])
        for numbers in share[1]:
            solved = solve([scenes[number] for number in numbers], [next(problems) for _ in numbers])
            for number, image in zip(numbers, solved, strict=True):
                images[number] = image
            advance()

    for first in range(0, len(tasks), _FILLED_TOGETHER):
        shares = [tasks[first : first + _FILLED_TOGETHER][thread::threads] for thread in range(threads)]
        built = in_parallel(build, zip(partitions, shares, strict=True), device)
        with torch.no_grad():
            complete = iter(filled([scene for part in built for scene in part]))
        problems = [[next(complete) for _ in part] for part in built]
        in_parallel(solve_share, zip(problems, shares, strict=True), device)
    return images


@dataclass(frozen=True, eq=False)
class _Stack:
    """One stack of frames, and the quantities that the scenes restored from it have in common.

    Attributes:
        frames: (T, C, H, W).
        displacement: (T, H, N, 2) during the exposures, at N nodes with weights ``node_weights``.
        node_weights: (N,).
        shift: (T, 2) reference shifts of the frames.
        weights: (T,) weights of the frames.
        level: Standard deviation of the noise of a frame of weight 1.
        mean: (C, 1, 1) brightness; the prior is for deviations from it.
        prior: Of all frames.
        length: L, the period of the restored scenes in px.
        scale: Points of the restored scenes per px.
        missing: (T, C, H, W) bool, missing and saturated pixels; None for none.
        clipped: Likewise, the saturated ones.
        at_ends: Whether the frames contain an end of the rows: whole frames, the first and the last strip of columns.
            The others end beyond their columns with weight; to fill their extension takes half the time, for 0.00 dB.
    """

    frames: Tensor
    displacement: Tensor
    node_weights: Tensor
    shift: Tensor
    weights: Tensor
    level: Tensor
    mean: Tensor
    prior: RowPrior | PolynomialPrior
    length: int
    scale: int
    missing: Tensor | None
    clipped: Tensor | None
    at_ends: bool

    @property
    def width(self) -> int:
        """W, the columns of the frames."""
        return self.frames.shape[-1]

    @property
    def noise_power(self) -> Tensor:
        """Of a frame of weight 1, in the units of the prior."""
        return self.level.square() * self.length

    def kernels(self, members: list[int], reference: int) -> RowKernels:
        """Kernels of some frames, in the coordinates of one of them."""
        moved = self.displacement[members] - self.shift[reference]
        # a scene extends up to 16 rows beyond the frame; rows displaced further have weight 0
        make = row_kernels if self.scale == 1 else finer_kernels
        return make(moved, self.node_weights, self.weights[members], self.frames.shape[-2], 16)

    def places(self, members: list[int]) -> Tensor:
        """Mean displacement (M, R, 2) of the rows of some frames."""
        return (self.displacement[members].detach() * self.node_weights[:, None]).sum(-2)

    def strength(self, members: list[int], reference: int, strengths: Strengths, *, certain: bool) -> float:
        """Factor on the prior, estimated from those frames whose columns are the same as in the restored one."""
        if isinstance(self.prior, PolynomialPrior):
            return 1.0
        alike = [frame for frame in members if torch.equal(self.shift[frame], self.shift[reference])]
        prior, power = self.prior.of(members), self.noise_power

        def choose() -> float:
            kernels = self.kernels(alike, reference)
            return prior_strength(self.frames[alike], kernels, prior, power, certain=certain)

        return strengths.of(power / self.weights[alike].mean() + prior.interpolation_power.mean(), choose)

    def problem(
        self, members: list[int], reference: int, strength: float, partition: Partition
    ) -> SceneProblem | Incomplete | Extended:
        """The problem of one scene, with the values that are missing."""
        height, width = self.frames.shape[-2:]
        kernels = self.kernels(members, reference)
        if isinstance(self.prior, PolynomialPrior):
            precision = self.prior.precision(self.level.square(), strength, self.length, kernels.reach)
        else:
            precision = self.prior.of(members).precision(self.noise_power, strength, kernels.reach)
        along = self.shift[members, 0] - self.shift[reference, 0]
        neighbours = members == list(range(members[0], members[-1] + 1))  # a view instead of a copy
        frames = self.frames[members[0] : members[-1] + 1] if neighbours else self.frames[members]
        data = extend_rows(frames, self.length).sub_(self.mean)
        observe = Observation if self.scale == 1 else FinerObservation
        problem = SceneProblem(data, observe(kernels, height, data.dtype), precision, self.level, partition)
        missing = None if self.missing is None else self.missing[members]
        ends = (kernels.reach > FILLED_REACH and self.at_ends) or self.scale > 1
        if missing is None and ends and not bool(along.any()):
            # on the finer grid, extensions of different frames contradict each other beyond half a cycle per px:
            # filled, 49.9 dB become 53.9 dB (8 frames of 256 px, noise 0.002)
            return Extended(problem, width)
        measured = measured_values(along, missing, data.shape, width, ends=ends)
        if measured is None:
            return problem
        floor = None
        if self.clipped is not None:  # saturated pixels are at least as bright as their value
            floor = torch.full_like(data, -torch.inf)
            floor[..., :width] = torch.where(self.clipped[members], data[..., :width], -torch.inf)
        return Incomplete(problem, measured, floor)


@dataclass(frozen=True, eq=False)
class _Scene:
    """A scene that is restored from frames of one stack.

    Attributes:
        stack: The stack.
        members: Its frames that contribute.
        reference: The frame in whose coordinates the scene is restored.
        strength: Factor on the prior.
    """

    stack: _Stack
    members: list[int]
    reference: int
    strength: float

    def problem(self, partition: Partition) -> SceneProblem | Incomplete | Extended:
        """The problem of the scene, with the values that are missing."""
        return self.stack.problem(self.members, self.reference, self.strength, partition)


def row_exposures(motion: FrameMotion, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Displacement (B, T, H, N, 2) in px of the rows of frames (B, T, C, H, W) at N nodes, and the weights (N,)."""
    batch, count, _, height, _ = frames.shape
    rows = torch.arange(height, dtype=torch.float64, device=frames.device)
    starts = motion.row_starts(rows).expand(batch, count, height)
    return exposure_trajectory(motion.vibration, starts, motion.timing, "gauss")


def scene_period(width: int, reach: int, displacement: Tensor) -> int:
    """Period L of a restored scene of ``width`` px: longer where the boundary extension is not filled.

    Args:
        width: Columns of the frames.
        reach: Bound on the displacement along a row in px.
        displacement: (..., N, 2) during the exposures.
    """
    along = displacement[..., 0].detach()
    extended = bool((along.amax(-1) - along.amin(-1)).amax() > 2 * FILLED_REACH)
    # px beyond the displacement that influence the ends
    return fast_length(width + 2 * (8 + reach)) if extended else extended_length(width, reach + 8)


def _periods(width: int, strips: int, reaches: Sequence[int], displacement: Tensor) -> list[int]:
    """Period of the scenes of each stack, the same for all of its strips, which are neighbours in the batch."""
    each = [scene_period(width, reach, moved) for reach, moved in zip(reaches, displacement, strict=True)]
    return [max(each[first : first + strips]) for first in range(0, len(each), strips)]


def _without_empty_frames(groups: list[tuple[list[int], int]], missing: Tensor) -> list[tuple[list[int], int]]:
    """Groups of frames without those with at most 5 % measured pixels, unless they have no others."""
    share = (~missing).double().flatten(1).mean(1).tolist()
    return [([m for m in members if share[m] > 0.05] or members, reference) for members, reference in groups]


def given_level(noise: float) -> float:
    """A stated noise level, at least the lowest that single precision supports."""
    return max(check_number("noise", noise, at_least=0.0, at_most=MAX_NUMBER), _MIN_LEVEL)


def _noise_levels(frames: Tensor, motion: FrameMotion, noise: float | Literal["auto"], ignore: Tensor | None) -> Tensor:
    """Noise level of each frame, (B, T)."""
    if noise != "auto":
        return torch.full(frames.shape[:2], given_level(noise), dtype=frames.dtype, device=frames.device)
    # strips of the same frames have one noise: two of them give it as well as all of them, in a fraction of the time
    chosen = sorted({motion.strips // 4, motion.strips - 1 - motion.strips // 4})
    powers = []
    for first in range(0, len(frames), motion.strips):
        each = [
            noise_levels(frames[index].detach(), motion, index, None if ignore is None else ignore[index])
            for index in (first + strip for strip in chosen)
        ]
        powers += [torch.stack(each).square().mean(0)] * motion.strips
    return torch.stack(powers).sqrt().clamp(min=_MIN_LEVEL)
