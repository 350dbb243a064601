"""Gaussian prior of a scene on a grid of half pixels, whose precision is a polynomial in the Laplacians of the axes.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.scene_model.observation import SCALE, spline_transfer
from rsvib_torch.restoration.scene_model.row_prior import observed_spectrum, smeared

__all__ = ["PolynomialPrior", "fit_polynomial_prior"]

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

    Attributes:
        coefficients: (p + 1, p + 1) a_mn, in px^-2 over squared units of the frames, float64.
    """

    coefficients: Tensor

    def precision(self, noise: Tensor, strength: float, length: int, reach: float = 0.0) -> Tensor:
        """Factors q_m of ``sum_m q_m(u - a) T^m`` in units of the data's noise, (p + 1, 2, U), float64.

        Args:
            noise: Variance of the noise of data of weight 1.
            strength: Factor on the precision.
            length: L, period of the rows in px.
            reach: Largest displacement along the row in px during an exposure, from its middle.
        """
        u = torch.fft.rfftfreq(length, dtype=torch.float64, device=noise.device)
        u = torch.stack([u, u - 1])
        # bounds as for ``RowPrior.precision``: below, the elimination in single precision loses digits. The upper one
        # must not bound the precision at half a cycle per px, where one coefficient of degree 6 has 1/4096 of its
        # largest value: 1e3 lost 1.1 dB in soft scenes; 1e6 and single precision differ from double by -79 dB at most
        m, n = torch.meshgrid(*(torch.arange(_DEGREE + 1, device=noise.device),) * 2, indexing="ij")
        a = self.coefficients * (noise.to(torch.float64) * strength / SCALE)
        a = a.minimum(1e6 / _MAX_LAPLACIAN ** (m + n))
        a[0, 0] += 1e-5 / (1 + reach)
        powers = _laplacian(u) ** torch.arange(_DEGREE + 1, device=noise.device)[:, None, None]
        return torch.einsum("mn,nau->mau", a, powers) / _pixel(u)


@torch.no_grad()
def fit_polynomial_prior(
    frames: Tensor, motion: FrameMotion, stack: int, levels: Tensor, length: int, iterations: int = 60
) -> PolynomialPrior:
    """Fit the prior to the frames of a stack, whose spectrum is blurred and aliased.

    The expected power of a frame at (u, v) is that of the noise plus that of the scene, through the blur of the
    exposure, at (u - a, v - b) for all aliases within 1 cycle per px. Observed powers are distributed like chi-squared
    around it (Whittle likelihood): scoring for the logarithms of a_mn.

    Args:
        frames: (T, C, H, W) in row order.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.
        levels: (T,) standard deviation of the noise of each frame.
        length: Length of the Fourier transform along rows.
        iterations: Largest number of steps.
    """
    spectrum = observed_spectrum(frames, motion, stack, levels, length)
    u, v = spectrum.u[:, None], spectrum.v
    observed, weight, noise = spectrum.weighted(smeared(spectrum.blur()))
    gains, features = [], []
    rising, order = _rising_powers(frames.device), torch.arange(_DEGREE + 1, device=frames.device)
    for alias_u in (0, 1):
        for alias_v in (-1, 0, 1):
            beyond = (v - alias_v).abs() > 1
            along, across = u - alias_u, (v - alias_v).clamp(-1, 1)
            blur = (weight * smeared(spectrum.blur(alias_u, alias_v))).sum((0, 1)).masked_fill(beyond, 0.0)
            gains.append(blur * _pixel(along) * spline_transfer(across).square())
            rows = _laplacian(across)[:, None] ** order @ rising.T
            features.append(torch.stack([rows[:, m] * _laplacian(along) ** n for m, n in _POWERS], dim=-1))
    gain, feature = torch.stack(gains), torch.stack(features)  # (aliases, U, V), (aliases, U, V, powers)
    # frequencies within the taper of zero contain the mean
    used = (u > 1.5 * (u[1] - u[0])) | (v.abs() > 1.5 / len(v))
    middle = (observed - noise).clamp(min=0.01 * noise)[used].log().mean().exp()
    logs = torch.full((len(_POWERS),), -float(middle.log()), dtype=torch.float64, device=frames.device)
    for _ in range(iterations):
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
    return PolynomialPrior(rising.T @ coefficients)
