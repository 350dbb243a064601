"""Exposure from the shape of the bands of an on-off light, or from the contrast of those of a sinusoidal light."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares
from torch import Tensor

Array = NDArray[np.float64]


def lit_fraction(begin: Array, exposure: float, on_time: float, period: float) -> Array:
    """Fraction of exposures from ``begin`` on in which a light is on that goes on at 0, P, 2 P ... for ``on_time``.

    Example:
        >>> lit_fraction(np.array([-1.0, 0.0, 1.5, 2.0]), 1.0, 2.0, 10.0).tolist()
        [0.0, 1.0, 0.5, 0.0]
    """

    def lit_until(time: Array) -> Array:
        whole = np.floor(time / period)
        return np.asarray(whole * on_time + np.minimum(time - whole * period, on_time))

    return (lit_until(begin + exposure) - lit_until(begin)) / exposure


@dataclass(frozen=True)
class StrobeFit:
    """Bands of an on-off light, in rows."""

    period: float  # P
    on_rows: float  # rows read while the light is on
    exposure_rows: Array  # (T,) rows read during the exposure of one row
    std: dict[str, float]  # standard deviations of the free parameters, by name


def _residuals(brightness: Array, smooth: Array, shape: Array) -> Array:
    """Residuals of bands of this shape (T, H) times a cubic along the rows of each frame, fitted to the brightness."""
    residuals = []
    for values, waves in zip(brightness, shape, strict=True):
        columns = smooth * waves[:, None]
        weight, *_ = np.linalg.lstsq(columns, values, rcond=None)
        residuals.append(values - columns @ weight)
    return np.concatenate(residuals)


def fit_strobe(
    brightness: Tensor,
    period: float,
    phases: Sequence[float],
    *,
    on_fraction: float | None = None,
    exposures: Sequence[float] | None = None,
    max_misfit: float = 0.3,
) -> StrobeFit:
    """Fit the bands of an on-off light: the overlap of its pulses with the exposure of each row.

    Given the fraction of time that the light is on, the exposure is estimated; given the exposures of two or more
    frames in seconds, the row time and the on-time.

    Args:
        brightness: (T, H), in proportion to light.
        period: Period of the bands in rows, to start with.
        phases: Phase of the fundamental in each frame, ``cos(2 pi i / P - phase)``, to start with.
        on_fraction: Fraction of the period that the light is on.
        exposures: Exposures in seconds, one a frame; ``std["row_time"]`` then holds that of the row time.
        max_misfit: Largest root mean square of the residuals over the brightness.
    """
    values = (brightness / brightness.mean(1, keepdim=True)).numpy()
    height = values.shape[1]
    rows = np.arange(height, dtype=np.float64)
    smooth = np.polynomial.chebyshev.chebvander(2 * rows / (height - 1) - 1, 3)
    count = len(values)

    def exposure_rows(parameters: Array) -> Array:
        if exposures is None:
            return np.full(count, parameters[1])
        rows: Array = np.asarray(exposures, dtype=np.float64) / parameters[1]
        return rows

    def on_rows(parameters: Array) -> float:
        return float(on_fraction * parameters[0] if on_fraction is not None else parameters[2])

    def residuals(parameters: Array) -> Array:
        long, lit = exposure_rows(parameters), on_rows(parameters)
        # the brightest row is exposed symmetrically about the pulse
        shape = np.stack(
            [
                lit_fraction(rows - middle - 0.5 * e + 0.5 * lit, e, lit, parameters[0])
                for middle, e in zip(parameters[-count:], long, strict=True)
            ]
        )
        return _residuals(values, smooth, shape)

    middles = [phase / (2 * math.pi) * period for phase in phases]
    best = None
    starts, longest_exposure = 9, 3.0  # periods
    for step in range(1, starts + 1):
        if exposures is None:
            guess = [period, longest_exposure * period * (step / starts) ** 2]
            lower, upper = [0.8 * period, 1e-3], [1.25 * period, (longest_exposure + 0.5) * period]
        else:
            longest = max(exposures)
            guess = [period, longest / (period * 0.8 * step / starts), 0.3 * period]
            lower, upper = [0.8 * period, longest / (4 * period)], [1.25 * period, longest]
            lower, upper = [*lower, 1e-3], [*upper, 1.1 * period]
        bounds = ([*lower, *(m - period for m in middles)], [*upper, *(m + period for m in middles)])
        start = np.clip([*guess, *middles], np.asarray(bounds[0]) * 1.0, np.asarray(bounds[1]))
        trial = least_squares(residuals, start, bounds=bounds, x_scale=np.maximum(np.abs(start), 1e-12))
        if best is None or trial.cost < best.cost:
            best = trial
    assert best is not None
    misfit = math.sqrt(2 * best.cost / values.size)
    if misfit > max_misfit:
        raise ValueError(f"the bands do not have the shape of an on-off light (misfit {misfit:.0%} of the mean)")
    names = ["period", "exposure_rows"] if exposures is None else ["period", "row_time", "on_rows"]
    std = _deviations(best.jac, best.fun.reshape(count, height), period)
    return StrobeFit(
        period=float(best.x[0]),
        on_rows=on_rows(best.x),
        exposure_rows=exposure_rows(best.x),
        std=dict(zip(names, std, strict=False)),
    )


def _deviations(jacobian: Array, residual: Array, period: float) -> list[float]:
    """Standard deviations of parameters, with the correlation of residuals over a quarter of a period."""
    information = np.linalg.pinv(jacobian.T @ jacobian)
    reach = max(4, round(period / 4))
    score = jacobian.reshape(*residual.shape, -1) * residual[..., None]
    total = np.einsum("tin,tim->nm", score, score)
    for lag in range(1, min(reach, residual.shape[1] - 1) + 1):
        both = np.einsum("tin,tim->nm", score[:, lag:], score[:, :-lag])
        total += (1 - lag / (reach + 1)) * (both + both.T)
    white = np.mean(residual**2) * information
    variance = np.maximum(np.diag(information @ total @ information), np.diag(white))
    return [float(v) for v in np.sqrt(np.maximum(variance, 0.0))]


def exposure_from_contrast(contrast: float, light_contrast: float, period: float) -> float:
    """Exposure that attenuates a sine of known contrast to the contrast of the bands: ``sinc(f T_e)``, first lobe.

    The result has the unit of the period 1/f; the contrast is the amplitude of the fundamental over the mean.

    Example:
        >>> round(exposure_from_contrast(0.5 * 2 / math.pi, 0.5, 10.0), 6)
        5.0
    """
    ratio = contrast / light_contrast
    if ratio > 1.0:
        raise ValueError(
            f"the bands have a contrast of {contrast:.3f}, more than the light's own light_contrast={light_contrast:g}"
        )
    return float(period * brentq(lambda turns: np.sinc(turns) - ratio, 0.0, 1.0))
