"""Missing values of the data, replaced by the prediction of the restored scene.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.core.fourier import extend_rows, fast_length
from rsvib_torch.restoration.exact.scene_solver import SceneProblem

__all__ = ["fill_beyond_ends", "fill_missing", "measured_values"]


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


def fill_missing(
    problem: SceneProblem,
    measured: Tensor,
    floor: Tensor | None = None,
    *,
    iterations: int = 8,
    tolerance: float = 0.05,
) -> Tensor:
    """Data whose missing values are replaced by what the solution for all other data predicts.

    The missing values x solve ``x = (K c(x))`` where they are, with the solution c(x) for the filled data. Conjugate
    gradients, each step of which is one fast solution, start from the solution of the most complete frames.

    Args:
        problem: The scene.
        measured: (M, C, R, L) mask of measured values.
        floor: (M, C, R, L) lower bound of the missing values (saturated pixels), or None.
        iterations: Largest number of iterations.
        tolerance: Residual of the missing values, in units of the noise level, at which iterations stop.
    """
    data, weight = problem.data, problem.observation.kernels.weight
    share = measured.flatten(1).to(weight.dtype).mean(1)
    whole = weight * (share >= 0.9 * share.amax())[:, None]  # the most complete frames, to a tenth
    solver = problem.solver(keep=True)
    start = solver if torch.equal(whole, weight) else problem.solver(whole)
    data = torch.where(measured, data, start.predict(start.fit(data)))
    scale = weight.to(data.dtype)[:, None, :, None]
    rounds = 1 if floor is None else 2
    for _ in range(rounds):
        if floor is not None:
            low = ~measured & (data < floor)
            data, measured = torch.where(low, floor, data), measured | low
        missing = ~measured
        enough = (tolerance * problem.level).square() * (scale * missing).sum()

        def residual_of(values: Tensor, missing: Tensor = missing) -> Tensor:
            return torch.where(missing, values - solver.predict(solver.fit(values)), 0.0)

        residual = -residual_of(data)
        step, energy = residual, (scale * residual.square()).sum()
        for _ in range(iterations // rounds):
            if not bool(energy > enough):
                break
            image = residual_of(step)
            length = energy / (scale * step * image).sum()
            data = data + length * step
            residual = residual - length * image
            before, energy = energy, (scale * residual.square()).sum()
            step = residual + energy / before * step
    return data


def fill_beyond_ends(
    problem: SceneProblem, width: int, reach: float, *, near: int = 64, iterations: int = 40
) -> Tensor:
    """Data whose boundary extension is replaced by the prediction of the scene near the ends of the rows.

    Only a strip of columns on either side is solved, by itself and joined at the extension.

    Args:
        problem: The scene; the first ``width`` columns of its data were measured.
        width: Columns of the frames.
        reach: Largest displacement along the row in px during an exposure, from its middle.
        near: Columns at either side that the prior relates to the extension, in px beyond the reach.
        iterations: Largest number of iterations.
    """
    data = problem.data
    near = min(near + 2 * math.ceil(reach), width // 2)
    gap = slice(near, near + data.shape[-1] - width)
    strip = torch.cat([data[..., width - near :], data[..., :near]], dim=-1)
    length = fast_length(strip.shape[-1] + data.shape[-1] - width)
    columns = torch.arange(length, device=data.device)
    measured = (columns < gap.start) | ((columns >= gap.stop) & (columns < strip.shape[-1]))
    flat = problem.precision.flatten(0, 1)[None]
    precision = torch.nn.functional.interpolate(flat, length // 2 + 1, mode="linear", align_corners=True)
    precision = precision[0].unflatten(0, problem.precision.shape[:2])
    joined = replace(problem, data=extend_rows(strip, length), precision=precision)
    filled = fill_missing(joined, measured.expand(*data.shape[:-1], length), iterations=iterations)
    return torch.cat([data[..., :width], filled[..., gap]], dim=-1)
