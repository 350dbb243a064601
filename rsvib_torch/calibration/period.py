"""The period of bands in rows: brightness of the scene times a waveform that repeats."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

__all__ = ["BandFit", "SceneModel", "fit_period"]

SceneModel = Literal["smooth", "fixed"]

_ROUNDS = 60
_SETTLED = 1e-8  # of the period
_RIDGE = 1e-11
_HARMONICS = (1, 2, 3, 5, 8, 12, 16)
_MOST_DEGREE = 8
_DARK = 0.02  # of the mean brightness: no scene is darker
_NEIGHBOURS = 12  # frequencies beside the fundamental that tell its noise
_RED = 1.5  # texture has more power at longer periods: measured on drawn scenes


@dataclass(frozen=True, eq=False)
class BandFit:
    """Bands of period P rows: ``y_p(i) = s_p(i) (1 + sum_k Re[c_pk exp(-2 pi j k i / P)])``.

    Attributes:
        period: P in rows.
        period_std: Its standard deviation in rows, from the residuals with their correlation.
        coefficients: (T, K) complex128, waveform of each frame over its mean.
        scene: (T, H) float64, brightness of the rows without flicker.
        residual: (T, H) float64, what the model misses of the brightness over the scene's.
        certainty: Power of the fundamental over that of residuals at frequencies beside it, all frames together.
        evidence: Gaussian log-likelihood less the price of the parameters.
    """

    period: float
    period_std: float
    coefficients: Tensor
    scene: Tensor
    residual: Tensor
    certainty: float
    evidence: float


def _harmonics(rows: Tensor, period: float, count: int) -> tuple[Tensor, Tensor]:
    """Cosines and sines (H, 2 K) of the first harmonics at the rows, and their derivatives with the period."""
    order = torch.arange(1, count + 1, dtype=torch.float64)
    angle = 2 * math.pi * rows[:, None] * order / period
    basis = torch.cat([angle.cos(), angle.sin()], 1)
    slope = torch.cat([angle.sin() * angle, -angle.cos() * angle], 1) / period
    return basis, slope


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Least squares (T, N) of (T, H, N) and (T, H) by normal equations, with a ridge: columns may be alike."""
    gram = matrix.mT @ matrix
    gram = gram + torch.diag_embed(_RIDGE * gram.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300))
    found: Tensor = torch.linalg.solve(gram, matrix.mT @ right[..., None])[..., 0]
    return found


def _left_over(matrix: Tensor, values: Tensor) -> Tensor:
    return values - (matrix @ _solve(matrix, values)[..., None])[..., 0]


def _polynomials(height: int, period: float) -> Tensor:
    """Chebyshev polynomials over the rows (H, N), at most one a period."""
    degree = max(2, min(_MOST_DEGREE, round(height / period)))
    place = torch.linspace(-1, 1, height, dtype=torch.float64)
    return torch.cos(torch.arange(degree + 1, dtype=torch.float64) * torch.acos(place)[:, None])


def fit_period(brightness: Tensor, start: float, scene: SceneModel) -> BandFit | None:
    """Fit bands to the brightness of rows, with as many harmonics as pay.

    Args:
        brightness: (T, H) float64.
        start: Period to start with, in rows.
        scene: ``"smooth"``: the brightness of the scene is a polynomial along the rows, one for each frame;
            ``"fixed"``: that, times a texture of the rows that is the same in all frames while the bands move.

    Returns:
        The fit; None where it runs away from its start.
    """
    best: BandFit | None = None
    for count in _HARMONICS:
        if count > 1 and count > start / 4:
            break
        found = _fit(brightness, best.period if best else start, scene, count)
        if found is None or abs(found.period / start - 1) > 0.25:
            break
        if best is not None and found.evidence <= best.evidence:
            break
        best = found
    return best


