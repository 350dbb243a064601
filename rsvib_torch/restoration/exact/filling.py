"""Missing values of the data, replaced by the prediction of the restored scene.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.core.fourier import extend_rows, fast_length
from rsvib_torch.restoration.exact.scene_solver import SceneProblem, SolversSideBySide

__all__ = ["FILLED_BLUR_REACH", "Extended", "Incomplete", "filled", "measured_values"]

FILLED_BLUR_REACH = (
    1.0  # px along the row from its middle; above, the boundary extension is filled: a larger blur mixes it
)
# px beyond four times the reach. With 64, frames behind exposures of 200 and 400 rows gain up to 0.03 dB with 3 px and
# 0.3 dB with 8 px, and their extensions take 1.2 times as long
_NEAR = 24


@dataclass(frozen=True, eq=False)
class Incomplete:
    """A problem with missing values, whose data have any values there.

    Attributes:
        problem: The problem of the scene.
        measured: (M, C, R, L) mask of measured values.
        floor: (M, C, R, L) lower bound of the missing values (saturated pixels), or None.
    """

    problem: SceneProblem
    measured: Tensor
    floor: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Extended:
    """A problem of which only the boundary extension was not measured.

    Attributes:
        problem: The problem of the scene.
        width: Columns of the frames, the first of the data; the others are the extension.
    """

    problem: SceneProblem
    width: int


def filled(problems: Sequence[SceneProblem | Incomplete | Extended]) -> list[SceneProblem]:
    """The problems with all missing values replaced by what the restored scene predicts.

    Boundary extensions of scenes with data of one shape are filled together. Whole frames with missing pixels are
    filled one by one: their systems are large, and their factors need memory.
    """
    complete: dict[int, SceneProblem] = {}
    of_shape: dict[torch.Size, dict[int, Extended]] = {}
    for number, problem in enumerate(problems):
        if isinstance(problem, Extended):
            of_shape.setdefault(problem.problem.data.shape, {})[number] = problem
        elif isinstance(problem, Incomplete):
            [complete[number]] = _filled_by_conjugate_gradients([problem], iterations=8)
        else:
            complete[number] = problem
    for extended in of_shape.values():
        complete.update(zip(extended, _with_extension(list(extended.values())), strict=True))
    return [complete[number] for number in range(len(problems))]


def measured_values(
    along: Tensor, unknown: Tensor | None, shape: torch.Size, width: int, *, ends: bool = False
) -> Tensor | None:
    """Mask of the measured values (M, C, R, L) of the frames; None if all count as measured.

    Args:
        along: (M,) px by which the frames are moved relative to the restored one. The boundary extension of rows counts
            as measured if all are 0, as it is right only for frames with the same columns.
        unknown: (M, C, R, W) bool, pixels without data and saturated ones, or None.
        shape: (M, C, R, L) of the data.
        width: W.
        ends: The boundary extension counts as missing in any case.
    """
    moved = ends or bool(along.any())
    if unknown is None and not moved:
        return None
    columns = torch.arange(shape[-1], device=along.device)
    scene_columns = columns - along[:, None]
    inside = (columns < width) & (scene_columns >= 0) & (scene_columns < width) | (not moved)
    measured = inside[:, None, None].expand(shape).clone()
    if unknown is not None:
        measured[..., :width] &= ~unknown
    return measured


def _filled_by_conjugate_gradients(
    incomplete: Sequence[Incomplete], iterations: int, tolerance: float = 0.05
) -> list[SceneProblem]:
    """Problems whose missing values are replaced by what the solution for all other data predicts.

    The missing values x solve ``x = (K c(x))`` where they are, with the solution c(x) for the filled data. Conjugate
    gradients, each step of which is one fast solution, start from the solution of the most complete frames. Lower
    bounds are held approximately, by two rounds of an active set: at the beginning of each, values that are predicted
    below their bound are set to it, and count as measured from then on.

    Args:
        incomplete: With data of one shape, and all or none with a lower bound.
        iterations: Largest number of iterations.
        tolerance: Residual of the missing values, in units of the noise level, at which iterations stop.
    """
    problems = [scene.problem for scene in incomplete]
    solvers = SolversSideBySide(problems, keep=True)
    data = torch.stack([problem.data for problem in problems])
    measured = torch.stack([scene.measured for scene in incomplete])

    # The inner product of conjugate gradients weights rows as the least-squares problem does.
    weights = torch.stack([problem.observation.kernels.weight for problem in problems]).to(data.dtype)
    levels, row_weight = torch.stack([problem.level for problem in problems]), weights[:, :, None, :, None]

    def dot(first: Tensor, second: Tensor) -> Tensor:
        return (row_weight * first * second).sum((1, 2, 3, 4), keepdim=True)

    def residual_of(values: Tensor, missing: Tensor) -> Tensor:
        return torch.where(missing, values - torch.stack(solvers.predictions(values)), 0.0)

    # Start from the prediction of the most complete frames.
    complete = [_of_complete_frames(scene) for scene in incomplete]
    all_complete = all(part is problem for part, problem in zip(complete, problems, strict=True))
    starts = solvers if all_complete else SolversSideBySide(complete)
    data = torch.where(measured, data, torch.stack(starts.predictions(data)))

    floors = [scene.floor for scene in incomplete if scene.floor is not None]
    rounds = 2 if floors else 1
    for _ in range(rounds):
        # Values predicted below their bound are set to it.
        if floors:
            floor = torch.stack(floors)
            low = ~measured & (data < floor)
            data, measured = torch.where(low, floor, data), measured | low
        # Conjugate gradients for the others, until the residual of each scene is small beside the noise.
        missing = ~measured
        enough = (tolerance * levels[:, None, None, None, None]).square() * dot(missing.to(data.dtype), missing)
        residual = -residual_of(data, missing)
        direction, energy = residual, dot(residual, residual)
        for _ in range(iterations // rounds):
            inexact = energy > enough
            if not bool(inexact.any()):
                break
            product = residual_of(direction, missing)
            length = torch.where(inexact, energy / dot(direction, product), 0.0)
            data = data + length * direction
            residual = residual - length * product
            before, energy = energy, dot(residual, residual)
            direction = residual + torch.where(inexact, energy / before, 0.0) * direction
    return [replace(problem, data=values) for problem, values in zip(problems, data, strict=True)]


def _of_complete_frames(scene: Incomplete) -> SceneProblem:
    """The scene for its most complete frames, to a tenth; the problem itself if these are all."""
    weight = scene.problem.observation.kernels.weight
    share = scene.measured.flatten(1).to(weight.dtype).mean(1)
    complete = share >= 0.9 * share.amax()
    if bool(complete.all()):
        return scene.problem
    return replace(scene.problem, observation=scene.problem.observation.weighted(weight * complete[:, None]))


def _with_extension(extended: Sequence[Extended]) -> list[SceneProblem]:
    """Problems whose boundary extension is replaced by the prediction of the scene near the ends of the rows.

    Only a strip of columns on either side is solved, by itself and joined at the extension.

    Args:
        extended: With data of one shape.
    """
    data, width = torch.stack([scene.problem.data for scene in extended]), extended[0].width
    blur_reach = max(scene.problem.observation.kernels.blur_reach for scene in extended)
    near = min(_NEAR + 4 * math.ceil(blur_reach), width // 2)
    gap = slice(near, near + data.shape[-1] - width)
    strips = torch.cat([data[..., width - near :], data[..., :near]], dim=-1)
    length = fast_length(strips.shape[-1] + data.shape[-1] - width)
    columns = torch.arange(length, device=data.device)
    measured = (columns < gap.start) | ((columns >= gap.stop) & (columns < strips.shape[-1]))
    joined = []
    for scene, strip in zip(extended, extend_rows(strips, length), strict=True):
        flat = scene.problem.precision.flatten(0, 1)[None]
        precision = torch.nn.functional.interpolate(flat, length // 2 + 1, mode="linear", align_corners=True)
        precision = precision[0].unflatten(0, scene.problem.precision.shape[:2])
        observation = scene.problem.observation.with_period(length)
        problem = replace(scene.problem, data=strip, observation=observation, precision=precision)
        joined.append(Incomplete(problem, measured.expand_as(strip)))
    # the extension is hardly mixed into the frame by a blur below 1 px, on the finer grid: more iterations gain 0.01 dB
    solved = _filled_by_conjugate_gradients(joined, iterations=40 if blur_reach > FILLED_BLUR_REACH else 6)
    return [
        replace(scene.problem, data=torch.cat([scene.problem.data[..., :width], strip.data[..., gap]], dim=-1))
        for scene, strip in zip(extended, solved, strict=True)
    ]
