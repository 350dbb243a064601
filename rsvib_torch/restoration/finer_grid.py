"""The grid of half pixels: the prior of its scenes, their solution, and what their frames reveal about the motion.

``PolynomialPrior`` has a precision that is a polynomial in the Laplacians of both axes. If the frames of a scene differ
from their model, more noise is assumed.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.numerics.interpolation import squared_modulus
from rsvib_torch.restoration.frame_motion import FrameMotion, warn_of_restoration
from rsvib_torch.restoration.observation import SCALE, kernel_spectrum
from rsvib_torch.restoration.scene_prior import observed_spectrum
from rsvib_torch.restoration.scene_solver import SceneProblem

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
    return 2 - 2 * torch.cos(2 * math.pi / SCALE * frequencies)


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
        """Factors q_m of ``sum_m q_m(u - a) T^m`` in units of the data's noise, (p + 1, 2, 1, U), float64.

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
        return (torch.einsum("mn,nau->mau", a, powers) / _pixel(u))[:, :, None]


@torch.no_grad()
def fit_polynomial_prior(frames: Tensor, motion: FrameMotion, levels: Tensor, length: int) -> PolynomialPrior:
    """Fit the prior to the frames (1, T, C, H, W) of one stack in row order, whose spectrum is blurred and aliased.

    The expected power of a frame at (u, v) is that of the noise (1, T) plus that of the scene, through the blur of the
    exposure, at (u - a, v - b) for all aliases within 1 cycle per px. Observed powers are distributed like chi-squared
    around it (Whittle likelihood): scoring for the logarithms of a_mn. ``length`` is that of the transform along rows.
    """
    spectrum = observed_spectrum(frames, motion, levels, length)
    u, v = spectrum.u[:, None], spectrum.v
    transfer = spectrum.blur(spectrum.u, spectrum.v)
    observed, weight, noise = (values[0] for values in spectrum.weighted(transfer))
    # transfer function and powers of the Laplacians at each alias
    gains, features = [], []
    rising, order = _rising_powers(frames.device), torch.arange(_DEGREE + 1, device=frames.device)
    for alias_u in (0, 1):
        for alias_v in (-1, 0, 1):
            beyond = (v - alias_v).abs() > 1
            along, across = u - alias_u, (v - alias_v).clamp(-1, 1)
            blur = spectrum.blur(spectrum.u - alias_u, spectrum.v - alias_v)[0]
            blur = (weight * blur).sum((0, 1)).masked_fill(beyond, 0.0)
            gains.append(blur * _pixel(along) * kernel_spectrum(across, SCALE).square())
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


_BLOCK = 16  # rows of a frame whose displacement error is measured together
_SOLUTIONS = 10  # at most; one in general
# Residual power at a horizontal frequency, in units of the noise power, above which the prior excludes a pattern there:
# with the true motion at most 1 (one photograph: 1.9), with gratings beyond half a cycle per px 50 to 1e5.
_MAX_EXCESS = 1.5
_MOST_FREQUENCIES = 0.4  # share of the frequencies of a pattern: 0.04 to 0.3; 0.3 to 1 with a wrong motion
# Effect of the displacement error and residual, in units of the noise, above which a warning is raised. With the true
# motion at most 0.02 and 0.97; with an error of the phases of 0.05 rad (amplitudes 3 and 5 px) at least 0.16 and 0.85
# (drawn and photographed scenes, noise 0.002 to 0.02, 2 and 8 frames).
_MAX_EFFECT, _MAX_RESIDUAL = 0.1, 1.5


@dataclass(frozen=True)
class FrameDifference:
    """Differences of frames from the prediction of their scene."""

    residual: float  # standard deviation in units of the noise
    error: float  # displacement error in px, rms over the blocks of rows of all frames and both axes
    effect: float  # standard deviation of the difference that the displacement error causes, in units of the noise
    expected: float  # the same of displacements that the problem neglects
    noticed: bool = False  # whether the motion is inaccurate, or the scene changes

    @property
    def power(self) -> float:
        """Power of noise and differences, in units of the noise power."""
        return max(1 + self.effect**2, self.residual**2)


