"""The grid of half pixels: observation operator of frames that alias, and the prior of its scenes.

On the finer grid, the scene after optics and pixel contains detail beyond half a cycle per pixel. Along the rows, the
spectrum of a frame at u (0 ... 1/2 cycles per px) is the sum of the spectra of the scene at u and at its alias u - 1,
which have different kernels: ``K_a(u) = sum_n w_n h(. - 2 y_n) exp(-2 pi i (u - a) x_n)`` for a = 0, 1. Across the
rows, the scene is a cubic B-spline h with a knot every half row. Unknowns are numbered 2 j + a for row j of the
coefficients, so that the normal equations are one banded system per u. Relative to the middle x of a row, the alias has
the phase ``exp(2 pi i x)``, which does not depend on u: kernels are smooth in u, as on the pixel grid.

``PolynomialPrior`` has a precision that is a polynomial in the Laplacians of both axes.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass
from functools import cache, partial
from math import pi

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.numerics.splines import bspline_weights
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.scene_model.observation import (
    Observation,
    RowKernels,
    SmoothBand,
    cosine_series,
    interpolation_matrix,
    normal_matrices,
)
from rsvib_torch.restoration.scene_model.scene_prior import observed_spectrum, smeared

SCALE = 2  # points per px of the finer grid, and unknowns per frequency
_FINER_DEGREE = 3
_FINER_SCENE_REACH = 5  # half rows on either side; support of the weights of a scene row on the finer grid


class FinerKernels(RowKernels):
    """Kernels on the grid of half pixels: ``first`` and ``taps`` count unknowns 2 j + a."""

    symmetric = False
    points = SCALE
    interpolated = partial(bspline_weights, degree=_FINER_DEGREE)
    before = _FINER_DEGREE // 2

    @property
    def blurred(self) -> bool:
        """Whether the displacement changes by more than 1 px during an exposure."""
        return max(2.0 * self.blur_reach, (self.taps.shape[-2] / SCALE - _FINER_DEGREE - 1) / SCALE) > 1.0

    def needed(self, num_rows: int) -> tuple[int, int]:
        """First coefficient, and the one after the last, that the scene on the rows of a frame depends on."""
        return -SCALE * _FINER_SCENE_REACH, SCALE * (SCALE * num_rows + _FINER_SCENE_REACH)

    def at(self, frequencies: Tensor) -> Tensor:
        """Kernels (M, R, 2 J, Q) without the phase of the middle at the frequency."""
        both = torch.stack([frequencies, frequencies - 1])  # (a, Q)
        angle = (-2 * math.pi) * self.along[..., None, :, None] * both[:, None]
        alias = (2 * math.pi) * self.middle[..., None, None] * both.new_tensor([[0.0], [1.0]])
        waves = torch.polar(torch.ones_like(angle), angle + alias[..., None])  # (M, R, a, N, Q)
        taps = self.taps.unflatten(-2, (-1, SCALE)).transpose(-3, -2)  # (M, R, a, J, N)
        return (taps.to(waves.dtype) @ waves).transpose(-3, -2).flatten(-3, -2)


def _spline_transfer(frequencies: Tensor) -> Tensor:
    """Transfer function of the cubic B-spline on half pixels, at frequencies in cycles per px."""
    return torch.sinc(frequencies / SCALE) ** (_FINER_DEGREE + 1)


@cache
def _finer_scene_weights() -> tuple[float, ...]:
    """Weights of the coefficients of half rows -5 ... 5 in a row of the scene, as ``scene_weights``.

    The least-squares fit to ``_spline_transfer`` up to 0.9 cycles per px. Samples of the spline, weights 1/6, 4/6 and
    1/6, include its aliases: gratings across the rows have 1.14 times their contrast at 0.75 cycles per px.
    """
    v = np.linspace(0, 0.9, 181)
    half = cosine_series(2 * pi / SCALE * v, _spline_transfer(torch.from_numpy(v)).numpy(), _FINER_SCENE_REACH)
    return tuple((np.concatenate([half[:0:-1], half]) / (half[0] + 2 * half[1:].sum())).tolist())


@dataclass(frozen=True, eq=False)
class FinerBand(SmoothBand):
    """Normal matrices at any frequencies; the prior is ``sum_m q_m(u - a) T^m`` with the Laplacian T across rows.

    ``left`` contains the bands of ``T^m`` for both aliases behind the real and imaginary parts at the nodes.
    """

    def at(self, u: Tensor, precision: Tensor) -> Tensor:
        """Skewed bands as in ``SmoothBand.at``, for a precision (p + 1, 2, U) as of ``PolynomialPrior.precision``."""
        prior = torch.stack([precision, torch.zeros_like(precision)], dim=-1).flatten(-2).flatten(0, 1)
        interpolation = interpolation_matrix(self.reach, u, self.left.dtype, symmetric=False)[1]
        right = torch.cat([interpolation.to(prior), prior])
        return torch.view_as_complex(self._product(right)).flatten(2)


def _laplacian_powers(count: int, order: int, device: torch.device) -> Tensor:
    """Bands (K, 2 p + 1, p + 1) of ``T^0 ... T^p``, ``[k, p + d] = T^m[k, k + d]``, T with mirrored ends."""
    step = torch.full((count, 3), -1.0, dtype=torch.float64, device=device)  # T[k, k - 1], T[k, k], T[k, k + 1]
    step[0, 0] = step[-1, 2] = 0.0
    step[:, 1] = -step[:, 0] - step[:, 2]
    powers = [torch.zeros(count, 2 * order + 1, dtype=torch.float64, device=device)]
    powers[0][:, order] = 1.0
    for _ in range(order):
        above, here, below = (step[:, 1 + f, None] * powers[-1].roll((-f, f), (0, 1)) for f in (-1, 0, 1))
        powers.append(above + here + below)
    return torch.stack(powers, dim=-1)


class FinerObservation(Observation):
    """``Observation`` of one scene on the grid of half pixels; all values count unknowns 2 j + a."""

    kernels_of_rows = FinerKernels.of_rows

    def normal(self, order: int) -> SmoothBand:
        """Normal matrices ``K^H W K``, with room for a polynomial of an order in the Laplacian across rows."""
        if order not in self._normal:
            width = max(self.kernels.taps.shape[-2] - 1, SCALE * order)
            matrices = normal_matrices(self.kernels, self.top, self.count, width, self.dtype)[:, :, 0]
            powers = _laplacian_powers(self.count // SCALE, order, matrices.device)
            prior = matrices.new_zeros(*matrices.shape[:2], order + 1, SCALE)
            for alias in range(SCALE):
                place = slice(width - SCALE * order, width + SCALE * order + 1, SCALE)
                prior[alias : self.count : SCALE, place, :, alias] = powers
            left = torch.cat([matrices, prior.flatten(2)], dim=-1).to(self.dtype)
            self._normal[order] = FinerBand(left[:, :, None], 2 * self.kernels.blur_reach)
        return self._normal[order]

    def image(self, coefficients: Tensor) -> Tensor:
        """The scene at half pixels, (1, C, 2 R, 2 L): rows j / 2 and columns i / 2 of the frame at rest."""
        first = -SCALE * _FINER_SCENE_REACH - self.top
        count = SCALE * self.num_rows
        rows = coefficients[first : first + SCALE * (count + 2 * _FINER_SCENE_REACH)].unflatten(0, (-1, SCALE))
        weighted = [weight * rows[k : k + count] for k, weight in enumerate(_finer_scene_weights())]
        low, alias = sum(weighted[1:], start=weighted[0]).unbind(1)  # at u and u - 1; the scene is real
        spectra = torch.cat([low, alias[..., :-1].flip(-1).conj()], dim=-1)
        return torch.fft.irfft(spectra.permute(2, 1, 0, 3), n=SCALE * self.period) * SCALE


# Degree 6 instead of 4: 0.6 to 1.0 dB for eight frames of scenes with little detail beyond half a cycle per px, -0.4 dB
# for one with much; 8 gains less than 0.2 dB more (drawn scenes of three sharpnesses, noise 0.002).
_DEGREE = 6
_POWERS = [(m, n) for m in range(_DEGREE + 1) for n in range(_DEGREE + 1 - m)]  # of the Laplacians across and along
_MAX_LAPLACIAN = 4.0  # of one axis, at half a cycle per grid point
# Square pixels transmit sin(pi u) / (pi u), 0 at one cycle per px. Along the rows the prior has this factor, at least
# the square root of the first number. Across them, the polynomial has the factor ``1 + 10 (lambda / 4)^4``, which rises
# like the inverse. Frames do not contain it, as the alias of half a cycle per px is below it: without, the spectrum
# near one cycle per px is estimated 100 times too large (sharp optics, noise 0.002, 8 frames: 0.5 to 5 dB).
_LEAST_PIXEL, _RISE, _RISE_POWER = 0.005, 10.0, 4


def _laplacian(frequencies: Tensor) -> Tensor:
    """Discrete Laplacian on the grid, at frequencies in cycles per px."""
    return 2 - 2 * torch.cos(2 * pi / SCALE * frequencies)


def _pixel(u: Tensor) -> Tensor:
    """Squared transfer function of a pixel along the row."""
    return torch.sinc(u).square().clamp(min=_LEAST_PIXEL)


def _rising_powers(device: torch.device) -> Tensor:
    """Coefficients (p + 1, p + 1) of ``lambda^m (1 + 10 (lambda / 4)^4)``; terms of a degree above p have degree p."""
    powers = torch.eye(_DEGREE + 1, dtype=torch.float64, device=device)
    for m in range(_DEGREE + 1):
        high = min(m + _RISE_POWER, _DEGREE)
        powers[m, high] += _RISE * _MAX_LAPLACIAN ** (m - high)
    return powers


@dataclass(frozen=True, eq=False)
class PolynomialPrior:
    """Power spectrum ``sinc(u)^2 b(v)^2 / sum_mn a_mn lambda(v)^m lambda(u)^n`` of the scene, a_mn >= 0.

    lambda is the discrete Laplacian on the grid, sinc the transfer function of a pixel and b that of the cubic
    B-spline: without b it is the spectrum of the coefficients of the scene.
    """

    coefficients: Tensor  # (p + 1, p + 1) a_mn, in px^-2 over squared units of the frames, float64
    period: int  # L, period of the rows in px

    def precision(self, noise_power: Tensor, strength: float = 1.0, blur_reach: float = 0.0) -> Tensor:
        """Factors q_m of ``sum_m q_m(u - a) T^m`` in units of the data's noise, (p + 1, 2, U), float64.

        Arguments as in ``RowPrior.precision``.
        """
        u = torch.fft.rfftfreq(self.period, dtype=torch.float64, device=noise_power.device)
        u = torch.stack([u, u - 1])
        # bounds as for ``RowPrior.precision``: below, the elimination in single precision loses digits. The upper one
        # must not bound the precision at half a cycle per px, where one coefficient of degree 6 has 1/4096 of its
        # largest value: 1e3 lost 1.1 dB in soft scenes; 1e6 and single precision differ from double by -79 dB at most
        m, n = torch.meshgrid(*(torch.arange(_DEGREE + 1, device=u.device),) * 2, indexing="ij")
        a = self.coefficients * (noise_power.to(torch.float64) * strength / SCALE)
        a = a.minimum(1e6 / _MAX_LAPLACIAN ** (m + n).double())
        a[0, 0] += 1e-5 / (1 + blur_reach)
        powers = _laplacian(u) ** torch.arange(_DEGREE + 1, device=u.device)[:, None, None]
        return torch.einsum("mn,nau->mau", a, powers) / _pixel(u)


@torch.no_grad()
def fit_polynomial_prior(frames: Tensor, motion: FrameMotion, levels: Tensor, length: int) -> PolynomialPrior:
    """Fit the prior to the frames (1, T, C, H, W) of one stack in row order, whose spectrum is blurred and aliased.

    The expected power of a frame at (u, v) is that of the noise (1, T) plus that of the scene, through the blur of the
    exposure, at (u - a, v - b) for all aliases within 1 cycle per px. Observed powers are distributed like chi-squared
    around it (Whittle likelihood): scoring for the logarithms of a_mn. ``length`` is that of the transform along rows.
    """
    spectrum = observed_spectrum(frames, motion, levels, length)
    u, v = spectrum.u[:, None], spectrum.v
    transfer = smeared(spectrum.blur(spectrum.u, spectrum.v))
    observed, weight, noise = (values[0] for values in spectrum.weighted(transfer))
    # transfer function and powers of the Laplacians at each alias
    gains, features = [], []
    rising, order = _rising_powers(frames.device), torch.arange(_DEGREE + 1, device=frames.device)
    for alias_u in (0, 1):
        for alias_v in (-1, 0, 1):
            beyond = (v - alias_v).abs() > 1
            along, across = u - alias_u, (v - alias_v).clamp(-1, 1)
            blur = smeared(spectrum.blur(spectrum.u - alias_u, spectrum.v - alias_v))[0]
            blur = (weight * blur).sum((0, 1)).masked_fill(beyond, 0.0)
            gains.append(blur * _pixel(along) * _spline_transfer(across).square())
            rows = _laplacian(across)[:, None] ** order @ rising.T
            features.append(torch.stack([rows[:, m] * _laplacian(along) ** n for m, n in _POWERS], dim=-1))
    gain, feature = torch.stack(gains), torch.stack(features)  # (aliases, U, V), (aliases, U, V, powers)
    # frequencies within the taper of zero contain the mean
    used = (u > 1.5 * (u[1] - u[0])) | (v.abs() > 1.5 / len(v))
    # start from a white spectrum of the mean level
    middle = (observed - noise).clamp(min=0.01 * noise)[used].log().mean().exp()
    logs = torch.full((len(_POWERS),), -float(middle.log()), dtype=torch.float64, device=frames.device)
    for _ in range(60):
        # expected power of the frames, and its derivative with respect to the logarithms
        terms = feature * logs.exp()
        polynomial = terms.sum(-1)
        scene = gain / polynomial
        expected = scene.sum(0) + noise
        slope = ((scene / polynomial)[..., None] * terms).sum(0) / -expected[..., None]
        jacobian, residual = slope[used], (observed / expected - 1)[used]
        normal = jacobian.T @ jacobian
        # damped: powers that do not matter for the spectrum have a singular matrix
        normal.diagonal().add_(1e-3 * normal.diagonal().mean())
        step = torch.linalg.solve(normal, jacobian.T @ residual).clamp(-1, 1)
        logs = logs + step
        if bool(step.abs().max() < 1e-2):
            break
    coefficients = torch.zeros(_DEGREE + 1, _DEGREE + 1, dtype=torch.float64, device=frames.device)
    for (m, n), log in zip(_POWERS, logs, strict=True):
        coefficients[m, n] = log.exp()
    return PolynomialPrior(rising.T @ coefficients, length)


# Operators, for the points of the scene per px
GRIDS: dict[int, type[Observation]] = {1: Observation, SCALE: FinerObservation}
