"""One scene and its frames: regularised least squares, one banded system per horizontal frequency.

The coefficients c of the scene minimise ``sum_m w_m |g_m - K_m c|^2 + c^H P c`` with the data g_m, the observation
operators K_m, the weights w_m and the precision matrix P of a prior. The normal equations

    (sum_m K_m^H w_m K_m + P) c = sum_m K_m^H w_m g_m

are banded, Hermitian and positive definite for every horizontal frequency.

The plain path factors the system of every frequency, and is differentiable. The fast path factors the systems of some
frequencies and interpolates the factors for all others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import prod

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.banded_solver import (
    BandedFactor,
    InterpolatedFactors,
    extend_system,
    factor_banded,
    node_frequencies,
    solve_skewed,
)
from rsvib_torch.core.chunking import runs
from rsvib_torch.core.parallel import in_parallel
from rsvib_torch.restoration.scene_model.observation import Observation

__all__ = [
    "SIDE_BY_SIDE",
    "Partition",
    "SceneProblem",
    "SceneSolver",
    "SolversSideBySide",
    "join_windows",
    "row_windows",
]


def row_windows(rows: int, count: int, overlap: int = 96) -> list[slice]:
    """Windows of one size that cover all rows, neighbours overlapping by at least twice ``overlap`` rows.

    The dependence of a solution on distant rows decreases exponentially: windows are solved side by side, and the rows
    of the overlap are discarded. With 96 rows the solution changes by about 1e-5 unless the exposure blurs.

    Example:
        >>> row_windows(10, 2, overlap=1)
        [slice(0, 6, None), slice(4, 10, None)]
    """
    size = -(-(rows + 2 * overlap * (count - 1)) // count)
    if count <= 1 or size >= rows:
        return [slice(0, rows)]
    starts = [min(k * (size - 2 * overlap), rows - size) for k in range(count)]
    return [slice(start, start + size) for start in starts]


def join_windows(values: Tensor, windows: list[slice]) -> Tensor:
    """Windows (R, ..., n, S) of rows joined in the middle of their overlaps, (K, ..., S)."""
    if len(windows) == 1:
        return values[..., 0, :]
    borders = [0, *((before.stop + after.start) // 2 for before, after in pairwise(windows)), windows[-1].stop]
    parts = zip(windows, pairwise(borders), strict=True)
    return torch.cat([values[a - w.start : b - w.start, ..., k, :] for k, (w, (a, b)) in enumerate(parts)])


@dataclass(eq=False)
class Partition:
    """Which parts of the systems of a scene are solved at a time, in memory that is used again.

    Attributes:
        chunk: Frequencies solved at a time; None: chosen by memory.
        segments: Number of windows of rows; None: as many as make a step of the elimination worth its call.
    """

    chunk: int | None = None
    segments: int | None = None
    _buffers: dict[int, Tensor] = field(default_factory=dict)

    @staticmethod
    def threads(device: torch.device) -> int:
        """Chunks that are solved side by side; more than two threads wait for each other's calls from Python."""
        return min(torch.get_num_threads(), 2) if device.type == "cpu" else 1

    def divide(
        self, rows: int, width: int, frequencies: int, device: torch.device, *, blurred: bool, keep: bool
    ) -> tuple[list[slice], list[slice]]:
        """Chunks of the frequencies, and windows of the rows of a scene.

        Args:
            rows: Rows of the scene.
            width: Half-width of the band.
            frequencies: Number of frequencies.
            device: Device of the data.
            blurred: Whether exposures blur: frequencies that many neighbouring rows do not observe then depend on
                distant rows, and the rows are not divided.
            keep: Whether the factors of all frequencies are kept.
        """
        cpu = device.type == "cpu"
        # values of the bands in memory: 64 MB on a CPU, 2 GB on a GPU, or 8 times the spectrum of a large scene,
        # for two chunks at a time on a CPU, so that results do not depend on the number of threads
        values = max(1 << (23 if cpu else 28), 8 * rows * frequencies) // (2 if cpu else 1)
        if blurred:
            # the rows are not divided, and a step of the elimination has fewer values: twice the memory saves 18 % of
            # the time for frames of 1024 and 2048 rows, four times the memory 30 %
            values *= 2
        most = frequencies if keep else max(1, values // (rows * (2 * width + 1)))
        rounds = -(-frequencies // most)
        chunk = self.chunk or -(-frequencies // (8 * rounds)) * 8  # rows begin at full cache lines
        chunk = min(chunk, frequencies)
        if blurred:
            return runs(frequencies, chunk), [slice(0, rows)]
        # rows of a window, of which the overlap is a part: twice as fast as one window for 2048 rows, because a step of
        # the elimination then has more values than its call from Python costs
        count = self.segments or max(1, rows // (512 if cpu else 256))
        return runs(frequencies, chunk), row_windows(rows, count)

    def buffer(self, thread: int, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """Memory of a thread: page faults in fresh memory take as long as the elimination."""
        if thread not in self._buffers or self._buffers[thread].numel() < prod(shape):
            self._buffers.pop(thread, None)
            self._buffers[thread] = like.new_empty(prod(shape))
        memory: Tensor = self._buffers[thread][: prod(shape)].view(shape)
        return memory


class SceneSolver:
    """Solver of the normal equations of one scene.

    Args:
        observation: Observation operator of M frames of R rows.
        precision: P, products (p + 1, p + 1, U) as from ``RowPrior.precision``, in units of the noise of weight 1.
        partition: Parts solved at a time.
        keep: Keep the factors, for solving several times.

    Attributes:
        parts: Frequencies that are solved at a time.
    """

    def __init__(
        self, observation: Observation, precision: Tensor, partition: Partition, *, keep: bool = False
    ) -> None:
        self.observation, self.precision, self.u = observation, precision, observation.u
        normal = observation.normal(len(precision) - 1)
        self._partition = partition
        self.parts, self._windows = partition.divide(
            observation.count,
            normal.width,
            len(self.u),
            precision.device,
            blurred=observation.kernels.blurred,
            keep=keep,
        )
        self._normal = normal.in_windows(self._windows)
        self._keep = keep
        self._interpolated: InterpolatedFactors | None = None
        nodes = None if keep or self._differentiates() else self._nodes()
        if nodes is not None:
            systems = self._normal.at(self.u[nodes], precision[..., nodes])
            self._interpolated = InterpolatedFactors.of(systems, nodes)

    @property
    def num_systems(self) -> int:
        """Number of systems: that of the frequencies of all windows of rows."""
        return len(self._windows) * len(self.u)

    @property
    def interpolates(self) -> bool:
        """Whether the factors are interpolated between some frequencies."""
        return self._interpolated is not None

    @cached_property
    def _factors(self) -> list[BandedFactor]:
        """Factors of all parts, where they are kept."""
        return [factor_banded(self._normal.at(self.u[p], self.precision[..., p])) for p in self.parts]

    def _nodes(self) -> Tensor | None:
        """Frequencies whose systems are factored; None: all.

        The systems change with the frequency as the prior does, over 1/64 cycles per px, and as kernels that extend r
        px along the row do, over 1/(140 r). Above 1.5 px, systems are too close to singular for interpolation.
        """
        blur_reach = self.observation.kernels.blur_reach
        step = self.observation.period * min(1 / 64, 1 / (140 * max(blur_reach, 1e-9)))
        nodes = node_frequencies(len(self.u), step, self.precision.device)
        # above a fifth of the frequencies, interpolation takes as long as factoring
        return nodes if blur_reach <= 1.5 and 5 * len(nodes) <= len(self.u) else None

    def _differentiates(self, *given: Tensor) -> bool:
        values = (*given, self._normal.left, self.precision)
        return torch.is_grad_enabled() and any(value.requires_grad for value in values)

    def fit(self, data: Tensor) -> Tensor:
        """Coefficients (K, C, U) of the scene for data (M, C, R, L), whose rows are extended to a period."""
        spectra: Tensor = torch.fft.rfft(data)
        return self._solution(lambda part: self._right_side(spectra, part), spectra)

    def right_side(self, data: Tensor) -> Tensor:
        """Right sides (K, C, U) of the normal equations for data (M, C, R, L)."""
        spectra = torch.fft.rfft(data)
        return torch.cat([self._right_side(spectra, part) for part in self.parts], dim=-1)

    def _right_side(self, spectra: Tensor, part: slice) -> Tensor:
        return self.observation.adjoint(spectra[..., part], part)

    def solve(self, right: Tensor) -> Tensor:
        """Solution (K, C, U) of the normal equations for right sides (K, C, U)."""
        return self._solution(lambda part: right[..., part], right)

    def in_windows(self, values: Tensor) -> Tensor:
        """Windows (R, C, n S) of the rows of values (K, C, S)."""
        return torch.stack([values[window] for window in self._windows], dim=-2).flatten(-2)

    def joined(self, values: Tensor) -> Tensor:
        """The opposite of ``in_windows``."""
        return join_windows(values.unflatten(-1, (len(self._windows), -1)), self._windows)

    def _solution(self, right_side: Callable[[slice], Tensor], given: Tensor) -> Tensor:
        """Solution (K, C, U) for right sides (K, C, S) of parts of the frequencies, computed from ``given``."""
        interpolated: dict[int, BandedFactor] = {}  # of each thread, in memory that is used again
        factors = self._factors if self._keep and not self._differentiates(given) else []

        def solve(number: int, thread: int | None = None) -> Tensor:
            part = self.parts[number]
            u = self.u[part]
            right = self.in_windows(right_side(part))
            if self._interpolated is not None:
                factor = self._interpolated.at(part, None if thread is None else interpolated.get(thread))
                if thread is not None:
                    interpolated[thread] = factor
                solution = solve_skewed(factor, right)
            elif factors:
                solution = solve_skewed(factors[number], right)
            else:
                left = self._normal.left
                shape = (*left.shape[:2], len(self._windows) * len(u))
                out = None if thread is None else self._partition.buffer(thread, shape, given)
                solution = solve_skewed(self._normal.at(u, self.precision[..., part], out), right)
            return self.joined(solution)

        if self._differentiates(given):
            return torch.cat([solve(number) for number in range(len(self.parts))], dim=-1)
        coefficients: Tensor = given.new_empty(self.observation.count, given.shape[1], len(self.u))
        threads = min(Partition.threads(given.device), len(self.parts))

        def share(thread: int) -> None:
            for number in range(thread, len(self.parts), threads):
                coefficients[..., self.parts[number]] = solve(number, thread)

        in_parallel(share, range(threads), given.device)
        return coefficients

    def whole_system(self) -> Tensor:
        """Skewed bands (R + b, 2 b + 1, n U) of all windows and frequencies."""
        return self._normal.at(self.u, self.precision)

    def whole_right_side(self, data: Tensor) -> Tensor:
        """Their right sides (R, C, n U), for data as in ``fit``."""
        return self.in_windows(self.right_side(data))

    def predict(self, coefficients: Tensor) -> Tensor:
        """Noiseless frames (M, C, R, L) of a scene, ``K c``."""
        spectra = [self.observation.forward(coefficients[..., part], part) for part in self.parts]  # less memory
        images: Tensor = torch.fft.irfft(torch.cat(spectra, dim=-1), n=self.observation.period)
        return images

    def image(self, coefficients: Tensor) -> Tensor:
        """Rows of the scene where the frame at rest would observe them, (C, R, L); twice as many on the finer grid."""
        return self.observation.image(coefficients)


@dataclass(frozen=True, eq=False)
class SceneProblem:
    """One scene, observed by M frames.

    Attributes:
        data: (M, C, R, L) rows extended to a period.
        observation: Observation operator of the frames.
        precision: Precision of the row prior, products as from ``RowPrior.precision``.
        level: Standard deviation of the noise of data of weight 1.
        partition: Parts solved at a time.
    """

    data: Tensor
    observation: Observation
    precision: Tensor
    level: Tensor
    partition: Partition

    def solver(self, *, keep: bool = False) -> SceneSolver:
        """The solver for complete data; ``keep`` its factors, for solving several times."""
        return SceneSolver(self.observation, self.precision, self.partition, keep=keep)


SIDE_BY_SIDE = 512  # frequencies from which a step of the elimination takes longer than its call


class SolversSideBySide:
    """Solvers of scenes of few columns, whose systems are solved together.

    A step of the elimination for the frequencies of few columns takes less time than its call: seven strips of 384 rows
    and 112 columns take 0.4 of the time together.

    Args:
        problems: The scenes, with as many channels each.
        keep: Keep the factors, for solving several times.

    Attributes:
        solvers: The solver of each scene.
    """

    def __init__(self, problems: Sequence[SceneProblem], *, keep: bool = False) -> None:
        self.solvers = [problem.solver(keep=keep) for problem in problems]
        self._groups: list[list[int]] = []
        room = 0
        for number, solver in enumerate(self.solvers):
            alone = len(solver.parts) > 1 or solver.interpolates
            if alone or solver.num_systems > room:
                self._groups.append([])
                room = SIDE_BY_SIDE
            self._groups[-1].append(number)
            room = 0 if alone else room - solver.num_systems
        # a scene alone is solved by its solver
        self._factors = {
            number: factor_banded(self._system(group))
            for number, group in enumerate(self._groups)
            if keep and len(group) > 1
        }

    def _system(self, group: list[int]) -> Tensor:
        """Systems of scenes behind each other, extended to equal numbers of rows."""
        bands = [self.solvers[number].whole_system() for number in group]
        width = max(band.shape[1] // 2 for band in bands)
        rows = max(len(band) - band.shape[1] // 2 for band in bands)
        return torch.cat([extend_system(band, rows, width) for band in bands], -1)

    def fit(self, data: Sequence[Tensor] | Tensor) -> list[Tensor]:
        """Coefficients of every scene for its data, as from ``SceneSolver.fit``."""
        coefficients: list[Tensor] = []
        for place, group in enumerate(self._groups):
            solvers = [self.solvers[number] for number in group]
            if len(group) == 1:
                coefficients.append(solvers[0].fit(data[group[0]]))
                continue
            rights = [solver.whole_right_side(data[number]) for solver, number in zip(solvers, group, strict=True)]
            rows = max(map(len, rights))
            right = torch.cat([functional.pad(side, (0, 0, 0, 0, 0, rows - len(side))) for side in rights], -1)
            solutions = solve_skewed(self._factors.get(place) or self._system(group), right)
            parts = solutions.split([solver.num_systems for solver in solvers], -1)
            coefficients += [
                solver.joined(part[: len(side)]) for solver, part, side in zip(solvers, parts, rights, strict=True)
            ]
        return coefficients

    def images(self, data: Sequence[Tensor]) -> list[Tensor]:
        """Images (C, R, L) of the scenes for their data."""
        return [solver.image(fitted) for solver, fitted in zip(self.solvers, self.fit(data), strict=True)]

    def predictions(self, data: Sequence[Tensor] | Tensor) -> list[Tensor]:
        """Noiseless frames of the scenes for their data."""
        return [solver.predict(fitted) for solver, fitted in zip(self.solvers, self.fit(data), strict=True)]
