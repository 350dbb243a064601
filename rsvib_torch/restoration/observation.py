"""The observation operator: interpolation between scene rows, kernels of the rows of frames, and normal equations.

The kernel h interpolates the scene between its rows from the coefficients.

A row that is displaced by (x_n, y_n) at N times of its exposure has, at horizontal frequency u, the kernel
``K(u) = sum_n w_n h(. - y_n) exp(-2 pi i u x_n)``. Relative to the middle of the range of the row the x_n are small, so
that kernels and their products are smooth in u: they are computed at a few Chebyshev nodes in double precision and
interpolated to all frequencies by one matrix product. The phase of the middle is applied to the data.

On the finer grid of half pixels, the scene after optics and pixel contains detail beyond half a cycle per pixel. Along
the rows, the spectrum of a frame at u (0 ... 1/2 cycles per px) is the sum of the spectra of the scene at u and at its
alias u - 1, which have different kernels: ``K_a(u) = sum_n w_n h(. - 2 y_n) exp(-2 pi i (u - a) x_n)`` for a = 0, 1.
Across the rows, the scene is a cubic B-spline h with a knot every half row. Unknowns are numbered 2 j + a for row j of
the coefficients, so that the normal equations are one banded system per u. Relative to the middle x of a row, the alias
has the phase ``exp(2 pi i x)``, which does not depend on u: kernels are smooth in u, as on the pixel grid.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np
import torch
from numpy.polynomial.chebyshev import chebvander
from scipy.special import comb
from torch import Tensor
from torch.nn import functional

from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.imaging.blur import row_taps, row_transfer
from rsvib_torch.numerics.banded_solver import from_both_ends
from rsvib_torch.numerics.interpolation import bspline_weights, correlated, gauss_legendre, shift_phases, waves
from rsvib_torch.numerics.tables import Array, constant

KERNEL_REACH = 3  # rows on either side; support of the kernel
TAPS = 2 * KERNEL_REACH
SCENE_REACH = 5  # rows of the grid on either side; support of the weights of a scene row
SCALE = 2  # points per px of the finer grid, and unknowns per frequency
_SPLINE_DEGREE = 3  # of the interpolation on the finer grid
MARGIN = 16  # most rows by which a scene extends beyond the frame; rows displaced further have weight 0
# The kernel is (1 - z^2)^2 times this polynomial in z^2, z the distance divided by the reach. It has the least error of
# interpolation (gain and aliases, -52 dB of the power) for power spectra like frequency^-2 behind Gaussian optics of
# sigma 0.6 px, of all such kernels with a transfer function of at least 5 % at half a cycle per row: less makes the
# coefficients ill-conditioned (the quintic B-spline has 7 %).
_POLYNOMIAL = (
    0.5769045436701062,
    -3.0182129505404856,
    5.466830566399834,
    -6.758201648807548,
    6.263407370735177,
    -2.8993528884704753,
)


def _kernel(distance: Tensor) -> Tensor:
    """Kernel at distances of at most ``KERNEL_REACH``; the sum of its values at whole distances is 1 to 5e-4."""
    square = (distance / KERNEL_REACH).square()
    *lower, value = constant(np.array, _POLYNOMIAL, dtype=square.dtype, device=square.device).unbind()
    for coefficient in reversed(lower):
        value = torch.addcmul(coefficient, value, square)
    return value * (1 - square).square()


def kernel_weights(fraction: Tensor) -> Tensor:
    """Weights (S, 6) of the six rows ``n - 2 ... n + 3`` at positions ``n + fraction`` (S); their sum is 1 to 5e-4."""
    taps = torch.arange(1 - KERNEL_REACH, KERNEL_REACH + 1, dtype=fraction.dtype, device=fraction.device)
    return _kernel(fraction[..., None] - taps)


def kernel_samples() -> tuple[float, ...]:
    """The kernel at the rows -2 ... 2."""
    return tuple(_kernel(torch.arange(1 - KERNEL_REACH, KERNEL_REACH, dtype=torch.float64, device="cpu")).tolist())


@cache
def _kernel_nodes() -> tuple[Tensor, Tensor]:
    """Distances on one side at which the kernel is integrated, times 2 pi, and twice its values times the weights."""
    nodes, weights = gauss_legendre(32)
    places = nodes * KERNEL_REACH
    return 2 * torch.pi * places, 2 * KERNEL_REACH * weights * _kernel(places)


def kernel_spectrum(frequencies: Tensor, points: int = 1) -> Tensor:
    """Fourier transform of the kernel at frequencies in cycles per px, for one point or two points of the scene per px.

    On the finer grid, it is that of the cubic B-spline on half pixels.
    """
    if points > 1:
        return torch.sinc(frequencies / points) ** (_SPLINE_DEGREE + 1)
    places, values = (table.to(frequencies) for table in _kernel_nodes())
    return torch.cos(frequencies[..., None] * places) @ values


@cache
def scene_weights(points: int) -> tuple[float, ...]:
    """Weights of the coefficients of rows -5 ... 5 of the grid in a row of the scene.

    On the rows, a wave of coefficients interpolated by the kernel has the amplitude of ``kernel_spectrum`` plus that of
    its aliases, which exposures, and frames that sample at many places, do not contain. So the scene is the
    interpolation without aliases: the least-squares fit of these weights to ``kernel_spectrum`` up to 0.46 cycles per
    row, for amplitude spectra like frequency^-1 behind Gaussian optics of sigma 0.6 px.

    On the finer grid, the fit extends to 0.9 cycles per px. Samples of the spline, weights 1/6, 4/6 and 1/6, include
    its aliases: gratings across the rows have 1.14 times their contrast at 0.75 cycles per px.
    """
    v = np.linspace(0, 0.46, 369) if points == 1 else np.linspace(0, 0.9, 181)
    spectrum, counts = kernel_spectrum(torch.from_numpy(v), points).numpy(), np.ones_like(v)
    if points == 1:
        counts = np.exp(-0.5 * np.square(2 * np.pi * 0.6 * v)) / ((v + 0.02) * spectrum)
    # the symmetric filter with the least squared differences times the squares of the counts
    order = np.arange(SCENE_REACH + 1)
    cosines = np.cos(2 * np.pi / points * v[:, None] * order) * np.where(order > 0, 2.0, 1.0)
    half = np.linalg.lstsq(cosines * counts[:, None], spectrum * counts)[0]
    weights = np.concatenate([half[:0:-1], half])
    return tuple((weights if points == 1 else weights / weights.sum()).tolist())


@dataclass(frozen=True, eq=False)
class RowKernels:
    """Kernels of the rows of M frames, which act on the coefficients of their scene."""

    first: Tensor  # (M, R) first scene row of the kernel of each row
    taps: Tensor  # (M, R, J, N) weights of J scene rows at N nodes of the exposure, float64
    middle: Tensor  # (M, R) displacement along the row in px that the phase of the data is corrected by, float64
    along: Tensor  # (M, R, N) displacement along the row relative to the middle, float64
    weight: Tensor  # (M, R) weight of each row, float64

    points: int = 1  # of the scene per px, and unknowns per point

    @cached_property
    def blur_reach(self) -> float:
        """Largest distance along the row in px during an exposure from the middle of its range."""
        return float(self.along.detach().abs().amax())

    @classmethod
    def of_rows(
        cls,
        displacement: Tensor,
        node_weights: Tensor,
        weight: Tensor,
        num_rows: int,
        *,
        margin: int = MARGIN,
        points: int = 1,
    ) -> "RowKernels":
        """Kernels of rows with displacement (M, R, N, 2) px during the exposure, in frames of a weight (M,).

        Rows whose content lies more than ``margin`` px outside the ``num_rows`` rows of the frame have weight 0.
        """
        rows = torch.arange(displacement.shape[-3], dtype=displacement.dtype, device=displacement.device)
        place = points * (rows[:, None] - displacement[..., 1])
        interpolate = kernel_weights if points == 1 else partial(bspline_weights, degree=_SPLINE_DEGREE)
        first, taps = row_taps(place, node_weights, interpolate)
        first = first - (KERNEL_REACH - 1 if points == 1 else _SPLINE_DEGREE // 2)
        low, high = -points * margin - taps.shape[-2], points * (num_rows + margin)
        weight = weight[:, None].to(torch.float64) * ((first > low) & (first < high))
        along = displacement[..., 0]
        middle = torch.stack(along.detach().aminmax(dim=-1)).mean(0)
        if points > 1:
            taps = taps.repeat_interleave(points, -2)
        first = points * first.clamp(low, high)
        return cls(first, taps, middle, along - middle[..., None], weight, points)

    @property
    def blurred(self) -> bool:
        """Whether the displacement changes by more than 1 px during an exposure."""
        at_rest = TAPS if self.points == 1 else _SPLINE_DEGREE + 1
        return max(2.0 * self.blur_reach, (self.taps.shape[-2] / self.points - at_rest) / self.points) > 1.0

    def rows(self, part: slice) -> "RowKernels":
        """Kernels of some neighbouring rows, counted from the first of them."""
        if part == slice(0, self.first.shape[1]):
            return self
        taps, middle, along, weight = (values[:, part] for values in (self.taps, self.middle, self.along, self.weight))
        return RowKernels(self.first[:, part] - part.start, taps, middle, along, weight, self.points)

    def at(self, frequencies: Tensor) -> Tensor:
        """Kernels (M, R, J, Q) without the phase of the middle at the frequency."""
        if self.points == 1:
            return row_transfer(self.taps, self.along, frequencies)
        direct, alias = (row_transfer(self.taps[..., a :: self.points, :], self.along, frequencies - a) for a in (0, 1))
        phase = waves(self.middle, -torch.ones_like(self.middle[0, :1]))[..., None]
        return torch.stack([direct, alias * phase], dim=-2).flatten(-3, -2)


def interpolation_matrix(reach: float, u: Tensor | None, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Nodes (Q,) in 0 ... 1/2 cycles per px, and the matrix (2 Q, 2 U) to frequencies ``u`` (U,) on the CPU.

    Sums of waves of up to ``reach`` px are interpolated from real and imaginary parts at the nodes to interleaved real
    and imaginary parts at ``u`` by Chebyshev series.
    """
    precision = 1e-5 if dtype == torch.float32 else 1e-15
    half = 0.5 * math.pi * reach
    degree, bound = 1, half
    while bound > precision or degree < half:
        degree += 1
        bound *= 0.5 * half / degree if half else 0.0
    # polynomials of 4 u - 1 in -1 ... 1
    count = degree + 1
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    of_nodes = chebvander(nodes, degree) * (2 / count)
    of_nodes[:, 0] *= 0.5
    series = of_nodes @ chebvander(4 * (np.zeros(0) if u is None else u.numpy()) - 1, degree).T
    matrix = np.zeros((2, *series.shape, 2))
    matrix[0, ..., 0] = matrix[1, ..., 1] = series
    return torch.from_numpy(0.25 * (1 + nodes)), torch.from_numpy(matrix.reshape(2 * count, -1))


