"""Bands of flickering light in the brightness of rows: row profiles, candidates for their period, and its fit.

The brightness of row i in frame p is ``s_p(i) (1 + sum_k Re[c_pk exp(-2 pi j k i / P)])``: a scene s times a waveform
of period P. Gauss-Newton fits period, waveforms and a smooth scene, and the texture of a fixed scene in turn.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.core.arrays import Channels, channel_axis
from rsvib_torch.core.checks import check_choice, check_number
from rsvib_torch.frames.prepare import as_float_frames
from rsvib_torch.io.stack_reading import FramesOrFiles, load_frames

SceneModel = Literal["smooth", "fixed"]


@dataclass(frozen=True, eq=False)
class Profiles:
    """Brightness of rows."""

    rows: Tensor  # (T, H) float64, mean over the columns of each row, first row of the image first
    parts: Tensor  # (T, P, H) float64, the same for parts of the columns side by side
    clipped: float  # fraction of all pixels that are saturated


def row_profiles(
    frames: FramesOrFiles, scan_axis: int | str, full_scale: float | None, gamma: float, channels: Channels = None
) -> Profiles:
    """Mean brightness of the rows of a stack (T, H, W) or (T, C, H, W)."""
    check_choice("scan_axis", scan_axis, (-2, "y", -1, "x"))
    check_number("gamma", gamma, above=0.0, at_most=4.0)
    loaded = load_frames(frames, full_scale)
    images = as_float_frames(loaded.frames, loaded.full_scale, channels=channels).detach()
    if images.ndim == 5:
        raise ValueError(f"calibration takes one stack, got a batch of shape {tuple(images.shape)}")
    images = images.mean(channel_axis("frames", images.shape, channels)) if images.ndim == 4 else images
    images = images.transpose(-2, -1) if scan_axis in (-1, "x") else images
    if images.shape[-2] < 32:
        raise ValueError(f"frames have {images.shape[-2]} rows along the scan; at least 32 are needed")
    clipped = images >= 1.0 - 1e-6
    lit = (images > 0.02).double().mean()
    if float(lit) == 0.0:
        raise ValueError("all pixels are below 0.02 of full scale: no light to calibrate with, use a longer exposure")
    share = float(clipped.double().mean())
    if share > 0.9 * float(lit):
        raise ValueError(f"{share:.0%} of the pixels are saturated: take less light or a shorter exposure")
    linear = images.double().clamp(min=0.0) ** gamma
    parts = torch.stack([part.mean(-1) for part in linear.tensor_split(min(8, linear.shape[-1]), dim=-1)], 1)
    # the fits to these short curves are sequential, and faster on the CPU
    return Profiles(linear.mean(-1).cpu(), parts.cpu(), share)


@dataclass(frozen=True, eq=False)
class BandFit:
    """Bands of period P rows: ``y_p(i) = s_p(i) (1 + sum_k Re[c_pk exp(-2 pi j k i / P)])``."""

    period: float  # P in rows
    period_std: float  # its standard deviation in rows, from the residuals with their correlation
    coefficients: Tensor  # (T, K) complex128, waveform of each frame over its mean
    scene: Tensor  # (T, H) float64, brightness of the rows without flicker
    fitted: Tensor  # (T, H) float64, light of the rows over its mean: ``1 + sum_k Re[c_pk exp(-2 pi j k i / P)]``
    residual: Tensor  # (T, H) float64, residual brightness over that of the scene
    certainty: float  # power of the fundamental over that of residuals at frequencies beside it, all frames together
    evidence: float  # Gaussian log-likelihood less half the number of parameters times log N (BIC)


def _harmonics(rows: Tensor, period: float, count: int) -> tuple[Tensor, Tensor]:
    """Cosines and sines (H, 2 K) of the first harmonics at the rows, and their derivatives with the period."""
    order = torch.arange(1, count + 1, dtype=torch.float64, device="cpu")
    angle = 2 * math.pi * rows[:, None] * order / period
    basis = torch.cat([angle.cos(), angle.sin()], 1)
    slope = torch.cat([angle.sin() * angle, -angle.cos() * angle], 1) / period
    return basis, slope


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Least squares (T, N) of (T, H, N) and (T, H) by normal equations, with a ridge for collinear columns."""
    gram = matrix.mT @ matrix
    gram = gram + torch.diag_embed(1e-11 * gram.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300))
    found: Tensor = torch.linalg.solve(gram, matrix.mT @ right[..., None])[..., 0]
    return found


