"""One scene and the frames that see it: the fast solution, and what a solution predicts."""

from collections.abc import Callable

import torch
from torch import Tensor

from rsvib_torch.core.banded_solver import BandedFactor, factor_skewed, solve_factored, solve_skewed
from rsvib_torch.core.chunking import runs
from rsvib_torch.core.parallel import MadeOnce, in_parallel
from rsvib_torch.core.short_filters import correlated
from rsvib_torch.restoration.exact.interpolated_solver import NodeFactors
from rsvib_torch.restoration.exact.partition import Partition
from rsvib_torch.restoration.scene_model.observation import SeenScene
from rsvib_torch.restoration.scene_model.row_kernel import SCENE_REACH, scene_weights
from rsvib_torch.restoration.scene_model.row_sums import sum_looked_up

__all__ = ["Coefficients", "SceneSolver"]

_ROWS = {"cpu": 128}  # of the scene at a time: they stay in the cache

Coefficients = list[Tensor]  # (K, C, U') for each chunk of frequencies
SolvePart = Callable[[int, slice, Tensor | None], Tensor]  # thread, chunk of frequencies, pull: its coefficients


class SceneSolver:
    """Least squares for the coefficients of one scene, frequency by frequency.

    It minimises ``sum_m w_m |g_m - K_m c|^2 + c^H P c`` over the coefficients c of the scene.

    Args:
        seen: How M frames of R rows see the scene.
        precision: P, products (p + 1, p + 1, U) as from ``RowPrior.precision``, in units of the noise of weight 1.
        length: L, of the period of the data.
        partition: What is solved at a time.
        keep: Keep the factors, for solving again and again.
    """

    def __init__(
        self, seen: SeenScene, precision: Tensor, length: int, partition: Partition, *, keep: bool = False
    ) -> None:
        self.kernels, self.rows, self.num_rows, self.dtype = seen.kernels, seen.rows, seen.num_rows, seen.dtype
        self.length, self.precision = length, precision
        self.u = torch.fft.rfftfreq(length, dtype=torch.float64, device=precision.device)
        normal = seen.band(len(precision) - 1)
        size_of_all, device, blurred = (self.rows.count, normal.width), precision.device, self.kernels.blurred
        if keep:
            shares = partition.factoring_all(*size_of_all, len(self.u), device, blurred=blurred, keep=True)
        else:
            shares = partition.of(*size_of_all, length, device, self.kernels.reach, blurred=blurred)
        self._shares, self._segments = shares, shares.segments
        self._whole, self._normal = normal, normal.in_segments(shares.segments)
        self._partition = partition
        self.parts = shares.parts(len(self.u))
        self._seen, self._sums = seen.smooth, seen.sums
        self._sampling = torch.tensor([scene_weights()], dtype=seen.dtype, device=precision.device)
        self._factors: list[BandedFactor] | None = None
        moving = self._normal.left.requires_grad or precision.requires_grad
        if keep and not (torch.is_grad_enabled() and moving):
            self._factors = [factor_skewed(self._normal.at(self.u[p], precision[..., p])) for p in self.parts]

    def _right(self, spectra: Tensor, part: slice, out: Tensor | None = None) -> Tensor:
        """``K^H W g`` (K, C, U') of a chunk of the spectra (M, C, R, U) of data."""
        turned = spectra[..., part] * self.kernels.phases(self.length, part, self.dtype)[:, None]
        return self._sums.of(turned.transpose(1, 2).flatten(0, 1), self.u[part], out)

    def fit(self, data: Tensor, pull: Coefficients | None = None) -> Coefficients:
        """The coefficients for data (M, C, R, L).

        Args:
            data: Rows continued to a period.
            pull: To be added to the right sides: P times what the prior expects.
        """
        spectra = torch.fft.rfft(data)
        differentiated = self._differentiates(spectra, *(pull or ()))
        if self._factors is None and not differentiated:
            return self._fit_in_place(spectra, pull)
        solutions = []
        for k, part in enumerate(self.parts):
            shape = (self.rows.count, spectra.shape[1], part.stop - part.start)
            right = self._right(spectra, part, None if differentiated else spectra.new_empty(shape))
            split = self._segments.split(right if pull is None else right + pull[k]).flatten(-2)
            if self._factors is None:
                solved = solve_skewed(self._normal.at(self.u[part], self.precision[..., part]), split)
            else:
                solved = solve_factored(self._factors[k], split)
            solutions.append(self._segments.join(solved.unflatten(-1, (-1, right.shape[-1]))))
        return solutions

    def _fit_in_place(self, spectra: Tensor, pull: Coefficients | None) -> Coefficients:
        """``fit`` without gradients."""
        found: Coefficients = [spectra.new_empty(0)] * len(self.parts)

        def keep(k: int, solved: Tensor) -> None:
            found[k] = solved.conj_physical() if self._shares.nodes is not None else solved.clone()

        self._solve_in_place(spectra, pull, keep)
        return found

    def _solve_in_place(self, spectra: Tensor, pull: Coefficients | None, take: Callable[[int, Tensor], None]) -> None:
        """Solve without gradients, in memory that is used again and again, and on all cores.

        Args:
            spectra: (M, C, R, U) of the data.
            pull: As in ``fit``.
            take: Is given each chunk's number and its coefficients (K, C, U'), conjugated where there are nodes, in
                memory that will be used again.
        """
        threads = min(self._partition.threads(spectra.device), len(self.parts))
        nodes = self._shares.nodes
        if nodes is None:
            solve_part = self._factoring_all(threads, spectra)
        else:
            solve_part = self._factoring_few(nodes, threads, spectra)

        def solve(thread: int) -> None:
            for k in range(thread, len(self.parts), threads):
                take(k, solve_part(thread, self.parts[k], None if pull is None else pull[k]))

        in_parallel(solve, range(threads), spectra.device)

    def _factoring_all(self, threads: int, spectra: Tensor) -> SolvePart:
        """How to find coefficients at a chunk of frequencies, each by itself."""
        width, rows, right_sides = self._normal.width, self._segments.size, spectra.shape[1]
        batch = len(self._segments.windows) * self._shares.chunk
        memories = [self._partition.memory(k, rows, width, right_sides, batch, spectra) for k in range(threads)]

        def solve_part(thread: int, part: slice, pull: Tensor | None) -> Tensor:
            memory, chunk = memories[thread], self._wide(part)
            self._normal.at(self.u[chunk], self.precision[..., chunk], memory.full[: rows + width])
            self._prepare(memory.right_side[:rows], spectra, part, pull)
            return self._joined(memory.solve(rows), part)

        return solve_part

    def _factoring_few(self, nodes: Tensor, threads: int, spectra: Tensor) -> SolvePart:
        """How to find coefficients at a chunk of frequencies, with factors between those of a few."""
        segments = self._shares.node_segments or self._segments
        normal, rows = self._whole.in_segments(segments), segments.size
        batch = len(segments.windows) * len(nodes)
        memory = self._partition.memory("nodes", rows, normal.width, 0, batch, spectra)

        def factored() -> NodeFactors:
            normal.at(self.u[nodes], self.precision[..., nodes], memory.full[: rows + normal.width])
            found = NodeFactors.of(nodes, memory.factor(rows), segments)
            return found if self._segments.whole else found.in_segments(self._segments)

        height = self._segments.size
        sizes = (normal.width, spectra.shape[1], len(self._segments.windows), self._shares.chunk)
        memories = [self._partition.substitution_memory(k, height, *sizes, spectra) for k in range(threads)]
        factors = MadeOnce(factored, self._partition.lock)

        def solve_part(thread: int, part: slice, pull: Tensor | None) -> Tensor:
            own, chunk = memories[thread], self._wide(part)
            factors.begin()
            self._prepare(own.right_side[:height], spectra, part, pull)
            made = factors.get()
            return self._joined(own.solve(made, made.between(chunk.start, chunk.stop)), part)

        return solve_part

    def _wide(self, part: slice) -> slice:
        """As many frequencies as in all other parts: the last one is solved as wide as the others."""
        return slice(part.stop - self._shares.chunk, part.stop)

    def _prepare(self, sides: Tensor, spectra: Tensor, part: slice, pull: Tensor | None) -> None:
        """Write the right sides (K, C, n S) of a part."""
        whole = self._segments.whole
        right = self._right(spectra, self._wide(part), sides if whole else None)
        if pull is not None:
            right[..., part.start - part.stop :] += pull
        if not whole:
            sides.copy_(self._segments.split(right).flatten(-2))

    def _joined(self, solved: Tensor, part: slice) -> Tensor:
        """Coefficients (K, C, U') of a part from solutions (K, C, n S)."""
        windows = solved.unflatten(-1, (-1, self._shares.chunk))[..., part.start - part.stop :]
        return windows[..., 0, :] if self._segments.whole else self._segments.join(windows)

    def predict(self, coefficients: Coefficients) -> Tensor:
        """What the frames show of a scene, (M, C, R, L)."""
        spectra = []
        for part, values in zip(self.parts, coefficients, strict=True):
            phases = self.kernels.phases(self.length, part, self.dtype).conj()
            rows = self._seen_rows(values, self.u[part])
            spectra.append(rows.unflatten(0, phases.shape[:2]) * phases[:, :, None])
        images: Tensor = torch.fft.irfft(torch.cat(spectra, dim=-1).transpose(1, 2), n=self.length)
        return images

    def _seen_rows(self, values: Tensor, u: Tensor) -> Tensor:
        """What the rows (M R, C, U') see of coefficients (K, C, U'), without the phase of their middles."""
        base, left = self._sums.base, self._seen.left
        if not self._differentiates(values):
            source = base[:, None] + torch.arange(len(left), device=base.device)
            out = values.new_empty(len(base), *values.shape[1:])
            return sum_looked_up(values, source, left.transpose(0, 1), self._seen.matrix(u), out)
        seen = (kernel[:, None] * values[base + i] for i, kernel in enumerate(self._seen.taps(u)))
        return sum(seen, start=values.new_zeros(()))

    def scene(self, coefficients: Coefficients) -> Tensor:
        """Rows of the scene where the frame at rest would show them, (C, R, L)."""
        spectra = torch.cat([self._between_rows(values) for values in coefficients], dim=-1)
        scene: Tensor = torch.fft.irfft(spectra.movedim(1, 0), n=self.length)
        return scene

    def fit_scene(self, data: Tensor, width: int, level: Tensor, out: Tensor | None = None) -> Tensor:
        """The first ``width`` columns of ``scene(fit(data))`` and a brightness on top.

        Coefficients are kept only to be differentiated.

        Args:
            data: As in ``fit``.
            width: Columns.
            level: (C, 1, 1) the brightness.
            out: (C, R, width) where to write them; nothing is then differentiated.
        """
        spectra = torch.fft.rfft(data)
        if self._factors is not None or self._differentiates(spectra):
            return torch.add(self.scene(self.fit(data))[..., :width], level, out=out)
        found = spectra.new_empty(self.num_rows, spectra.shape[1], len(self.u))
        blocks = runs(self.num_rows, _ROWS.get(found.device.type, self.num_rows))

        def take(k: int, solved: Tensor) -> None:
            for rows in blocks:
                sampled = self._between_rows(solved, rows)
                found[rows, :, self.parts[k]] = sampled if self._shares.nodes is None else sampled.conj()

        self._solve_in_place(spectra, None, take)
        image = data.new_empty(spectra.shape[1], self.num_rows, width) if out is None else out
        for rows in blocks:
            scene = torch.fft.irfft(found[rows].movedim(1, 0), n=self.length)[..., :width]
            torch.add(scene, level, out=image[:, rows])
        return image

    def _differentiates(self, *values: Tensor) -> bool:
        given = (*values, self._normal.left, self.precision)
        return torch.is_grad_enabled() and any(value.requires_grad for value in given)

    def _between_rows(self, coefficients: Tensor, rows: slice | None = None) -> Tensor:
        """What coefficients (K, C, U') make of some rows of the scene, by default all."""
        chosen = slice(0, self.num_rows) if rows is None else rows
        first = chosen.start - SCENE_REACH - self.rows.top
        near = coefficients[first : first + chosen.stop - chosen.start + 2 * SCENE_REACH]
        sampled = correlated(torch.view_as_real(near).flatten(1), self._sampling, 0)[0]
        return torch.view_as_complex(sampled.unflatten(1, (*near.shape[1:], 2)))
