"""Missing values of the data, replaced by the prediction of the restored scene.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.numerics.fourier import extend_rows, extended_length, fast_length
from rsvib_torch.restoration.exact.scene_solver import SceneProblem, SceneSolver
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.scene_model.observation import frequencies_of

# px along the row from its middle; above, the boundary extension is filled: a larger blur mixes it into the frame
FILLED_BLUR_REACH = 1.0
# px beyond four times the reach. With 64, frames behind exposures of 200 and 400 rows gain up to 0.03 dB with 3 px and
# 0.3 dB with 8 px, and their extensions take 1.2 times as long
_NEAR = 24


def scene_period(motion: FrameMotion, width: int) -> int:
    """Period in px of the scenes of all stacks with frames of ``width`` px."""
    lengths = []
    for bounds, blur in zip(motion.bounds, motion.blur_lengths[..., 0].max(1), strict=True):
        margin = 8 + math.ceil(bounds[0] + 0.5)  # px beyond the displacement that influence the ends
        # the boundary extension of blurred rows is filled; that of others is longer
        filled = blur > 2 * FILLED_BLUR_REACH
        lengths.append(fast_length(width + 2 * margin) if filled else extended_length(width, margin))
    return max(lengths)


def measured_values(along: Tensor, unknown: Tensor | None, shape: torch.Size, width: int, *, ends: bool) -> Tensor:
    """Mask of the measured values (N, M, C, R, L) of the frames of N scenes.

    Frames are moved by ``along`` (N, M) px relative to the restored one. The boundary extension of rows counts as
    measured if those of a scene are 0, as it is right only for frames with the same columns, and never with ``ends``.
    Pixels without data and saturated ones are ``unknown``, (N, M, C, R, W).
    """
    columns = torch.arange(shape[-1], device=along.device)
    scene_columns = columns - along[..., None]
    inside = (columns < width) & (scene_columns >= 0) & (scene_columns < width)
    if not ends:
        inside = inside | (along == 0).all(1)[:, None, None]
    measured = inside[:, :, None, None].expand(shape).clone()
    if unknown is not None:
        measured[..., :width] &= ~unknown
    return measured


def with_missing_values(
    problem: SceneProblem, measured: Tensor, floor: Tensor | None = None, *, iterations: int = 8
) -> SceneProblem:
    """The problem with missing values replaced by what the solution for all other data predicts.

    The missing values x solve ``x = (K c(x))`` where they are, with the solution c(x) for the filled data. Conjugate
    gradients, each step of which is one fast solution, start from the solution of the most complete frames, until the
    residual is 0.05 times the noise level. The lower bounds ``floor`` (N, M, C, R, L) of saturated pixels are held
    approximately, by two rounds of an active set: at the beginning of each, values that are predicted below their bound
    are set to it, and count as ``measured`` (N, M, C, R, L) from then on.
    """
    data, solver = problem.data, problem.solver(keep=True)

    # The inner product of conjugate gradients weights rows as the least-squares problem does.
    weight = problem.observation.kernels.weight.unflatten(0, data.shape[:2])
    row_weight = weight.to(data.dtype)[:, :, None, :, None]

    def dot(first: Tensor, second: Tensor) -> Tensor:
        return (row_weight * first * second).sum((1, 2, 3, 4), keepdim=True)

    def prediction(solver: SceneSolver, values: Tensor) -> Tensor:
        return solver.predict(solver.fit(values))

    def residual_of(values: Tensor, missing: Tensor) -> Tensor:
        return torch.where(missing, values - prediction(solver, values), 0.0)

    # Start from the prediction of the most complete frames, to a tenth.
    share = measured.flatten(2).to(weight.dtype).mean(2)
    most_complete = share >= 0.9 * share.amax(1, keepdim=True)
    start = solver
    if not bool(most_complete.all()):
        observation = problem.observation.weighted((weight * most_complete[:, :, None]).flatten(0, 1))
        start = replace(problem, observation=observation).solver()
    data = torch.where(measured, data, prediction(start, data))

    rounds = 1 if floor is None else 2
    for _ in range(rounds):
        # Values predicted below their bound are set to it.
        if floor is not None:
            low = ~measured & (data < floor)
            data, measured = torch.where(low, floor, data), measured | low
        # Conjugate gradients for the others, until the residual of each scene is small beside the noise.
        missing = ~measured
        enough = (0.05 * problem.level[:, None, None, None, None]).square() * dot(missing.to(data.dtype), missing)
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
    return replace(problem, data=data)


def with_extension(problem: SceneProblem, width: int) -> SceneProblem:
    """The problem with the boundary extension of rows of ``width`` px replaced by the prediction of the scene.

    Only a strip of columns on either side is solved, by itself and joined at the extension.
    """
    data, blur_reach = problem.data, problem.observation.kernels.blur_reach
    near = min(_NEAR + 4 * math.ceil(blur_reach), width // 2)
    gap = slice(near, near + data.shape[-1] - width)
    strips = torch.cat([data[..., width - near :], data[..., :near]], dim=-1)
    length = fast_length(strips.shape[-1] + data.shape[-1] - width)
    columns = torch.arange(length, device=data.device)
    measured = (columns < gap.start) | ((columns >= gap.stop) & (columns < strips.shape[-1]))
    # the precision at the frequencies of the strips
    flat = problem.precision.flatten(0, -2)[None]
    precision = torch.nn.functional.interpolate(flat, length // 2 + 1, mode="linear", align_corners=True)
    joined = replace(
        problem,
        data=extend_rows(strips, length),
        observation=problem.observation.at_frequencies(frequencies_of(length), length),
        precision=precision[0].view(*problem.precision.shape[:-1], -1),
    )
    # the extension is hardly mixed into the frame by a blur below 1 px, on the finer grid: more iterations gain 0.01 dB
    iterations = 40 if blur_reach > FILLED_BLUR_REACH else 6
    solved = with_missing_values(joined, measured.expand_as(joined.data), iterations=iterations)
    return replace(problem, data=torch.cat([data[..., :width], solved.data[..., gap]], dim=-1))