def _residual(matrix: Tensor, values: Tensor) -> Tensor:
    """Residual of a least-squares fit of (T, H, N) to (T, H)."""
    return values - (matrix @ _solve(matrix, values)[..., None])[..., 0]


def _polynomials(height: int, period: float) -> Tensor:
    """Chebyshev polynomials over the rows (H, N), at most one per period, up to degree 8."""
    degree = max(2, min(8, round(height / period)))
    place = torch.linspace(-1, 1, height, dtype=torch.float64, device="cpu")
    return torch.cos(torch.arange(degree + 1, dtype=torch.float64, device="cpu") * torch.acos(place)[:, None])


def fit_period(brightness: Tensor, start: float, scene: SceneModel) -> BandFit | None:
    """Fit bands to the brightness (T, H) of rows, with the number of harmonics that maximises the evidence.

    The brightness of a ``"smooth"`` scene is a polynomial along the rows, one for each frame; of a ``"fixed"`` scene
    that times a texture of the rows, which is the same in all frames while the bands move. None if the fit diverges.
    """
    best: BandFit | None = None
    for count in (1, 2, 3, 5, 8, 12, 16):
        if count > 1 and count > start / 4:
            break
        found = _fit(brightness, best.period if best else start, scene, count)
        if found is None or abs(found.period / start - 1) > 0.25:
            break
        if best is not None and found.evidence <= best.evidence:
            break
        best = found
    return best


def _fit(brightness: Tensor, period: float, scene: SceneModel, count: int, dark: float = 0.02) -> BandFit | None:
    """Gauss-Newton on period, waveforms and smooth scene together, and on the texture in turn.

    The brightness of the scene is at least ``dark`` times its mean.
    """
    frames, height = brightness.shape
    centre = 0.5 * (height - 1)
    rows = torch.arange(height, dtype=torch.float64, device="cpu") - centre
    smooth = _polynomials(height, period)
    floor = dark * brightness.mean(1, keepdim=True)
    texture = torch.ones(height, dtype=torch.float64, device="cpu")
    level = torch.maximum(_solve(smooth.expand(frames, -1, -1), brightness) @ smooth.T, floor)
    waves = torch.zeros(frames, 2 * count, dtype=torch.float64, device="cpu")
    for turn in range(60):
        basis, slope = _harmonics(rows, period, count)
        pattern = 1 + waves @ basis.T
        if scene == "fixed" and turn > 2:
            shape = level * pattern
            texture = ((shape * brightness).sum(0) / shape.square().sum(0).clamp(min=1e-300)).clamp(min=dark)
        even = brightness / texture
        fixed = torch.cat([level[..., None] * basis, pattern[..., None] * smooth], -1)
        shift = level * (waves @ slope.T)
        residual = even - level * pattern
        unexplained = _residual(fixed, shift)  # of the derivative by the period
        power = float((unexplained * shift).sum())
        step = float((unexplained * residual).sum()) / power if turn > 2 and power > 0 else 0.0
        change = _solve(fixed, residual - step * shift)
        period += max(-0.05 * period, min(0.05 * period, step))
        waves = waves + change[:, : 2 * count]
        level = torch.maximum(level + change[:, 2 * count :] @ smooth.T, floor)
        if not math.isfinite(period) or not 2.0 <= period <= 2 * height:
            return None
        if turn > 8 and abs(step) < 1e-8 * period:
            break
    basis, slope = _harmonics(rows, period, count)
    pattern = 1 + waves @ basis.T
    residual = (brightness / texture - level * pattern) / level
    leverage = waves @ slope.T
    if scene == "fixed":
        leverage = leverage - pattern * (pattern * leverage).sum(0) / pattern.square().sum(0).clamp(min=1e-300)
    leverage = _residual(torch.cat([basis.expand(frames, -1, -1), pattern[..., None] * smooth], -1), leverage)
    back = torch.polar(
        torch.ones(count, dtype=torch.float64, device="cpu"),
        2 * math.pi * centre / period * torch.arange(1, count + 1, dtype=torch.float64, device="cpu"),
    )
    coefficients = torch.complex(waves[:, :count], waves[:, count:]) * back
    certainty = _certainty(coefficients, residual, period)
    values = brightness.numel() / _correlation_rows(residual)  # independent ones
    evidence = -0.5 * values * math.log(float(residual.square().mean()) + 1e-300)
    return BandFit(
        period=period,
        period_std=max(
            _period_std(leverage, residual, period), _period_std_beside(leverage, waves @ slope.T, certainty, period)
        ),
        coefficients=coefficients,
        scene=level * texture,
        fitted=pattern,
        residual=residual,
        certainty=certainty,
        evidence=evidence - 0.5 * 2 * count * frames * math.log(values),
    )


