"""Values that were not measured, filled with what the restored scene predicts."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.core.fourier import fast_length
from rsvib_torch.restoration.exact.scene_problem import SceneProblem
from rsvib_torch.restoration.row_extension import continue_rows

__all__ = ["fill_beyond_ends", "fill_unmeasured"]

_ITERATIONS, _ITERATIONS_OF_ENDS = 8, 40  # at most
_CONVERGED = 0.05  # of the noise level: what is left unexplained where the filling is
_MOSTLY = 0.9  # frames with at least this part of the most complete one start the filling
_STRIP = 64  # columns on either side, and what the motion shows, that say how rows go on beyond their ends


def fill_unmeasured(
    problem: SceneProblem, measured: Tensor, floor: Tensor | None = None, iterations: int = _ITERATIONS
) -> Tensor:
    """Data with what was not measured replaced by what the solution for all other data predicts.

    Solved by conjugate gradients for the values that are missing, each step of which is one fast solution: what the
    solution for filled data leaves unexplained has to vanish where the filling is.

    Args:
        problem: The scene.
        measured: (M, C, R, L) which values count.
        floor: (M, C, R, L) least value of what was not measured (saturated), or None.
        iterations: At most; fewer where the noise hides what is left.
    """
    data, weight = problem.data, problem.seen.kernels.weight
    share = measured.flatten(1).to(weight.dtype).mean(1)
    whole = weight * (share >= _MOSTLY * share.amax())[:, None]
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
        little = (_CONVERGED * problem.level).square() * (scale * missing).sum()

        def unexplained(values: Tensor, missing: Tensor = missing) -> Tensor:
            return torch.where(missing, values - solver.predict(solver.fit(values)), 0.0)

        residual = -unexplained(data)
        step, energy = residual, (scale * residual.square()).sum()
        for _ in range(iterations // rounds):
            if not bool(energy > little):
                break
            image = unexplained(step)
            length = energy / (scale * step * image).sum()
            data = data + length * step
            residual = residual - length * image
            before, energy = energy, (scale * residual.square()).sum()
            step = residual + energy / before * step
    return data


def fill_beyond_ends(problem: SceneProblem, width: int, reach: float) -> Tensor:
    """Data whose rows go on beyond their ends as the scene predicts that is seen near the ends.

    Only columns near the ends have a say: a strip of them is solved by itself, whose far ends go on likewise.

    Args:
        problem: The scene; the first ``width`` columns of its data were measured.
        width: Columns of the frames.
        reach: Distance along the row in px that a row sees.
    """
    data = problem.data
    near = min(_STRIP + 2 * math.ceil(reach), width // 2)
    gap = slice(near, near + data.shape[-1] - width)
    strip = torch.cat([data[..., width - near :], data[..., :near]], dim=-1)
    length = fast_length(strip.shape[-1] + data.shape[-1] - width)
    columns = torch.arange(length, device=data.device)
    measured = (columns < gap.start) | ((columns >= gap.stop) & (columns < strip.shape[-1]))
    measured = measured.expand(*data.shape[:-1], length)
    joined = replace(problem, data=continue_rows(strip, length), precision=problem.precision_at(length))
    filled = fill_unmeasured(joined, measured, iterations=_ITERATIONS_OF_ENDS)
    return torch.cat([data[..., :width], filled[..., gap]], dim=-1)
