"""Exact restoration: all rows of a frame, each with its own PSF, solved together."""

from dataclasses import dataclass, replace
from threading import Lock
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_choice, check_number, check_whole_number
from rsvib_torch.core.parallel import in_parallel
from rsvib_torch.frames.missing import fill_roughly
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.exact.edge_prior import expectation, expectation_precision, stages
from rsvib_torch.restoration.exact.filling import fill_beyond_ends, fill_unmeasured
from rsvib_torch.restoration.exact.measured import measured_values
from rsvib_torch.restoration.exact.partition import Partition
from rsvib_torch.restoration.exact.scene_problem import SceneProblem
from rsvib_torch.restoration.exact.strength import Strengths, prior_strength
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.joint_groups import joint_groups
from rsvib_torch.restoration.noise.noise_levels import noise_levels
from rsvib_torch.restoration.row_extension import continue_rows, period_of_rows
from rsvib_torch.restoration.scene_model.observation import SeenScene
from rsvib_torch.restoration.scene_model.row_prior import RowPrior, brightness, fit_prior
from rsvib_torch.restoration.scene_model.row_system import RowKernels, row_kernels

__all__ = ["ScenePrior", "restore_exact", "scene_period"]

ScenePrior = Literal["gaussian", "edges"]

_MARGIN = 16  # rows beyond the frame that it may see
_LONG = 1.0  # px along the row either way: beyond, ends of rows are worth being continued by what the blur demands
_REACH = 8  # px beyond the displacement that ends say something of where they are not filled so
_LOOSE, _REST = 0.3, 0.03  # parts of the quadratic prior that patches start from and keep
_SHOWN = 0.05  # of its pixels: a frame of which no more was measured is not joined with others
_QUIETEST = 1e-5  # lowest noise level assumed, of full scale


def scene_period(width: int, reach: int, displacement: Tensor) -> int:
    """Length of the period that a scene of ``width`` px is restored on: longer where ends are not filled.

    Args:
        width: Columns of the frames.
        reach: Bound on the displacement along a row in px.
        displacement: (..., N, 2) during the exposures.
    """
    along = displacement[..., 0].detach()
    filled = bool((along.amax(-1) - along.amin(-1)).amax() > 2 * _LONG)
    return period_of_rows(width, reach if filled else reach + _REACH)


def _with_edges(problem: SceneProblem, factor: float) -> Tensor:
    """Restore one scene (C, R, L) with a prior of few cosines in every patch, by half-quadratic splitting."""
    weak = replace(problem, precision=_LOOSE * problem.precision).solver()
    coefficients = weak.fit(problem.data)
    solver, weight = weak, float(problem.seen.kernels.weight.detach().mean(-1).sum())
    for strength, level, step in stages(blurred=problem.seen.kernels.blurred):
        pull = strength * weight * factor
        frequencies = problem.precision.shape[-1]
        precision = expectation_precision(pull, frequencies, problem.precision)
        order = problem.precision.shape[0]
        precision[:order, :order] += _REST * problem.precision
        target = expectation(solver, coefficients, level * factor**0.5 * problem.level / weight**0.5, pull, step)
        solver = replace(problem, precision=precision).solver()
        coefficients = solver.fit(problem.data, target)
    return solver.scene(coefficients)


def _restore_group(problem: SceneProblem, edges: float | None, level: Tensor, width: int, out: Tensor | None) -> Tensor:
    """Restore one scene (C, R, W) from M frames, all values of which are measured or filled.

    The prior is for deviations from a brightness ``level`` (C, 1, 1), which is added where the scene is written.
    """
    if edges is not None:
        return torch.add(_with_edges(problem, edges)[..., :width], level, out=out)
    return problem.solver().fit_scene(problem.data, width, level, out)


def _floor(data: Tensor, clipped: Tensor) -> Tensor:
    """Least values (M, C, R, L) of what was not measured: of saturated pixels (M, C, R, W) what they hold."""
    bottomless = torch.full_like(data, -torch.inf)
    width = clipped.shape[-1]
    bottomless[..., :width] = torch.where(clipped, data[..., :width], -torch.inf)
    return bottomless


