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

__all__ = ["FILLED_REACH", "Extended", "Incomplete", "filled", "measured_values"]

FILLED_REACH = 1.0  # px along the row from its middle; above, the boundary extension is filled: a larger blur mixes it
# px beyond four times the reach. With 64, frames behind exposures of 200 and 400 rows gain up to 0.03 dB with 3 px and
# 0.3 dB with 8 px, and their extensions take 1.2 times as long
_NEAR = 24


@dataclass(frozen=True, eq=False)
class Incomplete:
    """A scene with missing values, whose data have any values there.

    Attributes:
        problem: The scene.
        measured: (M, C, R, L) mask of measured values.
        floor: (M, C, R, L) lower bound of the missing values (saturated pixels), or None.
    """

    problem: SceneProblem
    measured: Tensor
    floor: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Extended:
    """A scene of which only the boundary extension was not measured.

    Attributes:
        problem: The scene.
        width: Columns of the frames, the first of the data; the others are the extension.
    """

    problem: SceneProblem
    width: int


def filled(scenes: Sequence[SceneProblem | Incomplete | Extended]) -> list[SceneProblem]:
    """The scenes with all missing values replaced by what the restored scene predicts.

    Boundary extensions of scenes with data of one shape are filled together. Whole frames with missing pixels are
    filled one by one: their systems are large, and their factors need memory.
    """
    problems: dict[int, SceneProblem] = {}
    alike: dict[torch.Size, list[int]] = {}
    for number, scene in enumerate(scenes):
        if isinstance(scene, Extended):
            alike.setdefault(scene.problem.data.shape, []).append(number)
        else:
            problems[number] = _with_values([scene], iterations=8)[0] if isinstance(scene, Incomplete) else scene
    for numbers in alike.values():
        extended = [scene for number in numbers if isinstance(scene := scenes[number], Extended)]
        problems.update(zip(numbers, _with_extension(extended), strict=True))
    return [problems[number] for number in range(len(scenes))]


def measured_values(
    along: Tensor, missing: Tensor | None, shape: torch.Size, width: int, *, ends: bool = False
) -> Tensor | None:
    """Mask of the measured values (M, C, R, L) of the frames; None if all count as measured.

    Args:
        along: (M,) px by which the frames are moved relative to the restored one. The boundary extension of rows counts
            as measured if all are 0, as it is right only for frames with the same columns.
        missing: (M, C, R, W) bool, missing pixels, or None.
        shape: (M, C, R, L) of the data.
        width: W.
        ends: The boundary extension counts as missing in any case.
    """
    moved = ends or bool(along.any())
    if missing is None and not moved:
        return None
    columns = torch.arange(shape[-1], device=along.device)
    scene = columns - along[:, None]
    inside = (columns < width) & (scene >= 0) & (scene < width) | (not moved)
    measured = inside[:, None, None].expand(shape).clone()
    if missing is not None:
        measured[..., :width] &= ~missing
    return measured