def _correlation_rows(residual: Tensor) -> float:
    """Correlation length of the residuals in rows: ``1 + 2 sum rho(k)`` up to the first rho below 0.05."""
    length = residual.shape[1]
    power = torch.fft.rfft(residual, n=2 * length).abs().square().sum(0)
    covariance = torch.fft.irfft(power)[:length]
    ratio = covariance / covariance[0].clamp(min=1e-300)
    below = (ratio < 0.05).nonzero()
    last = int(below[0]) if len(below) else length
    return float((1 + 2 * ratio[1:last].sum()).clamp(min=1.0))


def _period_std(leverage: Tensor, residual: Tensor, period: float) -> float:
    """Standard deviation of the period, with the correlation of residuals within one period (Bartlett's window)."""
    score = leverage * residual
    length = score.shape[1]
    reach = min(max(8, math.ceil(period)), length - 1)
    power = torch.fft.rfft(score, n=2 * length).abs().square().sum(0)
    covariance = torch.fft.irfft(power)[: reach + 1]
    window = 1 - torch.arange(reach + 1, dtype=torch.float64, device="cpu") / (reach + 1)
    whole = covariance[0] + 2 * (window * covariance)[1:].sum()
    white = residual.square().mean() * leverage.square().sum()
    variance = torch.maximum(whole, torch.maximum(white, covariance[0]))
    return float(variance.sqrt() / leverage.square().sum().clamp(min=1e-300))


def _period_std_beside(leverage: Tensor, shift: Tensor, certainty: float, period: float) -> float:
    """Standard deviation of the period from the power of residuals beside the fundamental, such as texture.

    The angular frequency of a wave of amplitude A over H rows has the standard deviation ``sqrt(6 N) / (A H)`` if its
    coefficient has noise of power N, and a larger one if the scene explains a part of the derivative ``shift``. The
    factor 1.5 allows for the red spectrum of texture; it was measured on drawn scenes.
    """
    height = leverage.shape[1]
    centred = shift - shift.mean(1, keepdim=True)
    loss = float(centred.square().sum() / leverage.square().sum().clamp(min=1e-300))
    return 1.5 * period**2 / (2 * math.pi * height) * math.sqrt(6 / max(certainty, 1e-300) * max(loss, 1.0))


def _certainty(coefficients: Tensor, residual: Tensor, period: float) -> float:
    """Power of the fundamental over the mean power of residuals at 24 frequencies around it."""
    height = residual.shape[1]
    rows = torch.arange(height, dtype=torch.float64, device="cpu")
    steps = torch.arange(-12, 13, dtype=torch.float64, device="cpu")
    frequencies = 1 / period + steps[steps.abs() >= 2] / (2 * height)
    frequencies = frequencies[(frequencies > 0.25 / height) & (frequencies < 0.5)]
    wave = torch.polar(torch.ones(1, dtype=torch.float64, device="cpu"), 2 * math.pi * rows[:, None] * frequencies)
    beside = 2 / height * (residual.to(wave.dtype) @ wave)
    noise = beside.abs().square().mean(1)
    return float((coefficients[:, 0].abs().square() / noise.clamp(min=1e-300)).sum())


def _less_parabola(curves: Tensor) -> Tensor:
    """Curves (N, H) less the parabola that fits each of them."""
    place = torch.linspace(-1, 1, curves.shape[-1], dtype=torch.float64, device="cpu")
    smooth = torch.stack([torch.ones_like(place), place, place.square()], 1)
    weight: Tensor = torch.linalg.lstsq(smooth, curves.mT).solution
    return curves - (smooth @ weight).mT


