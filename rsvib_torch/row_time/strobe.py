"""Exposure from the shape of the bands of an on-off light, or from the contrast of those of a sinusoidal light."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, least_squares

from rsvib_torch.numerics.tables import Array
from rsvib_torch.row_time.flicker import deviations, unexplained

_MAX_MISFIT = 0.3  # largest root mean square of the residuals over the brightness


def lit_fraction(begin: Array, exposure: Array | float, on_time: float, period: float) -> Array:
    """Fraction of exposures from ``begin`` on in which a light is on that goes on at 0, P, 2 P ... for ``on_time``."""

    def lit_until(time: Array) -> Array:
        whole = np.floor(time / period)
        return np.asarray(whole * on_time + np.minimum(time - whole * period, on_time))

    return (lit_until(begin + exposure) - lit_until(begin)) / exposure


@dataclass(frozen=True)
class StrobeFit:
    """Bands of an on-off light, in rows."""

    period: float  # P
    exposure_rows: float  # rows read during the longest exposure of a row
    exposure_std: float  # its standard deviation


def fit_strobe(
    brightness: Array, period: float, phases: Array, exposures: Array, on_fraction: float | None = None
) -> StrobeFit:
    """Fit the bands of an on-off light: the overlap of its pulses with the exposure of each row.

    ``brightness`` (T, H) is in proportion to light; ``period`` in rows, and ``phases`` (T,) of the fundamental, ``cos(2
    pi i / P - phase)``, are start values. ``exposures`` (T,) have any unit. The fraction of the period that the light
    is on is estimated from different exposures unless it is given.
    """
    values = brightness / brightness.mean(1, keepdims=True)
    count, height = values.shape
    rows = np.arange(height)
    smooth = np.polynomial.chebyshev.chebvander(2 * rows / (height - 1) - 1, 3)
    relative = exposures[:, None] / exposures.max()

    def residuals(parameters: Array) -> Array:
        """Residuals of the bands times a cubic along the rows of each frame, fitted to the brightness."""
        long, middles = parameters[1] * relative, parameters[-count:, None]
        lit = float(parameters[2] if on_fraction is None else on_fraction * parameters[0])
        # the brightest row is exposed symmetrically about the pulse
        shape = lit_fraction(rows - middles - 0.5 * long + 0.5 * lit, long, lit, parameters[0])
        return unexplained(smooth * shape[..., None], values).ravel()

    # period, longest exposure and on-time in rows, and the brightest row of each frame
    kept = [0, 1, 2, *range(3, 3 + count)] if on_fraction is None else [0, 1, *range(3, 3 + count)]
    middles = phases / (2 * math.pi) * period
    lower = np.array([0.8 * period, 1e-3, 1e-3, *(middles - period)])[kept]
    upper = np.array([1.25 * period, 4 * period, 1.1 * period, *(middles + period)])[kept]
    trials = []
    starts, longest = 9, 3.0  # periods
    for step in range(1, starts + 1):
        start = np.array([period, longest * period * (step / starts) ** 2, 0.3 * period, *middles])[kept]
        trials.append(least_squares(residuals, start, bounds=(lower, upper), x_scale=np.maximum(np.abs(start), 1e-12)))
    best = min(trials, key=lambda trial: trial.cost)
    misfit = math.sqrt(2 * best.cost / values.size)
    if misfit > _MAX_MISFIT:
        raise ValueError(f"the bands do not have the shape of an on-off light (misfit {misfit:.0%} of the mean)")
    std = deviations(best.jac.reshape(count, height, -1), best.fun.reshape(count, height), max(4, round(period / 4)))
    return StrobeFit(float(best.x[0]), float(best.x[1]), float(std[1]))


def exposure_from_contrast(contrast: float, light_contrast: float, period: float) -> float:
    """Exposure that attenuates a sine of known contrast to the contrast of the bands: ``sinc(f T_e)``, first lobe.

    The result has the unit of the period 1/f; the contrast is the amplitude of the fundamental over the mean.
    """
    ratio = contrast / light_contrast
    if ratio > 1.0:
        raise ValueError(
            f"the bands have a contrast of {contrast:.3f}, more than the light's own light_contrast={light_contrast:g}"
        )
    return float(period * brentq(lambda turns: np.sinc(turns) - ratio, 0.0, 1.0))