@dataclass(frozen=True, eq=False)
class _Stack:
    """One stack of frames, with what the scenes that are restored from it have in common.

    Attributes:
        frames: (T, C, H, W).
        displacement: (T, H, N, 2) during the exposures, at N nodes with weights ``node_weights``.
        node_weights: (N,).
        shift: (T, 2) reference shifts of the frames.
        weights: (T,) how much each counts.
        level: Standard deviation of the noise of a frame of weight 1.
        mean: (C, 1, 1) brightness, that the prior is for deviations from.
        prior: Of all frames.
        length: L, of the period that scenes are restored on.
        lost: (T, C, H, W) bool, pixels that do not count; None for none.
        clipped: Likewise, those of them that are saturated.
    """

    frames: Tensor
    displacement: Tensor
    node_weights: Tensor
    shift: Tensor
    weights: Tensor
    level: Tensor
    mean: Tensor
    prior: RowPrior
    length: int
    lost: Tensor | None
    clipped: Tensor | None

    @property
    def noise_power(self) -> Tensor:
        """Of a frame of weight 1, in the units of the prior."""
        return self.level.square() * self.length

    def kernels(self, members: list[int], reference: int) -> RowKernels:
        """How some frames see the scene, in the coordinates of one of them."""
        moved = self.displacement[members] - self.shift[reference]
        return row_kernels(moved, self.node_weights, self.weights[members], self.frames.shape[-2], _MARGIN)

    def strength(self, members: list[int], reference: int, known: Strengths, *, certain: bool) -> float:
        """Factor on the prior, as those frames ask for that show the same columns as the restored one."""
        alike = [frame for frame in members if torch.equal(self.shift[frame], self.shift[reference])]
        prior, power = self.prior.of(members), self.noise_power

        def chosen() -> float:
            kernels = self.kernels(alike, reference)
            return prior_strength(self.frames[alike], kernels, prior, power, certain=certain)

        return known.of(power / self.weights[alike].mean() + prior.blind.mean(), chosen)

    def problem(self, members: list[int], reference: int, strength: float, partition: Partition) -> SceneProblem:
        """What is to be solved for a scene, all values of which are measured or filled."""
        height, width = self.frames.shape[-2:]
        kernels = self.kernels(members, reference)
        precision = self.prior.of(members).precision(self.noise_power, strength, kernels.reach)
        along = self.shift[members, 0] - self.shift[reference, 0]
        neighbours = members == list(range(members[0], members[-1] + 1))  # need not be copied
        frames = self.frames[members[0] : members[-1] + 1] if neighbours else self.frames[members]
        data = continue_rows(frames, self.length).sub_(self.mean)
        problem = SceneProblem(data, SeenScene(kernels, height, data.dtype), precision, self.level, partition)
        hidden = None if self.lost is None else self.lost[members]
        ends = kernels.reach > _LONG
        if hidden is None and ends and not bool(along.any()):
            return replace(problem, data=fill_beyond_ends(problem, width, kernels.reach))
        measured = measured_values(along, hidden, data.shape, width, ends=ends)
        if measured is None:
            return problem
        floor = None if self.clipped is None else _floor(data, self.clipped[members])
        return replace(problem, data=fill_unmeasured(problem, measured, floor))