def _starts(brightness: Tensor, min_periods: float, padding: int = 4) -> list[float]:
    """Periods in rows at the peaks of the spectrum, the six highest and the six highest above the background.

    The transform is ``padding`` times as long as a frame, for the height of its peaks.
    """
    height = brightness.shape[1]
    flat = _less_parabola(brightness) / brightness.mean(1, keepdim=True)
    window = torch.hann_window(height, dtype=torch.float64, device="cpu")
    power = torch.fft.rfft(flat * window, n=padding * height).abs().square().sum(0)
    frequencies = torch.fft.rfftfreq(padding * height, dtype=torch.float32, device="cpu").double()
    usable = (frequencies >= 0.8 * min_periods / height) & (frequencies <= 0.45)
    usable[1:-1] &= (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
    reach = 8 * padding
    around = torch.nn.functional.pad(power[None, None], (reach, reach), mode="reflect")[0, 0]
    background = around.unfold(0, 2 * reach + 1, 1).median(-1).values
    places = usable.nonzero()[:, 0]
    starts: set[float] = set()
    # without the peaks above the background, texture alone is found as flicker in some pairs of frames
    for score in (power, power / background.clamp(min=1e-300)):
        highest = places[score[places].argsort(descending=True)[:6]]
        starts |= set((1 / frequencies[highest]).tolist())
    return sorted(starts)


def find_bands(profiles: Profiles, *, min_periods: float = 1.5, min_period: float = 4.0) -> tuple[BandFit, SceneModel]:
    """The bands whose period has the smallest relative standard deviation, and the model of the scene.

    Several frames of a still scene are fitted together if their bands move, which eliminates the texture of the scene.
    A frame must contain ``min_periods``; bands of less than ``min_period`` rows may be aliases of coarser ones.
    """
    brightness = profiles.rows
    fitted: list[tuple[BandFit, SceneModel]] = []
    scenes: list[tuple[SceneModel, Tensor]] = [("smooth", brightness)]
    if len(brightness) > 1:
        even = brightness / brightness.mean(1, keepdim=True)
        scenes.append(("fixed", even - even.mean(0) + 1.0))
    for scene, curve in scenes:
        fits = [fit_period(brightness, start, scene) for start in _starts(curve, min_periods)]
        usable = [fit for fit in fits if fit is not None and fit.period <= brightness.shape[1]]
        if scene == "fixed":  # a pattern at the same rows in all frames is texture
            usable = [fit for fit in usable if moves(fit)]
        fitted += [(max(usable, key=lambda fit: fit.evidence), scene)] if usable else []
    trusted = [
        (fit, scene)
        for fit, scene in fitted
        if fit.certainty > 50.0  # texture stays below on drawn scenes
        and float(fit.coefficients[:, 0].abs().amax()) > 2e-3
        and (scene == "smooth" or moves(fit))
        and same_everywhere(profiles, fit, scene)
    ]
    if not trusted:
        raise ValueError(
            "no flicker found: no bands of the same period across all columns exceed the texture of the scene; at "
            f"least {min_periods:g} periods of the flicker must fit into a frame with visible contrast; two or more "
            "frames of a still scene eliminate its texture"
        )
    best, model = min(trusted, key=lambda item: item[0].period_std / item[0].period)
    if best.period < min_period:
        raise ValueError(
            f"the bands repeat every {best.period:.2f} rows: flicker this fast is ambiguous; "
            f"use a flicker with bands of at least {min_period:g} rows"
        )
    if brightness.shape[1] / best.period < min_periods:
        raise ValueError(
            f"flicker is slower than a frame: {brightness.shape[1] / best.period:.2f} periods in its rows, at least "
            f"{min_periods:g} are needed; use a faster flicker"
        )
    return best, model


def moves(fit: BandFit) -> bool:
    """Whether the bands move from frame to frame."""
    first = fit.coefficients[:, 0]
    spread = (first - first.mean()).abs().square().mean()
    return bool(spread > 0.02 * first.abs().square().mean())


def same_everywhere(profiles: Profiles, fit: BandFit, scene: SceneModel) -> bool:
    """Whether the bands lie at the same rows in all parts of the columns, as those of light do."""
    parts = profiles.parts
    height = parts.shape[-1]
    periods = int(height / fit.period)
    kept = round(periods * fit.period) if periods >= 2 else height
    if scene == "fixed":
        parts = parts - parts.mean(0) * (parts.mean(-1) / parts.mean((0, -1)))[..., None]
    else:
        parts = _less_parabola(parts.flatten(0, 1)).view_as(parts)
    angle = -2 * torch.pi * torch.arange(kept, dtype=torch.float64, device="cpu") / fit.period
    wave = torch.polar(torch.hann_window(kept, dtype=torch.float64, device="cpu"), angle)
    amplitude = parts[..., :kept].to(wave.dtype) @ wave
    together, each = amplitude.sum(1).abs().sum(), amplitude.abs().sum()
    return bool(together > 0.7 * each)