def most_values(device: torch.device) -> int:
    """Values of the bands in memory at a time: 128 MB on a CPU, 2 GB on a GPU."""
    return 1 << 24 if device.type == "cpu" else 1 << 28


def _stacked(values: Tensor) -> Tensor:
    return torch.cat([values.real, values.imag], dim=-1)


@dataclass(frozen=True, eq=False)
class SmoothBand:
    """Normal matrices of N scenes at any frequencies by one matrix product, to which the prior is added.

    In windows, both tensors are halves as from ``from_both_ends``: of W windows of each scene.
    """

    # (R + b, 2 b + 1, N, 2 Q) real and imaginary parts at Q nodes of systems of R rows, the last b rows are 0; in
    # windows (H + b, 2 b + 1, 2, N W, 2 Q)
    matrices: Tensor
    prior: Tensor  # (R + b, 2 b + 1, P) matrices whose sum with factors is the precision; (H + b, 2 b + 1, 2, W, P)
    order: int  # of the prior: its matrices have so many diagonals on either side, but 0
    reach: float  # largest distance along the rows in px of the products of kernels

    def in_windows(self, windows: list[slice]) -> "SmoothBand":
        """The matrices of all rows as those of windows of rows, eliminated from both ends."""
        width = self.matrices.shape[1] // 2

        def halves(values: Tensor) -> Tensor:
            parts = torch.stack([values[window] for window in windows], dim=3).flatten(2, 3)
            return from_both_ends(torch.cat([parts, parts.new_zeros(width, *parts.shape[1:])]))

        return replace(self, matrices=halves(self.matrices), prior=halves(self.prior[:, :, None]))

    def at(self, u: Tensor, precision: Tensor) -> Tensor:
        """Halves (H + b, 2 b + 1, 2 n U) of the matrices in windows, complex, at frequencies u (U,) in cycles per px.

        The ``precision`` are factors (p, q, N, U) of the P = p q matrices of the prior there; those of several priors,
        of all scenes one after the other, make as many matrices of each scene.
        """
        interpolation = interpolation_matrix(self.reach, u, self.matrices.dtype)[1]
        bands = (self.matrices @ interpolation.to(self.matrices)).unflatten(-1, (-1, 2))
        width, windows = bands.shape[1] // 2, self.prior.shape[3]
        priors = precision.shape[2] * windows // bands.shape[3]
        bands = bands if priors == 1 else bands.repeat(1, 1, 1, priors, 1, 1)
        # real parts of the diagonals of both halves (H + b, 2 o + 1, 2, N, W, U)
        near = slice(width - self.order, width + self.order + 1)
        real = bands[:, near, ..., 0].unflatten(3, (-1, windows))
        # sum over the matrices of the prior
        real += torch.einsum("rdewp,pnu->rdenwu", self.prior[:, near], precision.flatten(0, 1).to(self.prior))
        return torch.view_as_complex(bands).flatten(2)