def _inner(size: int) -> slice:
    """Rows or columns without those at the ends."""
    rim = min(16, size // 4)
    return slice(rim, size - rim)


@torch.no_grad()
def _difference(problem: SceneProblem, predicted: Tensor, width: int, neglected: float) -> FrameDifference:
    """Differences of the data of one scene from a prediction (M, C, R, L), without the ends of rows and columns.

    The displacement error of a block of rows is the least-squares factor of the gradient of the prediction in the
    residual. The variance that noise of the residual causes in it is subtracted.
    """
    # 1. The residual and the gradients of the prediction, by the noise of each row, in blocks of rows.
    data, level = problem.data[0], problem.level[0]
    weight, rows = problem.observation.kernels.weight, data.shape[-2]
    inner = _inner(rows), _inner(width)
    residual = data - predicted
    gradients = [0.5 * (predicted.roll(-1, axis) - predicted.roll(1, axis)) for axis in (-1, -2)]
    scale = (weight / weight[:, inner[0]].mean()).sqrt()[:, None, :, None]
    values = torch.stack([residual, *gradients]).to(torch.float64).mul_(scale)[..., *inner]
    size = min(_BLOCK, values.shape[-2])
    count = values.shape[-2] // size
    values = values[..., : count * size, :].unflatten(-2, (count, size)).movedim(2, 3).flatten(3)  # (3, M, n, values)
    difference, slopes = values[0], values[1:].movedim(0, -1)
    # 2. The displacement error of each block, and what noise causes in its square.
    power = difference.square().mean(-1)
    normal = slopes.transpose(-2, -1) @ slopes
    normal.diagonal(dim1=-2, dim2=-1).add_(1e-6 * level.to(torch.float64).square() * difference.shape[-1])
    error = torch.linalg.solve(normal, slopes.transpose(-2, -1) @ difference[..., None])[..., 0]
    chance = power[..., None] * torch.linalg.inv(normal).diagonal(dim1=-2, dim2=-1)
    squares = (error.square() - chance).mean((0, 1)).clamp(min=0.0)
    # 3. Its effect on the frames, and that of the displacements that the problem neglects.
    steepness = slopes.square().mean((0, 1, 2))
    effect, expected = (squares * steepness).sum().sqrt(), neglected * steepness.amax().sqrt()
    figures = torch.stack([power.mean().sqrt() / level, squares.sum().sqrt(), effect / level, expected / level])
    return FrameDifference(*figures.tolist())


@torch.no_grad()
def _excess(problem: SceneProblem, predicted: Tensor, width: int) -> Tensor:
    """Power (U,) of the tapered residual at each horizontal frequency, in units of the noise power."""
    weight, rows = problem.observation.kernels.weight, predicted.shape[-2]
    inner = _inner(rows)
    taper = torch.hann_window(width + 2, periodic=False, dtype=predicted.dtype, device=predicted.device)[1:-1]
    residual = (problem.data[0] - predicted)[..., inner, :width] * (taper / taper.square().sum().sqrt())
    power = squared_modulus(torch.fft.rfft(residual, n=predicted.shape[-1])).mean(1)
    mean = (power * weight[:, inner, None]).mean((0, 1)) / weight[:, inner].mean()
    return (mean / problem.level[0].square()).to(problem.precision.dtype)


def finer_scene(problem: SceneProblem, width: int, neglected: float) -> tuple[Tensor, FrameDifference]:
    """Scene (1, C, 2 R, 2 L) on the finer grid, and the differences of its frames of ``width`` px.

    A fine pattern in a scene with otherwise little detail is far above the spectrum of the prior, and remains in the
    residual at its horizontal frequencies. The prior is weakened there by the power of the residual: gratings at 0.75
    cycles per px keep all of their contrast instead of a tenth.

    If this does not explain the residual, the frames differ from their model, in general by a wrong motion. The
    differences then count as noise: with an error of the phases of 0.05 rad, 27.5 dB become 32.6 dB (chart, noise
    0.002, 2 frames; 32.8 dB on pixels), 34.4 become 38.1 dB with 8 frames (34.7 dB on pixels). Displacements that the
    problem neglects, of standard deviation ``neglected`` px, count as noise as well, but do not contradict the motion.
    """
    factor, relaxed, largest = 1.0, torch.ones_like(problem.precision[0, 0, 0]), math.inf
    allowed, noticed = _MAX_EFFECT, False
    for _ in range(_SOLUTIONS):
        # 1. The scene, and the differences of its frames from their prediction.
        solver = replace(problem, precision=factor / relaxed * problem.precision).solver()
        coefficients = solver.fit(problem.data)
        predicted = problem.observation.A(coefficients.detach())[0]
        difference, excess = _difference(problem, predicted, width, neglected), _excess(problem, predicted, width)
        # 2. A pattern at a few frequencies: weaken the prior there, while the residual decreases.
        before, largest = largest, float(excess.amax())
        # a pattern leaves a tenth of its effect, a wrong motion at least a fifth
        allowed = max(_MAX_EFFECT, 0.15 * difference.effect) if before == math.inf else allowed
        narrow = float((excess > _MAX_EXCESS).double().mean()) < _MOST_FREQUENCIES
        if narrow and factor == 1 and _MAX_EXCESS < largest < 0.7 * before:
            relaxed = relaxed * excess.clamp(min=1.0)
            continue
        # 3. Other differences count as noise, and the prior is weakened nowhere.
        limits = ((difference.effect, allowed), (difference.residual, _MAX_RESIDUAL))
        differs = any(value > limit for value, limit in limits)
        noticed = any(value > math.hypot(limit, difference.expected) for value, limit in limits)
        if not differs or difference.power < 1.2 * factor:
            break
        factor, relaxed = difference.power, torch.ones_like(relaxed)
    return solver.image(coefficients), replace(difference, noticed=noticed)


def phase_spread(places: Tensor, frequency: float) -> Tensor:
    """``1 - |mean exp(2 pi i f x)|^2`` over displacements x (M, ...): 0 if frames sample a wave at the same phase."""
    mean = torch.polar(torch.ones_like(places), 2 * math.pi * frequency * places).mean(0).abs()
    return 1 - mean.square()


def warn_of_frames(differences: list[FrameDifference], places: Iterable[Tensor]) -> None:
    """Warn if frames on a finer grid do not fit their model, or do not sample between each other's pixels.

    ``places`` are the mean displacements (M, R, 2) of the rows of the frames of each scene.
    """
    noticed = [difference for difference in differences if difference.noticed]
    if noticed:
        worst = max(noticed, key=lambda difference: difference.power)
        warn_of_restoration(
            f"the frames differ from their model by {worst.residual:.1f} times the noise, rows are displaced by about "
            f"{worst.error:.2g} px more than the vibration states: it is not accurate enough for scale=2, or the scene "
            "changes between the frames; detail between the pixels is restored only in part and may be false"
        )
    # the factor on the information on aliased detail: 0.5 on average for two frames
    spread = [phase_spread(place, 1.0).mean(0) for place in places]
    if bool((torch.stack(spread).median(0).values < 0.1).any()):
        warn_of_restoration(
            "the frames of a scene sample the same points of it along at least one axis: scale=2 cannot separate "
            "detail beyond half a cycle per px from its alias there; restore more vibrating frames jointly"
        )
