"""How the rows of frames see the scene, and the banded normal equations that follow, one system per frequency.

A row that looked at N places (x_n, y_n) of the scene during its exposure has, at horizontal frequency u, the kernel
``K(u) = sum_n w_n h(. - y_n) exp(-2 pi i u x_n)``. Relative to the middle of the row's own range the x_n are small, so
that kernels and their products are smooth in u: they are worked out at a few Chebyshev nodes in double precision,
and all frequencies follow by one product of matrices. The phase of the middle goes to the data.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from rsvib_torch.core.fourier import shift_phases
from rsvib_torch.core.splines import spread_taps
from rsvib_torch.restoration.scene_model.row_kernel import REACH, SCENE_REACH, TAPS, kernel_weights
from rsvib_torch.restoration.scene_model.segments import Segments

__all__ = ["RowKernels", "SceneRows", "SmoothBand", "SmoothKernels", "row_kernels", "smooth_band", "smooth_kernels"]

_SHARP = 1.0  # px, along the rows or across them, that the scene may move during an exposure


@dataclass(frozen=True)
class SceneRows:
    """The scene rows that the frames see.

    Attributes:
        top: Index of the first one, in frame coordinates.
        count: How many there are.
    """

    top: int
    count: int


@dataclass(frozen=True, eq=False)
class RowKernels:
    """How the rows of M frames see the coefficients of the scene.

    Attributes:
        first: (M, R) first scene row of each row's kernel.
        taps: (M, R, J, N) weights of J scene rows at N nodes of the exposure, float64.
        middle: (M, R) displacement along the row in px that the phase of the data is corrected by, float64.
        along: (M, R, N) displacement along the row relative to the middle, float64.
        weight: (M, R) how much each row counts, float64.
    """

    first: Tensor
    taps: Tensor
    middle: Tensor
    along: Tensor
    weight: Tensor

    @cached_property
    def reach(self) -> float:
        """Largest distance along the row from the middle in px."""
        return float(self.along.detach().abs().amax())

    @property
    def blurred(self) -> bool:
        """Whether the scene moves by more than a px during an exposure."""
        return max(2.0 * self.reach, float(self.taps.shape[-2] - TAPS)) > _SHARP

    def scene_rows(self, num_rows: int) -> SceneRows:
        """All scene rows seen, and those that frames of ``num_rows`` rows need to be evaluated."""
        top = min(int(self.first.amin()), -SCENE_REACH)
        return SceneRows(top, max(int(self.first.amax()) + self.taps.shape[-2], num_rows + SCENE_REACH) - top)

    def rows(self, top: int, count: int) -> "RowKernels":
        """Kernels of ``count`` rows from row ``top`` on, counted from there."""
        part = slice(top, top + count)
        return RowKernels(
            self.first[:, part] - top,
            self.taps[:, part],
            self.middle[:, part],
            self.along[:, part],
            self.weight[:, part],
        )

    def at(self, frequencies: Tensor) -> Tensor:
        """Kernels (M, R, J, Q) without the phase of the middle."""
        angle = (-2 * math.pi) * self.along[..., None] * frequencies
        return torch.complex(self.taps @ angle.cos(), self.taps @ angle.sin())

    def phases(self, length: int, frequencies: slice, dtype: torch.dtype) -> Tensor:
        """``exp(2 pi i u x)`` of the middles (M, R, U) at frequencies ``u = k / length``."""
        return shift_phases(self.middle, length, frequencies, dtype.to_complex())


def row_kernels(displacement: Tensor, node_weights: Tensor, weight: Tensor, num_rows: int, margin: int) -> RowKernels:
    """Kernels of rows whose scene moved by ``displacement`` (M, R, N, 2).

    Rows that look further than ``margin`` px beyond the ``num_rows`` rows of the frame do not count.
    """
    rows = torch.arange(displacement.shape[-3], dtype=displacement.dtype, device=displacement.device)
    place = rows[:, None] - displacement[..., 1]
    cell = place.detach().floor()
    first, taps = spread_taps(cell, kernel_weights(place - cell) * node_weights[:, None])
    taps, count, first = taps.transpose(-2, -1), taps.shape[-1], first - (REACH - 1)
    near = (first > -margin - count) & (first < num_rows + margin)
    first = first.clamp(-margin - count, num_rows + margin)
    x = displacement[..., 0]
    middle = 0.5 * (x.detach().amin(-1) + x.detach().amax(-1))
    return RowKernels(first, taps, middle, x - middle[..., None], weight[:, None].to(torch.float64) * near)


def _interpolation(reach: float, u: Tensor, precision: float) -> tuple[Tensor, Tensor]:
    """Nodes (Q,) in 0 ... 1/2 cycles per px, and the matrix (2 Q, 2 U) to frequencies ``u``.

    It turns real and imaginary parts at the nodes of functions ``f(-u) = conj f(u)`` made of waves of up to ``reach``
    px into interleaved real and imaginary parts at ``u`` (the former are even, the latter odd Chebyshev series).
    """
    half = math.pi * reach
    degree, bound = 1, half
    while bound > precision or degree < half:
        degree += 1
        bound *= 0.5 * half / degree if half else 0.0
    count = degree // 2 + 1
    k = torch.arange(count, dtype=torch.float64, device=u.device)
    angles = math.pi * (2 * k + 1) / (4 * count)
    at = torch.acos((2 * u).clamp(-1, 1))
    matrix = u.new_zeros(2 * count, len(u), 2)
    for odd in (0, 1):
        order = 2 * k + odd
        series = torch.cos(angles[:, None] * order) * (2 / count)
        if not odd:
            series[:, 0] *= 0.5
        matrix[odd * count : (odd + 1) * count, :, odd] = series @ torch.cos(order[:, None] * at)
    return 0.5 * torch.cos(angles), matrix.flatten(1)


def _precision(dtype: torch.dtype) -> float:
    return 1e-5 if dtype == torch.float32 else 1e-15


def _stacked(values: Tensor) -> Tensor:
    return torch.cat([values.real, values.imag], dim=-1)


@dataclass(frozen=True, eq=False)
class SmoothKernels:
    """Kernels of all frequencies as one product of matrices.

    Attributes:
        left: (J, M R, 2 Q) real and imaginary parts at Q nodes of every tap of every row.
        reach: Distance along the rows in px that the kernels reach to.
    """

    left: Tensor
    reach: float

    def taps(self, u: Tensor) -> Iterator[Tensor]:
        """Kernels (M R, U), complex, without the phase of their middles, one tap after the other."""
        right = self.matrix(u)
        for tap in self.left:
            yield torch.view_as_complex((tap @ right).unflatten(-1, (-1, 2)))

    def matrix(self, u: Tensor) -> Tensor:
        """What turns ``left`` into interleaved real and imaginary parts at frequencies ``u``, (2 Q, 2 U)."""
        return _interpolation(self.reach, u, _precision(self.left.dtype))[1].to(self.left.dtype)


def smooth_kernels(kernels: RowKernels, dtype: torch.dtype) -> SmoothKernels:
    """Kernels of all rows in a form from which those at any frequency follow quickly."""
    nodes, _ = _interpolation(kernels.reach, kernels.middle.new_zeros(1), _precision(dtype))
    return SmoothKernels(
        _stacked(kernels.at(nodes)).to(dtype).flatten(0, 1).transpose(0, 1).contiguous(), kernels.reach
    )


@dataclass(frozen=True, eq=False)
class SmoothBand:
    """Normal matrices of all frequencies, prior included, as one product of matrices.

    Attributes:
        left: (R + b, 2 b + 1, n, 2 Q + p + 1) real and imaginary parts at Q nodes, and where each lag of the prior
            goes, for n windows of R rows; the last b rows are 0.
        reach: Distance along the rows in px that the products of kernels reach to.
        order: Order p of the prior.
        systems: Whether the windows are systems of their own, not parts of one.
    """

    left: Tensor
    reach: float
    order: int
    systems: bool = False

    @property
    def width(self) -> int:
        """The half-width b of the band."""
        return self.left.shape[1] // 2

    def in_segments(self, segments: Segments) -> "SmoothBand":
        """The matrices of all rows as those of windows of rows."""
        if segments.whole:
            return self
        windows = segments.split(self.left[: segments.rows, :, 0])
        return replace(self, left=torch.cat([windows, windows.new_zeros(self.width, *windows.shape[1:])]))

    def apart(self, count: int) -> "SmoothBand":
        """The matrix of ``count`` systems of one size, one after the other and not coupled by data, as these."""
        rows = self.left[: len(self.left) - self.width, :, 0].unflatten(0, (count, -1)).movedim(0, 2)
        return replace(self, left=torch.cat([rows, rows.new_zeros(self.width, *rows.shape[1:])]), systems=True)

    def at(self, u: Tensor, precision: Tensor, out: Tensor | None = None) -> Tensor:
        """Skewed bands (R + b, 2 b + 1, n U), complex.

        Args:
            u: Frequencies in cycles per px.
            precision: Products (p + 1, p + 1, U) of the prior there.
            out: Memory for them: fresh memory costs as much time as the product that fills it.
        """
        lags = torch.stack([precision.sum(1), torch.zeros_like(precision[:, 0])], dim=-1).flatten(1)
        right = torch.cat([_interpolation(self.reach, u, _precision(self.left.dtype))[1], lags]).to(self.left.dtype)
        rows = self.left.flatten(0, 2)
        if out is None:
            product = rows @ right
        else:
            product = torch.mm(rows, right, out=torch.view_as_real(out).view(len(rows), -1))
        bands = product.view(*self.left.shape[:3], -1, 2)
        width, real = self.width, bands[..., 0]
        count = len(self.left) - width
        first, last = (slice(None), slice(None)) if self.systems else (slice(1), slice(-1, None))
        for d in range(self.order + 1):
            for side in {d, -d}:
                for k in range(1, self.order + 1 - d):
                    top = max(0, -side)
                    real[top : top + k, width + side, first] -= precision[d, k]
                    bottom = count - max(0, side)
                    real[bottom - k : bottom, width + side, last] -= precision[d, k]
        return torch.view_as_complex(bands).flatten(2)


def smooth_band(kernels: RowKernels, rows: SceneRows, width: int, order: int, dtype: torch.dtype) -> SmoothBand:
    """Normal matrices ``sum w K^H K`` of all frames of one scene, to which a prior can be added.

    Args:
        kernels: How the frames see it.
        rows: Its rows.
        width: Half-width b of the band, at least the number of taps less 1 and the order of the prior.
        order: Order of the prior.
        dtype: Of the frames.
    """
    nodes, _ = _interpolation(2 * kernels.reach, kernels.middle.new_zeros(1), _precision(dtype))
    seen = kernels.at(nodes)
    weighted = seen * kernels.weight[..., None, None]
    base = (kernels.first - rows.top).flatten()
    sides: list[Tensor] = []
    taps = seen.shape[-2]
    for d in range(taps):
        entry = base[:, None] + torch.arange(taps - d, device=base.device)
        products = weighted[..., : taps - d, :].conj() * seen[..., d:, :]
        entries = seen.new_zeros(rows.count + width, len(nodes))
        sides.append(entries.index_add(0, entry.flatten(), products.flatten(0, 2)))  # A[k, k + d]
    absent = torch.zeros_like(sides[0])
    right = [sides[d] if d < len(sides) else absent for d in range(width + 1)]
    left = [torch.cat([absent[:d], right[d][: len(absent) - d].conj()]) for d in range(width, 0, -1)]
    lags = kernels.middle.new_zeros(len(absent), 2 * width + 1, order + 1)
    for d in range(order + 1):
        lags[: rows.count - d, width + d, d] = 1
        lags[d : rows.count, width - d, d] = 1
    matrix = torch.cat([_stacked(torch.stack(left + right, dim=1)), lags], dim=-1)
    return SmoothBand(matrix.to(dtype)[:, :, None], 2 * kernels.reach, order)
