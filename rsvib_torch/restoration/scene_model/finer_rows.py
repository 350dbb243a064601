"""The observation operator of a scene on a grid of half pixels, in which frames alias.

The scene after optics and pixel contains detail beyond half a cycle per pixel. Along the rows, the spectrum of a
frame at u (0 ... 1/2 cycles per px) is the sum of the spectra of the scene at u and at its alias u - 1, which have
different kernels: ``K_a(u) = sum_n w_n h(. - 2 y_n) exp(-2 pi i (u - a) x_n)`` for a = 0, 1. Across the rows, the
scene is a cubic B-spline h with a knot every half row. Unknowns are numbered 2 j + a for row j of the coefficients, so
that the normal equations are one banded system per u. Relative to the middle x of a row, the alias has the phase
``exp(2 pi i x)``, which does not depend on u: kernels are smooth in u, as on the pixel grid.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from rsvib_torch.core.splines import bspline_weights, spread_taps
from rsvib_torch.restoration.scene_model.observation import (
    Observation,
    RowKernels,
    SmoothBand,
    interpolation_matrix,
    normal_matrices,
)

__all__ = ["SCALE", "FinerObservation", "finer_kernels", "spline_transfer"]

SCALE = 2  # grid points per px, and unknowns per frequency
_DEGREE = 3
_SCENE_REACH = 5  # half rows on either side; support of the weights of a scene row


class FinerKernels(RowKernels):
    """Kernels on the grid of half pixels: ``first`` and ``taps`` count unknowns 2 j + a."""

    symmetric = False

    @property
    def blurred(self) -> bool:
        """Whether the displacement changes by more than 1 px during an exposure."""
        return max(2.0 * self.reach, (self.taps.shape[-2] / SCALE - _DEGREE - 1) / SCALE) > 1.0

    def needed(self, num_rows: int) -> tuple[int, int]:
        """First coefficient, and the one after the last, that the scene on the rows of a frame depends on."""
        return -SCALE * _SCENE_REACH, SCALE * (SCALE * num_rows + _SCENE_REACH)

    def at(self, frequencies: Tensor) -> Tensor:
        """Kernels (M, R, 2 J, Q) without the phase of the middle at the frequency."""
        both = torch.stack([frequencies, frequencies - 1])  # (a, Q)
        angle = (-2 * math.pi) * self.along[..., None, :, None] * both[:, None]
        alias = (2 * math.pi) * self.middle[..., None, None] * both.new_tensor([[0.0], [1.0]])
        waves = torch.polar(torch.ones_like(angle), angle + alias[..., None])  # (M, R, a, N, Q)
        taps = self.taps.unflatten(-2, (-1, SCALE)).transpose(-3, -2)  # (M, R, a, J, N)
        kernels: Tensor = (taps.to(waves.dtype) @ waves).transpose(-3, -2).flatten(-3, -2)
        return kernels


def finer_kernels(
    displacement: Tensor, node_weights: Tensor, weight: Tensor, num_rows: int, margin: int
) -> FinerKernels:
    """Kernels of rows with displacement (M, R, N, 2) px during the exposure, as ``row_kernels`` on the finer grid."""
    rows = torch.arange(displacement.shape[-3], dtype=displacement.dtype, device=displacement.device)
    place = SCALE * (rows[:, None] - displacement[..., 1])
    cell = place.detach().floor()
    first, taps = spread_taps(cell, bspline_weights(place - cell, _DEGREE) * node_weights[:, None])
    taps, count, first = taps.transpose(-2, -1), taps.shape[-1], first - _DEGREE // 2
    low, high = -SCALE * margin - count, SCALE * (num_rows + margin)
    near = (first > low) & (first < high)
    x = displacement[..., 0]
    middle = 0.5 * (x.detach().amin(-1) + x.detach().amax(-1))
    return FinerKernels(
        SCALE * first.clamp(low, high),
        taps.repeat_interleave(SCALE, -2),
        middle,
        x - middle[..., None],
        weight[:, None].to(torch.float64) * near,
    )


def spline_transfer(frequencies: Tensor) -> Tensor:
    """Transfer function of the cubic B-spline on half pixels, at frequencies in cycles per px."""
    return torch.sinc(frequencies / SCALE) ** (_DEGREE + 1)


@cache
def _scene_weights() -> tuple[float, ...]:
    """Weights of the coefficients of half rows -5 ... 5 in a row of the scene, as ``observation.scene_weights``.

    The least-squares fit to ``spline_transfer`` up to 0.9 cycles per px. Samples of the spline, weights 1/6, 4/6 and
    1/6, include its aliases: gratings across the rows have 1.14 times their contrast at 0.75 cycles per px.
    """
    v = torch.linspace(0, 0.9, 181, dtype=torch.float64, device="cpu")
    order = torch.arange(_SCENE_REACH + 1, dtype=torch.float64, device="cpu")
    cosines = torch.cos(2 * torch.pi / SCALE * v[:, None] * order) * torch.where(order > 0, 2.0, 1.0)
    half = torch.linalg.lstsq(cosines, spline_transfer(v)[:, None]).solution[:, 0]
    return tuple((torch.cat([half.flip(0), half[1:]]) / (half[0] + 2 * half[1:].sum())).tolist())


@dataclass(frozen=True, eq=False)
class FinerBand(SmoothBand):
    """Normal matrices at any frequencies; the prior is ``sum_m q_m(u - a) T^m`` with the Laplacian T across rows.

    ``left`` contains the bands of ``T^m`` for both aliases behind the real and imaginary parts at the nodes.
    """

    def at(self, u: Tensor, precision: Tensor, out: Tensor | None = None) -> Tensor:
        """Skewed bands as in ``SmoothBand.at``, for a precision (p + 1, 2, U) as of ``PolynomialPrior.precision``."""
        prior = torch.stack([precision, torch.zeros_like(precision)], dim=-1).flatten(-2).flatten(0, 1)
        interpolation = interpolation_matrix(self.reach, u, self.left.dtype, symmetric=False)[1]
        return torch.view_as_complex(self._product(interpolation, prior, out)).flatten(2)


def _laplacian_powers(count: int, order: int, device: torch.device) -> Tensor:
    """Bands (K, 2 p + 1, p + 1) of ``T^0 ... T^p``, ``[k, p + d] = T^m[k, k + d]``, T with mirrored ends."""
    step = torch.full((count, 3), -1.0, dtype=torch.float64, device=device)  # T[k, k - 1], T[k, k], T[k, k + 1]
    step[0, 0] = step[-1, 2] = 0.0
    step[:, 1] = -step[:, 0] - step[:, 2]
    powers = [torch.zeros(count, 2 * order + 1, dtype=torch.float64, device=device)]
    powers[0][:, order] = 1.0
    for _ in range(order):
        powers.append(
            sum((step[:, 1 + f, None] * powers[-1].roll((-f, f), (0, 1)) for f in (-1, 0, 1)), start=step.new_zeros(()))
        )
    return torch.stack(powers, dim=-1)


class FinerObservation(Observation):
    """``Observation`` of a scene on the grid of half pixels; all values count unknowns 2 j + a."""

    def band(self, order: int) -> SmoothBand:
        """Normal matrices ``K^H W K`` to which a polynomial of an order in the Laplacian can be added."""
        if order not in self._bands:
            width = max(self.kernels.taps.shape[-2] - 1, SCALE * order)
            matrices = normal_matrices(self.kernels, self.top, self.count, width, self.dtype)
            powers = _laplacian_powers(self.count // SCALE, order, matrices.device)
            prior = matrices.new_zeros(*matrices.shape[:2], order + 1, SCALE)
            for alias in range(SCALE):
                place = slice(width - SCALE * order, width + SCALE * order + 1, SCALE)
                prior[alias : self.count : SCALE, place, :, alias] = powers
            left = torch.cat([matrices, prior.flatten(2)], dim=-1).to(self.dtype)
            self._bands[order] = FinerBand(left[:, :, None], 2 * self.kernels.reach, order)
        return self._bands[order]

    def scene(self, coefficients: Tensor, length: int) -> Tensor:
        """The scene at half pixels, (C, 2 R, 2 L): rows j / 2 and columns i / 2 of the frame at rest."""
        first = -SCALE * _SCENE_REACH - self.top
        count = SCALE * self.num_rows
        rows = coefficients[first : first + SCALE * (count + 2 * _SCENE_REACH)].unflatten(0, (-1, SCALE))
        sampled = sum(
            (weight * rows[k : k + count] for k, weight in enumerate(_scene_weights())), start=rows.new_zeros(())
        )
        low, alias = sampled.unbind(1)  # at u and u - 1; the scene is real
        spectra = torch.cat([low, alias[..., :-1].flip(-1).conj()], dim=-1)
        scene: Tensor = torch.fft.irfft(spectra.movedim(1, 0), n=SCALE * length) * SCALE
        return scene
