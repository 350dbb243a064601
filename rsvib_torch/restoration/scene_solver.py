"""One scene and the frames that see it: the fast solution, and what a solution predicts."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.restoration.banded_solver import BandedFactor, factor_skewed, solve_factored, solve_skewed
from rsvib_torch.restoration.row_kernel import REACH, kernel_samples
from rsvib_torch.restoration.row_system import RowKernels, smooth_band, smooth_kernels
from rsvib_torch.restoration.segments import Segments

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
        chunk: Frequencies solved at a time.
        weight: (M, R) of the rows, by default that of the kernels.
        keep: Keep the factors, for solving again and again.
        segments: Number of overlapping segments of rows that are solved side by side.
    """

    def __init__(
        self,
        kernels: RowKernels,
        precision: Tensor,
        size: tuple[int, int],
        dtype: torch.dtype,
        chunk: int,
        *,
        weight: Tensor | None = None,
        keep: bool = False,
        segments: int = 1,
    ) -> None:
        self.kernels = kernels if weight is None else replace(kernels, weight=weight)
        self.num_rows, self.length = size
        self.rows = kernels.scene_rows(self.num_rows)
        self.u = torch.fft.rfftfreq(self.length, dtype=torch.float64, device=precision.device)
        self.parts = [slice(k, min(k + chunk, len(self.u))) for k in range(0, len(self.u), chunk)]
        self.dtype = dtype
        self.precision = precision
        order = len(precision) - 1
        self._normal = smooth_band(self.kernels, self.rows, max(kernels.taps.shape[-2] - 1, order), order, dtype)
        self._seen = smooth_kernels(kernels, dtype)
        self._base = (kernels.first - self.rows.top).flatten()
        self._segments = Segments(self.rows.count, segments)
        self._factors: list[BandedFactor] | None = None
        if keep and not (torch.is_grad_enabled() and self._normal.left.requires_grad):
            self._factors = [
                factor_skewed(self._segments.split_band(self._normal.at(self.u[part], precision[..., part])))
                for part in self.parts
            ]

    def _rights(self, data: Tensor) -> Iterator[Tensor]:
        """``K^H W g`` of data (M, C, R, L), chunk by chunk."""
        spectra = torch.fft.rfft(data)
        weight = self.kernels.weight.to(self.dtype)[:, None, :, None]
        for part in self.parts:
            turned = spectra[..., part] * self.kernels.phases(self.length, part, self.dtype)[:, None]
            turned = (turned * weight).transpose(1, 2).flatten(0, 1).conj()
            right = turned.new_zeros(self.rows.count, *turned.shape[1:])
            for i, kernel in enumerate(self._seen.taps(self.u[part])):
                right = right.index_add_(0, self._base + i, kernel[:, None] * turned)
            yield right.conj().resolve_conj()

    def fit(self, data: Tensor, pull: Coefficients | None = None) -> Coefficients:
        """The coefficients for data (M, C, R, L).

        Args:
            data: Rows continued to a period.
            pull: To be added to the right sides: P times what the prior expects.
        """
        memory = self._normal.memory(max(part.stop - part.start for part in self.parts))
        solutions = []
        for k, (part, right) in enumerate(zip(self.parts, self._rights(data), strict=True)):
            wanted = right if pull is None else right + pull[k]
            if self._factors is None:
                full = self._normal.at(self.u[part], self.precision[..., part], memory)
                solved = solve_skewed(self._segments.split_band(full), self._segments.split(wanted))
            else:
                solved = solve_factored(self._factors[k], self._segments.split(wanted))
            solutions.append(self._segments.join(solved))
        return solutions

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
        spectra = torch.cat(
            [
                sum(
                    (
                        weight * values[first + k : first + k + self.num_rows]
                        for k, weight in enumerate(kernel_samples())
                    ),
                    start=values.new_zeros(()),
                )
                for values in coefficients
            ],
            dim=-1,
        )
        rows: Tensor = torch.fft.irfft(spectra.movedim(1, 0), n=self.length)
        return rows
