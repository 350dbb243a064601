"""Scenes and their frames: regularised least squares, one banded system per scene and horizontal frequency.

The coefficients c of a scene minimise ``sum_m w_m |g_m - K_m c|^2 + c^H P c`` with the data g_m, the observation
operators K_m, the weights w_m and the precision matrix P of a prior. The normal equations

    (sum_m K_m^H w_m K_m + P) c = sum_m K_m^H w_m g_m

are banded, Hermitian and positive definite for every horizontal frequency. The systems of N scenes are solved together.

The plain path factors the system of every frequency, and is differentiable. The fast path factors the systems of some
frequencies and interpolates the factors for all others.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from rsvib_torch.execution.parallel import in_parallel, runs
from rsvib_torch.numerics.banded_solver import (
    BandedFactor,
    InterpolatedFactors,
    factor_banded,
    node_frequencies,
    solve_halves,
)
from rsvib_torch.numerics.interpolation import extend_rows, extended_length, fast_length
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.observation import Observation, frequencies_of, most_values

MOST_THREADS = 2  # that solve systems side by side; more wait for each other's calls from Python
MIN_LEVEL = 1e-5  # of full scale, lowest noise level assumed; below, the systems lose digits in single precision


# rows of neighbouring windows; the solution changes by about 1e-5, as by rounding, unless the exposure blurs; with 64
# rows and noise of 0.0005 by up to 0.1
_OVERLAP = 128


def row_windows(rows: int, count: int) -> list[slice]:
    """Windows of one size that cover all rows, whose neighbours overlap.

    The dependence of a solution on distant rows decreases exponentially: windows are solved side by side, and joined in
    the middle of their overlaps.
    """
    size = -(-(rows + _OVERLAP * (count - 1)) // count)
    if count <= 1 or size >= rows:
        return [slice(0, rows)]
    starts = [min(k * (size - _OVERLAP), rows - size) for k in range(count)]
    return [slice(start, start + size) for start in starts]


def join_windows(values: Tensor, windows: list[slice]) -> Tensor:
    """Windows (R, ..., n, S) of rows joined in the middle of their overlaps, (K, ..., S)."""
    if len(windows) == 1:
        return values[..., 0, :]
    borders = [0, *((before.stop + after.start) // 2 for before, after in pairwise(windows)), windows[-1].stop]
    parts = zip(windows, pairwise(borders), strict=True)
    return torch.cat([values[a - w.start : b - w.start, ..., k, :] for k, (w, (a, b)) in enumerate(parts)])


class SceneSolver:
    """Solver of the normal equations of N scenes; ``keep`` keeps the factors, for solving several times.

    The ``precision`` P are products (p + 1, p + 1, N, U) as from ``RowPrior.precision``, in units of the noise of
    weight 1.

    A few frequencies are solved at a time, which bounds the memory, and windows of the rows side by side. Where
    exposures blur, frequencies that many neighbouring rows do not observe depend on distant rows, and the rows are not
    divided.
    """

    def __init__(self, observation: Observation, precision: Tensor, *, keep: bool = False) -> None:
        self.observation, self.precision, self.u = observation, precision, observation.u
        normal = observation.normal(len(precision) - 1)
        rows, frequencies, device = observation.count, len(self.u), precision.device
        blurred, scenes = observation.kernels.blurred, observation.num_scenes

        # Chunks of the frequencies; all at a time if their factors are kept. With a quarter of what the memory permits,
        # which caches hold, a pair of 2048 px takes 0.89 of the time.
        values = scenes * rows * normal.matrices.shape[1]  # at a frequency
        most = frequencies if keep else max(1, most_values(device) // (4 * values))
        rounds = -(-frequencies // most)
        chunk = -(-frequencies // (8 * rounds)) * 8  # rows begin at full cache lines
        self._parts = runs(frequencies, min(chunk, frequencies))

        # Rows of a window, of which the overlap is a part: twice as fast as one window for 2048 rows, because a step of
        # the elimination then has more values than its call from Python costs.
        count = 1 if blurred else max(1, rows // (512 if device.type == "cpu" else 256))
        self._windows = row_windows(rows, count)
        self._normal = normal.in_windows(self._windows)
        self._keep, self._num_rows = keep, self._windows[0].stop - self._windows[0].start
        self._interpolated: InterpolatedFactors | None = None
        nodes = None if keep or self._differentiates() else self._nodes()
        if nodes is not None:
            systems = self._normal.at(self.u[nodes], precision[..., nodes])
            self._interpolated = InterpolatedFactors.of(systems, nodes, self._num_rows)

    @cached_property
    def _factors(self) -> list[BandedFactor]:
        """Factors of all parts, where they are kept."""
        return [factor_banded(self._normal.at(self.u[p], self.precision[..., p]), self._num_rows) for p in self._parts]

    def _nodes(self) -> Tensor | None:
        """Frequencies whose systems are factored; None: all.

        The systems change with the frequency as the prior does, over 1/64 cycles per px, and as kernels that extend r
        px along the row do, over 1/(140 r). Above 1.5 px, systems are too close to singular for interpolation.
        """
        blur_reach = self.observation.kernels.blur_reach
        step = self.observation.period * min(1 / 64, 1 / (140 * max(blur_reach, 1e-9)))
        nodes = node_frequencies(len(self.u), step, self.u.device)
        # above a fifth of the frequencies, interpolation takes as long as factoring
        return nodes if blur_reach <= 1.5 and 5 * len(nodes) <= len(self.u) else None

    def _differentiates(self, *given: Tensor) -> bool:
        values = (*given, self._normal.matrices, self.precision)
        return torch.is_grad_enabled() and any(value.requires_grad for value in values)

    def fit(self, data: Tensor) -> Tensor:
        """Coefficients (K, C, N, U) of the scenes for data (N, M, C, R, L), whose rows are extended to a period."""
        spectra = torch.fft.rfft(data)
        return self._solution(lambda part: self.observation.adjoint(spectra[..., part], part), spectra)

    def solve(self, right: Tensor) -> Tensor:
        """Solution (K, C, N, U) of the normal equations for right sides (K, C, N, U)."""
        return self._solution(lambda part: right[..., part], right)

    def _solution(self, right_side: Callable[[slice], Tensor], given: Tensor) -> Tensor:
        """Solution (K, C, N, U) for right sides (K, C, N, S) of parts of the frequencies, computed from ``given``."""
        differentiates = self._differentiates(given)
        factors = self._factors if self._keep and not differentiates else []
        scenes, windows = self.observation.num_scenes, self._windows

        def solve(number: int) -> Tensor:
            part = self._parts[number]
            # windows of the rows, (R, C, N W S)
            whole = right_side(part)
            right = torch.stack([whole[window] for window in windows], dim=3).flatten(2)
            system: Tensor | BandedFactor
            if self._interpolated is not None:
                system = self._interpolated.at(part)
            elif factors:
                system = factors[number]
            else:
                system = self._normal.at(self.u[part], self.precision[..., part])
            solution = solve_halves(system, right)
            return join_windows(solution.unflatten(-1, (scenes, len(windows), -1)), windows)

        numbers = range(len(self._parts))
        if differentiates:
            return torch.cat([solve(number) for number in numbers], dim=-1)
        return torch.cat(in_parallel(solve, numbers, given.device, at_most=MOST_THREADS), dim=-1)

    def image(self, coefficients: Tensor) -> Tensor:
        """Rows of the scenes where the frame at rest would observe them, (N, C, R, L); twice as many if finer."""
        return self.observation.image(coefficients)


@dataclass(frozen=True, eq=False)
class SceneProblem:
    """N scenes, each observed by M frames."""

    data: Tensor  # (N, M, C, R, L), rows of period L, mean brightness 0
    observation: Observation  # observation operator of the frames
    precision: Tensor  # precision of the row prior, products as from ``RowPrior.precision``
    level: Tensor  # (N,) standard deviation of the noise of data of weight 1
    mixing: Tensor | None = None  # (N, N) orthonormal; values that are measured are the ``mixed`` ones

    def solver(self, *, keep: bool = False) -> SceneSolver:
        """The solver for complete data; ``keep`` its factors, for solving several times."""
        return SceneSolver(self.observation, self.precision, keep=keep)

    def mixed(self, values: Tensor) -> Tensor:
        """Measured values (N, ...) from those of the scenes."""
        return values if self.mixing is None else torch.einsum("nc,n...->c...", self.mixing, values)


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
    problem: SceneProblem,
    solver: SceneSolver,
    measured: Tensor,
    floor: Tensor | None = None,
    *,
    iterations: int = 8,
    accuracy: float = 0.05,
) -> SceneProblem:
    """The problem, with its solver, with missing values replaced by what the solution for all other data predicts.

    The missing values x solve ``x = (K c(x))`` where they are, with the solution c(x) for the filled data. Conjugate
    gradients, each step of which is one fast solution, end when the residual is ``accuracy`` times the noise level. The
    lower bounds ``floor`` (N, M, C, R, L) of saturated pixels are held approximately, by two rounds of an active set:
    at the beginning of each, values that are predicted below their bound are set to it, and count as ``measured`` (N,
    M, C or 1, R, L) from then on. Channels are filled independently.
    """
    data, mixing = problem.mixed(problem.data), problem.mixing

    # The inner product of conjugate gradients weights rows as the least-squares problem does.
    weight = problem.observation.kernels.weight.unflatten(0, data.shape[:2]).to(data.dtype)[:, :, None, :, None]
    together = (1, 3, 4) if mixing is None else (0, 1, 3, 4)

    def dot(first: Tensor, second: Tensor) -> Tensor:
        return (weight * first * second).sum(together, keepdim=True)

    def of_scenes(values: Tensor) -> Tensor:
        return values if mixing is None else torch.einsum("nc,c...->n...", mixing, values)

    def prediction(values: Tensor) -> Tensor:
        return problem.mixed(problem.observation.A(solver.fit(of_scenes(values))))

    def residual_of(values: Tensor, missing: Tensor) -> Tensor:
        return torch.where(missing, values - prediction(values), 0.0)

    data = torch.where(measured, data, prediction(data))
    rounds = 1 if floor is None else 2
    for _ in range(rounds):
        # Values predicted below their bound are set to it.
        if floor is not None:
            low = ~measured & (data < floor)
            data, measured = torch.where(low, floor, data), measured | low
        # Conjugate gradients for the others, until the residual of each scene is small beside the noise.
        missing = ~measured
        enough = (accuracy * problem.level[:, None, None, None, None]).square() * dot(missing.to(data.dtype), missing)
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
    return replace(problem, data=of_scenes(data))


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
    missing = measured.expand_as(joined.data)
    solved = with_missing_values(joined, joined.solver(keep=True), missing, iterations=iterations)
    return replace(problem, data=torch.cat([data[..., :width], solved.data[..., gap]], dim=-1))
