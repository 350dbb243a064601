"""Bands of flickering light in the brightness of rows: row profiles, candidates for their period, and its fit.

The brightness of row i in frame p is ``s_p(i) (1 + sum_k Re[c_pk exp(-2 pi j k i / P)])``: a scene s times a waveform
of period P. Gauss-Newton fits period, waveforms and a smooth scene, and the texture of a fixed scene in turn.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from rsvib_torch.checks.arguments import Channels, FramesOrFiles, channel_axis
from rsvib_torch.frames.entry_points import load_frames
from rsvib_torch.frames.prepare import as_float_frames
from rsvib_torch.numerics.tables import Array

SceneModel = Literal["smooth", "fixed"]
_TINY = 1e-300  # smallest divisor
MIN_PERIODS = 1.5  # that a frame must contain
_HARMONICS = 16  # at most, of the light; with 8, the row time of an LED in front of a texture was wrong by 0.2 %
_CERTAIN = 50.0  # least ``BandFit.certainty``; that of texture stays below it on drawn scenes
_MIN_PERIOD = 4.0  # rows; shorter bands may be aliases of longer ones


@dataclass(frozen=True, eq=False)
class Profiles:
    """Brightness of rows."""

    rows: Array  # (T, H) float64, mean over the columns of each row, first row of the image first
    parts: Array  # (T, P, H) float64, the same for parts of the columns side by side


def row_profiles(frames: FramesOrFiles, scan_axis: int | str, full_scale: float | None, channels: Channels) -> Profiles:
    """Mean brightness of the rows of a stack (T, H, W) or (T, C, H, W)."""
    loaded = load_frames(frames, full_scale)
    images = as_float_frames(loaded.frames, loaded.full_scale, channels=channels).detach()
    if images.ndim == 5:
        raise ValueError(f"calibration takes one stack, got a batch of shape {tuple(images.shape)}")
    images = images.mean(channel_axis("frames", images.shape, channels)) if images.ndim == 4 else images
    images = images.transpose(-2, -1) if scan_axis in (-1, "x") else images
    if images.shape[-2] < 32:
        raise ValueError(f"frames have {images.shape[-2]} rows along the scan; at least 32 are needed")
    lit = float((images > 0.02).double().mean())
    if lit == 0.0:
        raise ValueError("all pixels are below 0.02 of full scale: no light to calibrate with, use a longer exposure")
    share = float((images >= 1.0 - 1e-6).double().mean())
    if share > 0.9 * lit:
        raise ValueError(f"{share:.0%} of the pixels are saturated: take less light or a shorter exposure")
    light = images.double().clamp(min=0.0)
    parts = [part.mean(-1).cpu().numpy() for part in light.tensor_split(min(8, light.shape[-1]), dim=-1)]
    return Profiles(light.mean(-1).cpu().numpy(), np.stack(parts, 1))


@dataclass(frozen=True, eq=False)
class BandFit:
    """Bands of period P rows: ``y_p(i) = s_p(i) (1 + sum_k Re[c_pk exp(-2 pi j k i / P)])``."""

    period: float  # P in rows
    period_std: float  # its standard deviation in rows, from the residuals at frequencies beside it
    coefficients: Array  # (T, K) complex128, waveform of each frame over its mean
    # power of the fundamental over that of residuals at frequencies beside it, in all frames of a fixed scene together
    certainty: float
    residual: float  # mean square of the residual of the rows over their brightness

    @property
    def moves(self) -> bool:
        """Whether the bands move from frame to frame."""
        first = self.coefficients[:, 0]
        return bool((np.abs(first - first.mean()) ** 2).mean() > 0.02 * (np.abs(first) ** 2).mean())

    @property
    def is_multiple(self) -> bool:
        """Whether the period is a multiple of that of the light, whose fundamental is its strongest harmonic.

        Of 400 textured scenes in one frame, two had row times two and three times too short, with 24 and 65 standard
        deviations.
        """
        power = np.square(np.abs(self.coefficients)).sum(0)
        return bool(power[0] < 0.5 * power.max())


def _solve(matrix: Array, right: Array) -> Array:
    """Least squares (T, N) of (T, H, N) and (T, H) by normal equations, with a ridge for collinear columns."""
    gram = matrix.mT @ matrix
    ridge = 1e-11 * np.maximum(np.diagonal(gram, axis1=-2, axis2=-1), _TINY)
    solution: Array = np.linalg.solve(gram + ridge[..., None] * np.eye(gram.shape[-1]), matrix.mT @ right[..., None])
    return solution[..., 0]


def _unexplained(matrix: Array, values: Array) -> Array:
    """Residual of a least-squares fit of (T, H, N) to (T, H)."""
    return values - (matrix @ _solve(matrix, values)[..., None])[..., 0]


def _fit_bands(brightness: Array, start: float, scene: SceneModel) -> BandFit | None:
    """Fit bands to the brightness (T, H) of rows; None if there are none with a period near ``start``.

    The fundamental alone must be certain: many harmonics of a long period explain texture.
    """
    rough = _fit(brightness, start, scene, 1)
    if rough is None or rough.certainty <= _CERTAIN:
        return None
    fit = _fit(brightness, rough.period, scene, max(1, min(_HARMONICS, int(rough.period / 4))))
    return fit if fit is not None and fit.certainty > _CERTAIN else None


def _fit(brightness: Array, start: float, scene: SceneModel, count: int) -> BandFit | None:
    """Fit a number of harmonics to the brightness (T, H) of rows; None if the period changes by more than a quarter.

    The brightness of a ``"smooth"`` scene is a polynomial along the rows, one for each frame; that of a ``"fixed"``
    scene has a texture of the rows as well, which is the same in all frames. Gauss-Newton finds period, waveforms and
    smooth scene together, and the texture in turn.
    """
    frames, height = brightness.shape
    period = start
    centre = 0.5 * (height - 1)
    rows = np.arange(height) - centre
    order = np.arange(1, count + 1)
    # of the smooth scene, at most one per period; a fixed scene differs by a factor
    degree = 0 if scene == "fixed" else max(2, min(8, round(height / period)))
    smooth = np.polynomial.chebyshev.chebvander(rows / centre, degree)
    dark = 0.02  # smallest brightness of the scene, of its mean
    floor = dark * brightness.mean(1, keepdims=True)
    texture = np.ones(height)
    level = np.maximum(_solve(np.broadcast_to(smooth, (frames, *smooth.shape)), brightness) @ smooth.T, floor)
    waves = np.zeros((frames, 2 * count))  # cosines and sines of the harmonics

    def linearised() -> tuple[Array, Array, Array]:
        """Pattern (T, H), its derivatives by waves and smooth scene (T, H, N), and by the period (T, H)."""
        angle = 2 * math.pi * rows[:, None] * order / period
        basis = np.concatenate([np.cos(angle), np.sin(angle)], 1)
        slope = np.concatenate([np.sin(angle) * angle, -np.cos(angle) * angle], 1) / period
        return 1 + waves @ basis.T, basis, waves @ slope.T

    for turn in range(60):
        pattern, basis, by_period = linearised()
        if scene == "fixed" and turn > 2:
            shape = level * pattern
            texture = ((shape * brightness).sum(0) / (shape**2).sum(0).clip(min=_TINY)).clip(min=dark)
        fixed = np.concatenate([level[..., None] * basis, pattern[..., None] * smooth], -1)
        shift = level * by_period
        residual = brightness / texture - level * pattern
        free = _unexplained(fixed, shift)  # part of the derivative by the period that the others do not explain
        power = float((free * shift).sum())
        step = float((free * residual).sum()) / power if turn > 2 and power > 0 else 0.0
        change = _solve(fixed, residual - step * shift)
        period += max(-0.05 * period, min(0.05 * period, step))
        waves = waves + change[:, : 2 * count]
        level = np.maximum(level + change[:, 2 * count :] @ smooth.T, floor)
        if not abs(period / start - 1) <= 0.25:
            return None
        if turn > 8 and abs(step) < 1e-8 * period:
            break
    pattern, basis, shift = linearised()
    residual = (brightness / texture - level * pattern) / level
    leverage = shift
    if scene == "fixed":
        leverage = leverage - pattern * (pattern * leverage).sum(0) / (pattern**2).sum(0).clip(min=_TINY)
    basis = np.broadcast_to(basis, (frames, *basis.shape))
    leverage = _unexplained(np.concatenate([basis, pattern[..., None] * smooth], -1), leverage)
    back = np.exp(2j * math.pi * centre / period * order)
    coefficients = (waves[:, :count] + 1j * waves[:, count:]) * back
    certainty = _certainty(coefficients, residual, period)
    if scene == "smooth":  # its texture is the same in all frames
        certainty /= frames
    return BandFit(
        period=period,
        period_std=_period_std_beside(leverage, shift, certainty, period),
        coefficients=coefficients,
        certainty=certainty,
        residual=float((residual**2).mean()),
    )


def _period_std_beside(leverage: Array, shift: Array, certainty: float, period: float) -> float:
    """Standard deviation of the period from the power of residuals beside the fundamental, such as texture.

    The angular frequency of a wave of amplitude A over H rows has the standard deviation ``sqrt(6 N) / (A H)`` if its
    coefficient has noise of power N, and a larger one if the scene explains a part of the derivative ``shift``. The
    factor 1.5 allows for the red spectrum of texture; it was measured on drawn scenes.
    """
    height = int(leverage.shape[1])
    loss = float(height * shift.var(1).sum()) / max(float((leverage**2).sum()), _TINY)
    return 1.5 * period**2 / (2 * math.pi * height) * math.sqrt(6 / max(certainty, _TINY) * max(loss, 1.0))


def _certainty(coefficients: Array, residual: Array, period: float) -> float:
    """Power of the fundamental over the mean power of residuals at 22 frequencies around it."""
    height = residual.shape[1]
    steps = np.arange(-12, 13)
    frequencies = 1 / period + steps[np.abs(steps) >= 2] / (2 * height)
    frequencies = frequencies[(frequencies > 0.25 / height) & (frequencies < 0.5)]
    beside = 2 / height * (residual @ np.exp(2j * math.pi * np.arange(height)[:, None] * frequencies))
    noise = (np.abs(beside) ** 2).mean(1)
    return float((np.abs(coefficients[:, 0]) ** 2 / noise.clip(min=_TINY)).sum())


def _less_parabola(curves: Array) -> Array:
    """Curves (..., H) less the parabola that fits each of them."""
    smooth = np.linalg.qr(np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, curves.shape[-1]), 2))[0]
    return curves - curves @ smooth @ smooth.T


def _starts(brightness: Array) -> list[float]:
    """Periods in rows at the peaks of the spectrum, the six highest and the six highest above the background."""
    height = brightness.shape[1]
    padding = 4  # length of the transform over that of a frame, for the height of its peaks
    flat = _less_parabola(brightness) / brightness.mean(1, keepdims=True)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(height) / height)
    power = (np.abs(np.fft.rfft(flat * window, n=padding * height)) ** 2).sum(0)
    frequencies = np.fft.rfftfreq(padding * height)
    usable = (frequencies >= 0.8 * MIN_PERIODS / height) & (frequencies <= 0.45)
    usable[1:-1] &= (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
    background = ndimage.median_filter(power, 16 * padding + 1, mode="mirror")
    places = np.flatnonzero(usable)
    starts: set[float] = set()
    # without the peaks above the background, texture alone is found as flicker in some pairs of frames
    for score in (power, power / background.clip(min=_TINY)):
        starts |= set((1 / frequencies[places[np.argsort(-score[places])[:6]]]).tolist())
    return sorted(starts)


def find_bands(profiles: Profiles) -> tuple[BandFit, SceneModel]:
    """The bands with the best known period, and the model of the scene, which several frames separate if bands move."""
    brightness = profiles.rows
    scenes: list[tuple[SceneModel, Array]] = [("smooth", brightness)]
    if len(brightness) > 1:
        even = brightness / brightness.mean(1, keepdims=True)
        scenes.append(("fixed", even - even.mean(0) + 1.0))
    trusted: list[tuple[BandFit, SceneModel]] = []
    for scene, curve in scenes:
        fits = [_fit_bands(brightness, start, scene) for start in _starts(curve)]
        usable = [
            fit
            for fit in fits
            if fit is not None
            and fit.period <= brightness.shape[1]
            and (scene == "smooth" or fit.moves)  # a pattern at the same rows in all frames is texture
            and np.abs(fit.coefficients[:, 0]).max() > 2e-3
            and not fit.is_multiple
            and _same_everywhere(profiles, fit, scene)
        ]
        if usable:
            trusted.append((min(usable, key=lambda fit: fit.residual), scene))
    if not trusted:
        raise ValueError(
            "no flicker found: no bands of the same period across all columns exceed the texture of the scene; at "
            f"least {MIN_PERIODS:g} periods of the flicker must fit into a frame with visible contrast; two or more "
            "frames of a still scene eliminate its texture; bands must follow each other along scan_axis"
        )
    best, model = min(trusted, key=lambda item: item[0].period_std / item[0].period)
    if best.period < _MIN_PERIOD:
        raise ValueError(
            f"the bands repeat every {best.period:.2f} rows: flicker this fast is ambiguous; "
            f"use a flicker with bands of at least {_MIN_PERIOD:g} rows"
        )
    if brightness.shape[1] / best.period < MIN_PERIODS:
        raise ValueError(
            f"flicker is slower than a frame: {brightness.shape[1] / best.period:.2f} periods in its rows, at least "
            f"{MIN_PERIODS:g} are needed; use a faster flicker; bands must follow each other along scan_axis"
        )
    return best, model


def _same_everywhere(profiles: Profiles, fit: BandFit, scene: SceneModel) -> bool:
    """Whether the bands lie at the same rows in all parts of the columns, as those of light do."""
    parts = profiles.parts
    height = parts.shape[-1]
    periods = int(height / fit.period)
    rows = round(periods * fit.period) if periods >= 2 else height
    if scene == "fixed":
        parts = parts - parts.mean(0) * (parts.mean(-1) / parts.mean((0, -1)))[..., None]
    else:
        parts = _less_parabola(parts)
    phase = 2 * np.pi * np.arange(rows)
    amplitude = parts[..., :rows] @ ((0.5 - 0.5 * np.cos(phase / rows)) * np.exp(-1j * phase / fit.period))
    # bands of light have 0.97 and more, textures of photographs up to 0.95, of which most are below this
    return bool(np.abs(amplitude.sum(1)).sum() > 0.85 * np.abs(amplitude).sum())