def _with_values(scenes: Sequence[Incomplete], iterations: int, tolerance: float = 0.05) -> list[SceneProblem]:
    """Scenes whose missing values are replaced by what the solution for all other data predicts.

    The missing values x solve ``x = (K c(x))`` where they are, with the solution c(x) for the filled data. Conjugate
    gradients, each step of which is one fast solution, start from the solution of the most complete frames.

    Args:
        scenes: With data of one shape, and all or none with a lower bound.
        iterations: Largest number of iterations.
        tolerance: Residual of the missing values, in units of the noise level, at which iterations stop.
    """
    problems = [scene.problem for scene in scenes]
    solvers = SolversSideBySide(problems, keep=True)
    complete = [_of_complete_frames(scene) for scene in scenes]
    starts = solvers if complete == problems else SolversSideBySide(complete)
    data, measured = (
        torch.stack(values) for values in zip(*((s.problem.data, s.measured) for s in scenes), strict=True)
    )
    weights = torch.stack([problem.observation.kernels.weight for problem in problems]).to(data.dtype)
    levels, scale = torch.stack([problem.level for problem in problems]), weights[:, :, None, :, None]

    def dot(first: Tensor, second: Tensor) -> Tensor:
        return (scale * first * second).sum((1, 2, 3, 4), keepdim=True)

    data = torch.where(measured, data, torch.stack(starts.predictions(data)))
    floors = [scene.floor for scene in scenes if scene.floor is not None]
    rounds = 2 if floors else 1
    for _ in range(rounds):
        if floors:
            floor = torch.stack(floors)
            low = ~measured & (data < floor)
            data, measured = torch.where(low, floor, data), measured | low
        missing = ~measured
        enough = (tolerance * levels[:, None, None, None, None]).square() * dot(missing.to(data.dtype), missing)

        def residual_of(values: Tensor, missing: Tensor = missing) -> Tensor:
            return torch.where(missing, values - torch.stack(solvers.predictions(values)), 0.0)

        residual = -residual_of(data)
        step, energy = residual, dot(residual, residual)
        for _ in range(iterations // rounds):
            inexact = energy > enough
            if not bool(inexact.any()):
                break
            image = residual_of(step)
            length = torch.where(inexact, energy / dot(step, image), 0.0)
            data = data + length * step
            residual = residual - length * image
            before, energy = energy, dot(residual, residual)
            step = residual + torch.where(inexact, energy / before, 0.0) * step
    return [replace(problem, data=own) for problem, own in zip(problems, data, strict=True)]


def _of_complete_frames(scene: Incomplete) -> SceneProblem:
    """The scene for its most complete frames, to a tenth; the problem itself if these are all."""
    weight = scene.problem.observation.kernels.weight
    share = scene.measured.flatten(1).to(weight.dtype).mean(1)
    complete = share >= 0.9 * share.amax()
    if bool(complete.all()):
        return scene.problem
    return replace(scene.problem, observation=scene.problem.observation.weighted(weight * complete[:, None]))


def _with_extension(scenes: Sequence[Extended]) -> list[SceneProblem]:
    """Scenes whose boundary extension is replaced by the prediction of the scene near the ends of the rows.

    Only a strip of columns on either side is solved, by itself and joined at the extension.

    Args:
        scenes: With data of one shape.
    """
    data, width = torch.stack([scene.problem.data for scene in scenes]), scenes[0].width
    reach = max(scene.problem.observation.kernels.reach for scene in scenes)
    near = min(_NEAR + 4 * math.ceil(reach), width // 2)
    gap = slice(near, near + data.shape[-1] - width)
    strips = torch.cat([data[..., width - near :], data[..., :near]], dim=-1)
    length = fast_length(strips.shape[-1] + data.shape[-1] - width)
    columns = torch.arange(length, device=data.device)
    measured = (columns < gap.start) | ((columns >= gap.stop) & (columns < strips.shape[-1]))
    joined = []
    for scene, strip in zip(scenes, extend_rows(strips, length), strict=True):
        flat = scene.problem.precision.flatten(0, 1)[None]
        precision = torch.nn.functional.interpolate(flat, length // 2 + 1, mode="linear", align_corners=True)
        precision = precision[0].unflatten(0, scene.problem.precision.shape[:2])
        observation = scene.problem.observation.with_period(length)
        problem = replace(scene.problem, data=strip, observation=observation, precision=precision)
        joined.append(Incomplete(problem, measured.expand_as(strip)))
    # the extension is hardly mixed into the frame by a blur below 1 px, on the finer grid: more iterations gain 0.01 dB
    found = _with_values(joined, iterations=40 if reach > FILLED_REACH else 6)
    return [
        replace(scene.problem, data=torch.cat([scene.problem.data[..., :width], own.data[..., gap]], dim=-1))
        for scene, own in zip(scenes, found, strict=True)
    ]