def autoregressive_bands(count: int, order: int) -> Array:
    """Bands (K, 2 p + 1, (p + 1)^2) of the precision of K rows for each product (d, k) as of ``RowPrior.products``.

    An entry of rows i and j at distance d is the sum of the products of k up to the number of rows before both, and up
    to that behind both.
    """
    row, side = np.arange(count)[:, None], np.arange(-order, order + 1)
    inside = np.minimum(np.minimum(row, row + side), count - 1 - np.maximum(row, row + side))
    d, k = np.indices((order + 1, order + 1)).reshape(2, -1)
    return ((abs(side)[:, None] == d) & (inside[..., None] >= k) & (d + k <= order)).astype(np.float64)


def laplacian_bands(count: int, order: int) -> Array:
    """Bands (2 K, 4 p + 1, 2 (p + 1)) of the powers ``T^0 ... T^p`` of the Laplacian T of K rows, with mirrored ends.

    There is a matrix of each power for either alias. Unknowns of the aliases alternate.
    """
    row, side = np.arange(count)[:, None], np.arange(-order, order + 1)
    # distances to the place of an entry and to its mirror images, at which powers have binomial coefficients
    distance = np.stack(np.broadcast_arrays(side, 2 * row + side + 1, 2 * (row - count) + side + 1))[..., None]
    power = np.arange(order + 1)
    values = ((1 - 2 * (distance % 2)) * comb(2 * power, power + distance)).sum(0)
    values[(row + side < 0) | (row + side >= count)] = 0.0
    bands = np.zeros((count, SCALE, SCALE * 2 * order + 1, order + 1, SCALE))
    for alias in range(SCALE):
        bands[:, alias, ::SCALE, :, alias] = values
    return bands.reshape(SCALE * count, SCALE * 2 * order + 1, -1)


