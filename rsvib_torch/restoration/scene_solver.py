"""One scene and the frames that see it: the fast solution, and what a solution predicts."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.parallel import in_parallel
from rsvib_torch.restoration.banded_solver import BandedFactor, factor_skewed, solve_factored, solve_skewed
from rsvib_torch.restoration.partition import Partition
from rsvib_torch.restoration.row_kernel import REACH, kernel_samples
from rsvib_torch.restoration.row_system import RowKernels, smooth_band, smooth_kernels

__all__ = ["Coefficients", "SceneSolver"]

Coefficients = list[Tensor]  # (K, C, U') for each chunk of frequencies


class SceneSolver:
    """Least squares for the coefficients of one scene, frequency by frequency.

    It minimises ``sum_m w_m |g_m - K_m c|^2 + c^H P c`` over the coefficients c of the scene.

    Args:
        kernels: How M frames of R rows see the scene.
        precision: P, products (p + 1, p + 1, U) as from ``RowPrior.precision``, in units of the noise of weight 1.
        size: Rows R and length L of the period of the data.
        dtype: Of the data.
        partition: What is solved at a time.
        weight: (M, R) of the rows, by default that of the kernels.
        keep: Keep the factors, for solving again and again.
    """

    def __init__(
        self,
        kernels: RowKernels,
        precision: Tensor,
        size: tuple[int, int],
        dtype: torch.dtype,
        partition: Partition,
        *,
        weight: Tensor | None = None,
        keep: bool = False,
    ) -> None:
        self.kernels = kernels if weight is None else replace(kernels, weight=weight)
        self.num_rows, self.length = size
        self.rows = kernels.scene_rows(self.num_rows)
        self.u = torch.fft.rfftfreq(self.length, dtype=torch.float64, device=precision.device)
        self.dtype = dtype
        self.precision = precision
        order = len(precision) - 1
        width = max(kernels.taps.shape[-2] - 1, order)
        normal = smooth_band(self.kernels, self.rows, width, order, dtype)
        self._chunk, self._segments = partition.of(
            self.rows.count, width, len(self.u), precision.device, blurred=kernels.blurred, keep=keep
        )
        self._normal = normal.in_segments(self._segments)
        self._partition = partition
        self.parts = [slice(k, min(k + self._chunk, len(self.u))) for k in range(0, len(self.u), self._chunk)]
        self._seen = smooth_kernels(kernels, dtype)
        self._base = (kernels.first - self.rows.top).flatten()
        self._factors: list[BandedFactor] | None = None
        moving = self._normal.left.requires_grad or precision.requires_grad
        if keep and not (torch.is_grad_enabled() and moving):
            self._factors = [factor_skewed(self._normal.at(self.u[p], precision[..., p])) for p in self.parts]

    def _right(self, spectra: Tensor, part: slice) -> Tensor:
        """``K^H W g`` (K, C, U') of a chunk of the spectra (M, C, R, U) of data."""
        weight = self.kernels.weight.to(self.dtype)[:, None, :, None]
        turned = spectra[..., part] * self.kernels.phases(self.length, part, self.dtype)[:, None]
        turned = (turned * weight).transpose(1, 2).flatten(0, 1).conj().resolve_conj()
        right = turned.new_zeros(self.rows.count, *turned.shape[1:])
        for i, kernel in enumerate(self._seen.taps(self.u[part])):
            right = right.index_add_(0, self._base + i, kernel[:, None] * turned)
        return right.conj().resolve_conj()

    def fit(self, data: Tensor, pull: Coefficients | None = None) -> Coefficients:
        """The coefficients for data (M, C, R, L).

        Args:
            data: Rows continued to a period.
            pull: To be added to the right sides: P times what the prior expects.
        """
        spectra = torch.fft.rfft(data)
        given = (spectra, self._normal.left, self.precision, *(pull or ()))
        if self._factors is None and not (torch.is_grad_enabled() and any(value.requires_grad for value in given)):
            return self._fit_in_place(spectra, pull)
        solutions = []
        for k, part in enumerate(self.parts):
            right = self._right(spectra, part)
            split = self._segments.split(right if pull is None else right + pull[k]).flatten(-2)
            if self._factors is None:
                solved = solve_skewed(self._normal.at(self.u[part], self.precision[..., part]), split)
            else:
                solved = solve_factored(self._factors[k], split)
            solutions.append(self._segments.join(solved.unflatten(-1, (-1, right.shape[-1]))))
        return solutions

    def _fit_in_place(self, spectra: Tensor, pull: Coefficients | None) -> Coefficients:
        """``fit`` without gradients, in memory that is used again and again, and on all cores."""
        segments, width = self._segments, self._normal.width
        rows, batch = segments.size, len(segments.windows) * self._chunk
        threads = min(self._partition.threads(spectra.device), len(self.parts))

        def solve(thread: int) -> Coefficients:
            memory = self._partition.memory(thread, rows, width, spectra.shape[1], batch, spectra)
            sides = memory.right_side[:rows].unflatten(-1, (-1, self._chunk))
            solutions = []
            for k in range(thread, len(self.parts), threads):
                part = self.parts[k]
                chunk = slice(part.stop - self._chunk, part.stop)  # the last part is solved as wide as the others
                self._normal.at(self.u[chunk], self.precision[..., chunk], memory.full[: rows + width])
                right = self._right(spectra, chunk)
                own = slice(part.start - part.stop, None)
                if pull is not None:
                    right[..., own] += pull[k]
                for place, window in enumerate(segments.windows):
                    sides[..., place, :] = right[window]
                solved = memory.solve(rows).unflatten(-1, (-1, self._chunk))
                solutions.append(segments.join(solved[..., own]))
            return solutions

        shares = in_parallel(solve, range(threads), spectra.device)
        return [shares[k % threads][k // threads] for k in range(len(self.parts))]

    def predict(self, coefficients: Coefficients) -> Tensor:
        """What the frames show of a scene, (M, C, R, L)."""
        spectra = []
        for part, values in zip(self.parts, coefficients, strict=True):
            rows = sum(
                (kernel[:, None] * values[self._base + i] for i, kernel in enumerate(self._seen.taps(self.u[part]))),
                start=values.new_zeros(()),
            )
            phases = self.kernels.phases(self.length, part, self.dtype).conj()
            spectra.append(rows.unflatten(0, phases.shape[:2]) * phases[:, :, None])
        images: Tensor = torch.fft.irfft(torch.cat(spectra, dim=-1).transpose(1, 2), n=self.length)
        return images

    def scene(self, coefficients: Coefficients) -> Tensor:
        """Rows of the scene where the frame at rest would show them, (C, R, L)."""
        first = 1 - REACH - self.rows.top
        spectra = []
        for values in coefficients:
            rows = values.new_zeros(self.num_rows, *values.shape[1:])
            for k, weight in enumerate(kernel_samples()):
                rows = rows.add(values[first + k : first + k + self.num_rows], alpha=weight)
            spectra.append(rows)
        scene: Tensor = torch.fft.irfft(torch.cat(spectra, dim=-1).movedim(1, 0), n=self.length)
        return scene