def _fit(brightness: Tensor, period: float, scene: SceneModel, count: int) -> BandFit | None:
    """Gauss-Newton on period, waveforms and smooth scene together, and on the texture in turn."""
    frames, height = brightness.shape
    centre = 0.5 * (height - 1)
    rows = torch.arange(height, dtype=torch.float64) - centre
    smooth = _polynomials(height, period)
    floor = _DARK * brightness.mean(1, keepdim=True)
    texture = torch.ones(height, dtype=torch.float64)
    level = torch.maximum(_solve(smooth.expand(frames, -1, -1), brightness) @ smooth.T, floor)
    waves = torch.zeros(frames, 2 * count, dtype=torch.float64)
    for turn in range(_ROUNDS):
        basis, slope = _harmonics(rows, period, count)
        pattern = 1 + waves @ basis.T
        if scene == "fixed" and turn > 2:
            shape = level * pattern
            texture = ((shape * brightness).sum(0) / shape.square().sum(0).clamp(min=1e-300)).clamp(min=_DARK)
        even = brightness / texture
        fixed = torch.cat([level[..., None] * basis, pattern[..., None] * smooth], -1)
        shift = level * (waves @ slope.T)
        residual = even - level * pattern
        lean = _left_over(fixed, shift)
        power = float((lean * shift).sum())
        step = float((lean * residual).sum()) / power if turn > 2 and power > 0 else 0.0
        change = _solve(fixed, residual - step * shift)
        period += max(-0.05 * period, min(0.05 * period, step))
        waves = waves + change[:, : 2 * count]
        level = torch.maximum(level + change[:, 2 * count :] @ smooth.T, floor)
        if not math.isfinite(period) or not 2.0 <= period <= 2 * height:
            return None
        if turn > 8 and abs(step) < _SETTLED * period:
            break
    basis, slope = _harmonics(rows, period, count)
    pattern = 1 + waves @ basis.T
    residual = (brightness / texture - level * pattern) / level
    lean = waves @ slope.T
    if scene == "fixed":
        lean = lean - pattern * (pattern * lean).sum(0) / pattern.square().sum(0).clamp(min=1e-300)
    lean = _left_over(torch.cat([basis.expand(frames, -1, -1), pattern[..., None] * smooth], -1), lean)
    back = torch.polar(
        torch.ones(count, dtype=torch.float64),
        2 * math.pi * centre / period * torch.arange(1, count + 1, dtype=torch.float64),
    )
    coefficients = torch.complex(waves[:, :count], waves[:, count:]) * back
    certainty = _certainty(coefficients, residual, period)
    alike = _correlation_rows(residual)
    values = brightness.numel() / alike
    evidence = -0.5 * values * math.log(float(residual.square().mean()) + 1e-300)
    return BandFit(
        period=period,
        period_std=max(
            _period_std(lean, residual, period), _period_std_beside(lean, waves @ slope.T, certainty, period)
        ),
        coefficients=coefficients,
        scene=level * texture,
        residual=residual,
        certainty=certainty,
        evidence=evidence - 0.5 * 2 * count * frames * math.log(values),
    )


def _correlation_rows(residual: Tensor) -> float:
    """Rows over which residuals are alike: ``1 + 2 sum rho(k)`` up to where the correlation is gone."""
    length = residual.shape[1]
    power = torch.fft.rfft(residual, n=2 * length).abs().square().sum(0)
    covariance = torch.fft.irfft(power)[:length]
    ratio = covariance / covariance[0].clamp(min=1e-300)
    gone = (ratio < 0.05).nonzero()
    last = int(gone[0]) if len(gone) else length
    return float((1 + 2 * ratio[1:last].sum()).clamp(min=1.0))


def _period_std(lean: Tensor, residual: Tensor, period: float) -> float:
    """Standard deviation of the period, with the correlation of residuals within one period (Bartlett's window)."""
    score = lean * residual
    length = score.shape[1]
    reach = min(max(8, math.ceil(period)), length - 1)
    power = torch.fft.rfft(score, n=2 * length).abs().square().sum(0)
    covariance = torch.fft.irfft(power)[: reach + 1]
    window = 1 - torch.arange(reach + 1, dtype=torch.float64) / (reach + 1)
    whole = covariance[0] + 2 * (window * covariance)[1:].sum()
    white = residual.square().mean() * lean.square().sum()
    variance = torch.maximum(whole, torch.maximum(white, covariance[0]))
    return float(variance.sqrt() / lean.square().sum().clamp(min=1e-300))


def _period_std_beside(lean: Tensor, shift: Tensor, certainty: float, period: float) -> float:
    """Standard deviation of the period from residuals beside the fundamental: texture is alike over many periods.

    A wave of amplitude A over H rows, whose coefficient has noise of power N, has its angular frequency known to
    ``sqrt(6 N) / (A H)``; less where the scene can explain a part of its shift.
    """
    height = lean.shape[1]
    centred = shift - shift.mean(1, keepdim=True)
    lost = float(centred.square().sum() / lean.square().sum().clamp(min=1e-300))
    return _RED * period**2 / (2 * math.pi * height) * math.sqrt(6 / max(certainty, 1e-300) * max(lost, 1.0))


def _certainty(coefficients: Tensor, residual: Tensor, period: float) -> float:
    """Power of the fundamental over the mean power of residuals at frequencies beside it."""
    height = residual.shape[1]
    rows = torch.arange(height, dtype=torch.float64)
    steps = torch.arange(-_NEIGHBOURS, _NEIGHBOURS + 1, dtype=torch.float64)
    frequencies = 1 / period + steps[steps.abs() >= 2] / (2 * height)
    frequencies = frequencies[(frequencies > 0.25 / height) & (frequencies < 0.5)]
    wave = torch.polar(torch.ones(1, dtype=torch.float64), 2 * math.pi * rows[:, None] * frequencies)
    beside = 2 / height * (residual.to(wave.dtype) @ wave)
    noise = beside.abs().square().mean(1)
    return float((coefficients[:, 0].abs().square() / noise.clamp(min=1e-300)).sum())