def normal_matrices(
    kernels: RowKernels, top: int, count: int, width: int, dtype: torch.dtype, num_scenes: int = 1
) -> Tensor:
    """Bands (K + b, 2 b + 1, N, 2 Q) of ``sum_m w_m K_m^H K_m`` of N scenes at the Chebyshev nodes, float64.

    The kernels are those of the frames of one scene after the other; K = ``count`` coefficients from ``top`` on, b is
    the ``width``, and the dtype of the frames determines the number of nodes.
    """
    nodes, _ = interpolation_matrix(2 * kernels.blur_reach, None, dtype)
    nodes = nodes.to(kernels.middle.device)
    values = kernels.at(nodes)
    weighted = (values * kernels.weight[..., None, None]).conj().resolve_conj()
    # entry of A[k, k + d] of a scene, whose rows are followed by b rows that are 0
    diagonals, taps = 2 * width + 1, values.shape[-2]
    scene = torch.arange(num_scenes, device=nodes.device).repeat_interleave(len(kernels.first) // num_scenes)
    row = kernels.first - top + (count + width) * scene[:, None]
    first = (diagonals * row + width)[..., None, None] + torch.arange(taps, device=nodes.device)
    first = first + (diagonals - 1) * torch.arange(taps, device=nodes.device)[:, None]  # (M, R, J, J)
    bands = values.new_zeros(num_scenes * (count + width) * diagonals, len(nodes))
    for part in runs(taps, at_once(16 * values.numel(), nodes.device)):  # few taps at a time: less memory
        products = weighted[..., part, None, :] * values[..., None, :, :]
        bands = bands.index_add_(0, first[..., part, :].flatten(), products.flatten(0, 3))
    return _stacked(bands).view(num_scenes, count + width, diagonals, -1).permute(1, 2, 0, 3)


class Observation:
    """The observation operator K of N scenes, each observed by M frames of R rows of period L, and its normal matrices.

    ``A`` and ``A_adjoint`` have images of whole frames; ``forward`` and ``adjoint`` have spectra of some frequencies.
    The ``kernels`` are those of the rows of N M frames, of a scene one after the other; ``u`` (U,) are the frequencies
    along the rows in cycles per px, on the CPU. ``count`` scene rows K, from ``top`` on in frame coordinates, are
    observed or needed to evaluate a scene.
    """

    def __init__(
        self, kernels: RowKernels, num_rows: int, period: int, dtype: torch.dtype, num_scenes: int = 1
    ) -> None:
        self.kernels, self.num_rows, self.period, self.dtype = kernels, num_rows, period, dtype
        self.num_scenes, self.u = num_scenes, frequencies_of(period)
        # coefficients that the scene on the rows of the frame depends on, and those that frames observe
        points = kernels.points
        lowest, highest = torch.stack(kernels.first.aminmax()).tolist()
        self.top = min(lowest, -points * SCENE_REACH)
        last = max(highest + kernels.taps.shape[-2], points * (points * num_rows + SCENE_REACH))
        self.count = last - self.top
        # real and imaginary parts of every tap of every row (J, N M R, 2 Q) at Q Chebyshev nodes
        nodes, _ = interpolation_matrix(kernels.blur_reach, None, dtype)
        at_nodes = _stacked(kernels.at(nodes.to(kernels.middle.device))).to(dtype)
        self._at_nodes = at_nodes.flatten(0, 1).transpose(0, 1).contiguous()
        scene = torch.arange(num_scenes, device=kernels.first.device)[:, None, None]
        place = kernels.first.unflatten(0, (num_scenes, -1)) - self.top + self.count * scene
        # coefficients of the taps of each row (J, N M R), of all scenes one after the other
        self._places = place.flatten() + torch.arange(kernels.taps.shape[-2], device=place.device)[:, None]
        self._normal: dict[int, SmoothBand] = {}

    def normal(self, order: int) -> SmoothBand:
        """Normal matrices ``K^H W K``, with room for a prior of an order across rows."""
        if order not in self._normal:
            kernels, points = self.kernels, self.kernels.points
            width = max(kernels.taps.shape[-2] - 1, points * order)
            matrices = normal_matrices(kernels, self.top, self.count, width, self.dtype, self.num_scenes)
            bands = (
                autoregressive_bands(self.count, order) if points == 1 else laplacian_bands(self.count // points, order)
            )
            beside = width - points * order
            prior = functional.pad(torch.from_numpy(bands), (0, 0, beside, beside, 0, width))
            matrices, prior = (values.to(matrices.device, self.dtype).contiguous() for values in (matrices, prior))
            self._normal[order] = SmoothBand(matrices, prior, points * order, 2 * kernels.blur_reach)
        return self._normal[order]

    def at_frequencies(self, u: Tensor, period: int) -> "Observation":
        """The same for rows of another period, at frequencies (U,) in cycles per px on the CPU.

        Frequencies that are not all of a period are for kernels whose middles are 0.
        """
        other = copy(self)
        other.period, other.u = period, u
        return other

    def _taps(self, part: slice, *, conjugate: bool = False) -> Iterator[tuple[Tensor, Tensor]]:
        """Places (j, N M R) of a few taps at a time, which need less memory, and their kernels (j, N M R, S).

        The kernels, or their conjugates, are without the phase of the middle.
        """
        at_nodes = self._at_nodes
        right = interpolation_matrix(self.kernels.blur_reach, self.u[part], self.dtype)[1]
        if conjugate:
            right[:, 1::2].neg_()
        right = right.to(at_nodes)
        count = at_once(at_nodes.element_size() * at_nodes.shape[1] * right.shape[1], at_nodes.device)
        for taps in runs(len(at_nodes), count):
            yield self._places[taps], torch.view_as_complex((at_nodes[taps] @ right).unflatten(-1, (-1, 2)))

    def A(self, coefficients: Tensor) -> Tensor:  # noqa: N802 - name that solvers use
        """Noiseless frames ``K c`` (N, M, C, R, L) of scenes with coefficients (K, C, N, U)."""
        values = self._places.shape[1] * coefficients.shape[1]  # of all rows at a frequency
        parts = runs(len(self.u), max(1, most_values(coefficients.device) // values))  # less memory
        spectra = [self.forward(coefficients[..., part], part) for part in parts]
        return torch.fft.irfft(torch.cat(spectra, dim=-1), n=self.period)

    def A_adjoint(self, frames: Tensor) -> Tensor:  # noqa: N802 - name that solvers use
        """``K^H W g`` (K, C, N, U) of frames (N, M, C, R, L)."""
        return self.adjoint(torch.fft.rfft(frames), slice(0, len(self.u)))

    def forward(self, coefficients: Tensor, part: slice) -> Tensor:
        """``K c``, (N, M, C, R, S), of coefficients (K, C, N, S) at the frequencies ``part``."""
        # sum over the taps of each row of all frames
        flat = coefficients.movedim(2, 0).flatten(0, 1)
        rows = flat.new_zeros(self._places.shape[1], *flat.shape[1:])
        for places, kernel in self._taps(part):
            rows = rows + (kernel[:, :, None] * flat[places]).sum(0)
        # displacement of the middle of each row
        phases = shift_phases(self.kernels.middle, self.period, part, flat.dtype).conj()
        observed = (rows.unflatten(0, phases.shape[:2]) * phases[:, :, None]).transpose(1, 2)
        return observed.unflatten(0, (self.num_scenes, -1))

    def adjoint(self, spectra: Tensor, part: slice) -> Tensor:
        """``K^H W g``, (K, C, N, S), of the spectra (N, M, C, R, S) of rows at the frequencies ``part``."""
        # displacement of the middle of each row
        phases = shift_phases(self.kernels.middle, self.period, part, spectra.dtype)
        phases = phases * self.kernels.weight.to(self.dtype)[..., None]
        rows = (spectra.flatten(0, 1) * phases[:, None]).transpose(1, 2).flatten(0, 1)
        # each row contributes to the scene rows of its taps
        total = rows.new_zeros(self.num_scenes * self.count, *rows.shape[1:])
        for places, kernel in self._taps(part, conjugate=True):
            total = total.index_add_(0, places.flatten(), (kernel[:, :, None] * rows).flatten(0, 1))
        return total.unflatten(0, (self.num_scenes, -1)).movedim(0, 2)

    def image(self, coefficients: Tensor) -> Tensor:
        """Rows of the scenes where the frame at rest would observe them, (N, C, R, L), or (N, C, 2 R, 2 L) if finer."""
        points = self.kernels.points
        first, count = -points * SCENE_REACH - self.top, points * (points * self.num_rows + 2 * SCENE_REACH)
        near = coefficients[first : first + count].unflatten(0, (-1, points))
        weights = constant(np.array, (scene_weights(points),), dtype=near.dtype.to_real(), device=near.device)
        sampled = correlated(torch.view_as_real(near).flatten(1), weights, 0)[0]
        spectra = torch.view_as_complex(sampled.unflatten(1, (*near.shape[1:], 2)))
        # spectra at u, and at u - 1 on the finer grid: the scene is real
        whole = spectra[:, 0]
        if points > 1:
            whole = torch.cat([whole, spectra[:, 1, ..., :-1].flip(-1).conj()], dim=-1)
        return torch.fft.irfft(whole.permute(2, 1, 0, 3), n=points * self.period) * points


def frequencies_of(period: int) -> Tensor:
    """Frequencies (U,) of rows of a period in cycles per px, on the CPU."""
    return torch.fft.rfftfreq(period, dtype=torch.float64, device="cpu")