def restore_exact(
    frames: Tensor,
    motion: FrameMotion,
    *,
    joint: bool | int = False,
    prior: ScenePrior = "gaussian",
    noise: float | Literal["auto"] = "auto",
    regularisation: float = 1.0,
    ignore: Tensor | None = None,
    clipped: Tensor | None = None,
    chunk_frequencies: int | None = None,
    segments: int | None = None,
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
        prior: ``"gaussian"``: rows predict their neighbours, one fast solution; ``"edges"``: moreover, every patch of
            8 x 8 px is made of few cosines, which keeps edges and flat ground apart from noise; several times slower.
        noise: Standard deviation of the noise (full scale 1); ``"auto"`` estimates it for every frame. Two frames, or
            blur, tell it from texture; one sharp frame does so within bounds only, see ``noise_floor``.
        regularisation: Factor on the prior; 1 is what the frames ask for.
        ignore: Boolean mask shaped like the frames of pixels that do not count; they may hold anything, and are filled
            with what the others say.
        clipped: Boolean mask of saturated pixels: what they would have shown is at least what they hold.
        chunk_frequencies: Frequencies solved at a time; bounds the memory, does not change the result. None: as many
            as take eight times the memory of the scene.
        segments: Overlapping segments of rows that are solved side by side, which changes the result by about 1e-5;
            None: as many as make a step worth its call, of at least 512 rows on a CPU, 256 on a GPU. Always one where
            the scene moves by more than a pixel during an exposure: rows then depend on rows far away.

    Returns:
        Restored frames of the same shape, or (B, 1, C, H, W).
    """
    B, T, _, H, W = frames.shape
    factor = check_number("regularisation", regularisation, above=0.0)
    check_choice("prior", prior, ("gaussian", "edges"))
    groups = joint_groups(T, joint)
    chunk, split = (
        None if value is None else check_whole_number(name, value, at_least=1)
        for name, value in (("chunk_frequencies", chunk_frequencies), ("segments", segments))
    )
    if ignore is not None:
        frames = fill_roughly(frames, ignore)
    lost = ignore if clipped is None else clipped if ignore is None else ignore | clipped
    levels = _noise_levels(frames, motion, noise, ignore)
    mean = brightness(frames).mean(1)[..., None, None]
    starts = motion.row_starts(torch.arange(H, dtype=torch.float64, device=frames.device)).expand(B, T, H)
    displacement, node_weights = exposure_trajectory(motion.vibration, starts, motion.timing, "gauss")
    reaches = motion.reaches(H)
    certain = noise != "auto" or T > 1
    problems: list[tuple[_Stack, list[int], int, float]] = []
    for index in range(B):
        weights = levels[index].square().reciprocal()
        typical = weights.mean().reciprocal()
        length = scene_period(W, reaches[index], displacement[index])
        stack = _Stack(
            frames=frames[index],
            displacement=displacement[index],
            node_weights=node_weights,
            shift=motion.shift[index],
            weights=weights * typical,
            level=typical.sqrt(),
            mean=mean[index],
            prior=fit_prior(frames[index], motion, index, levels[index], length),
            length=length,
            lost=None if lost is None else lost[index],
            clipped=None if clipped is None else clipped[index],
        )
        known = Strengths()
        shown = groups if lost is None else _that_show_something(groups, lost[index])
        problems += [(stack, *group, factor * stack.strength(*group, known, certain=certain)) for group in shown]

    def restored(number: int, partition: Partition, out: Tensor | None = None) -> Tensor:
        stack, members, reference, strength = problems[number]
        problem = stack.problem(members, reference, strength, partition)
        return _restore_group(problem, factor if prior == "edges" else None, stack.mean, W, out)

    count = len(problems)
    if torch.is_grad_enabled() and (frames.requires_grad or displacement.requires_grad):
        partition = Partition(chunk, split)
        images = torch.stack([restored(number, partition) for number in range(count)])
        return images.view(B, -1, *images.shape[1:])
    found = frames.new_empty(count, *frames.shape[2:])
    threads, lock = min(Partition.threads(frames.device), count), Lock()

    def share(thread: int) -> None:
        partition = Partition(chunk, split, lock)
        for number in range(thread, count, threads):
            restored(number, partition, found[number])

    in_parallel(share, range(threads), frames.device)
    return found.view(B, -1, *found.shape[1:])


def _that_show_something(groups: list[tuple[list[int], int]], lost: Tensor) -> list[tuple[list[int], int]]:
    """Groups of frames without those hardly any pixel of which was measured, where there are others."""
    share = (~lost).double().flatten(1).mean(1).tolist()
    return [([m for m in members if share[m] > _SHOWN] or members, reference) for members, reference in groups]


def _noise_levels(frames: Tensor, motion: FrameMotion, noise: float | Literal["auto"], ignore: Tensor | None) -> Tensor:
    """Noise level of each frame, (B, T)."""
    if noise != "auto":
        level = check_number("noise", noise, at_least=0.0)
        return torch.full(frames.shape[:2], max(level, _QUIETEST), dtype=frames.dtype, device=frames.device)
    levels = [
        noise_levels(stack.detach(), motion, index, None if ignore is None else ignore[index])
        for index, stack in enumerate(frames)
    ]
    return torch.stack(levels).clamp(min=_QUIETEST)
