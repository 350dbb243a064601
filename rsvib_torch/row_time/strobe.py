"""Exposure from the shape of the bands of an on-off light, or from the contrast of those of a sinusoidal light."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, least_squares

from rsvib_torch.numerics.tables import Array
from rsvib_torch.row_time.flicker import deviations, unexplained

_MAX_MISFIT = 0.3  # largest root mean square of the residuals over the brightness
# relative, of the shape of bands; measured: 0.003 to 0.0045 where noise is clipped at black, 0.01 in 8-bit H.264
_SHAPE_ERROR = 0.005
_DARK = 0.03  # share of other light, such as the black level of a camera, that is not regarded as light
_SAME_MISFIT = 1.05  # of fits that explain the bands equally well, over the smallest


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
    exposure_rows: float  # rows read during the exposure of a row
    exposure_std: float  # its standard deviation
    other_light: float  # constant light over that of the on-off light while it is on
    misfit: float  # root mean square of the residuals over the brightness

    def check_shape(self) -> None:
        """Raise if the bands are not those of an on-off light."""
        if self.misfit > _MAX_MISFIT:
            raise ValueError(
                f"the bands do not have the shape of an on-off light (misfit {self.misfit:.0%} of the mean)"
            )


def fit_strobe(brightness: Array, period: float, phases: Array, on_fraction: float, *, fixed: bool) -> list[StrobeFit]:
    """Fit the bands of an on-off light: the overlap of its pulses with the exposure of each row, and constant light.

    ``brightness`` (T, H) is in proportion to light; ``period`` in rows, and ``phases`` (T,) of the fundamental, ``cos(2
    pi i / P - phase)``, are start values. The light is on for ``on_fraction`` of the period. The scene is a cubic along
    the rows of each frame, or the same in all frames (``fixed``).

    Exposures are shorter than a period, because a whole number of periods more adds constant light and nothing else;
    the result has all fits that explain the bands.
    """
    values = brightness / brightness.mean(1, keepdims=True) if not fixed else brightness
    count, height = values.shape
    rows = np.arange(height)
    smooth = np.polynomial.chebyshev.chebvander(2 * rows / (height - 1) - 1, 3)

    def residuals(parameters: Array) -> Array:
        """Residuals of the bands times the scene, which is fitted to the brightness."""
        long, middles, lit = parameters[1], parameters[-count:, None], float(on_fraction * parameters[0])
        # the brightest row is exposed symmetrically about the pulse
        shape = lit_fraction(rows - middles - 0.5 * long + 0.5 * lit, long, lit, parameters[0]) + parameters[2]
        if fixed:
            left: Array = values - shape * (shape * values).sum(0) / (shape**2).sum(0).clip(min=1e-12)
            return left.ravel()
        return unexplained(smooth * shape[..., None], values).ravel()

    # period, exposure and constant light in rows, and the brightest row of each frame
    middles = phases / (2 * math.pi) * period
    dark, bright = np.quantile(values / values.mean(), (0.02, 0.98))
    other = max(1e-3, dark / max(bright - dark, 1e-3))
    lower = np.array([0.8 * period, 1e-3, 0.0, *(middles - period)])
    upper = np.array([1.25 * period, period, np.inf, *(middles + period)])
    trials = []
    for part in np.linspace(0.1, 1.0, 9) ** 2:
        start = np.array([period, 0.95 * period * part, other, *middles])
        trials.append(least_squares(residuals, start, bounds=(lower, upper), x_scale=np.maximum(np.abs(start), 1e-12)))
    trials.sort(key=lambda trial: trial.cost)
    fits: list[StrobeFit] = []
    for trial in trials:
        misfit = math.sqrt(2 * trial.cost / values.size) / float(values.mean())
        if fits and misfit > _SAME_MISFIT * fits[0].misfit:
            break
        if any(abs(trial.x[1] - fit.exposure_rows) < 0.01 * period for fit in fits):
            continue
        jacobian, residual = trial.jac.reshape(count, height, -1), trial.fun.reshape(count, height)
        std = float(deviations(jacobian, residual, max(4, round(period / 4)))[1])
        fits.append(StrobeFit(float(trial.x[0]), float(trial.x[1]), std, float(trial.x[2]), misfit))
    return fits


def exposure_from_shape(fits: list[StrobeFit], on_fraction: float) -> tuple[float, float, str]:
    """Exposure in rows with its standard deviation, and a note on other light; an error if several explain the bands.

    Without other light the mean brightness over that of the bands determines the number of whole periods. Other light
    increases the mean, so exposures that it implies are upper limits.
    """
    found = []  # exposure in periods, share of other light, fit
    for fit in fits:
        turns = fit.exposure_rows / fit.period
        longest = turns * (1 + fit.other_light / on_fraction)  # without other light
        whole = range(int(longest * (1 + _DARK) - turns) + 1)
        found += [(turns + count, 1 - (turns + count) / longest, fit) for count in whole]
    dark = [item for item in found if abs(item[1]) < _DARK]
    likely = dark or found
    if len(likely) > 1:
        listed = ", ".join(
            f"{turns:.3f} ({max(share, 0.0):.0%})" for turns, share, _ in sorted(likely, key=lambda item: item[0])[-6:]
        )
        raise ValueError(
            f"the bands agree with exposures of {listed} periods of the light (share of constant light in brackets); "
            "exclude other light, or use a slower flicker"
        )
    turns, share, fit = likely[0]
    std = math.hypot(fit.exposure_std, _SHAPE_ERROR * fit.exposure_rows)
    if not dark:
        return turns * fit.period, std, f"{share:.0%} of the light is constant"
    note = "the exposure exceeds a period of the light: it is right only without other light and with the right gamma"
    return turns * fit.period, std, note if turns > 1 else ""


def exposure_from_contrast(contrast: float, light_contrast: float, period: float) -> float:
    """Exposure, in units of the period, that attenuates a sine to the contrast of the bands by ``sinc(f T_e)``."""
    ratio = contrast / light_contrast
    if ratio > 1.0:
        raise ValueError(
            f"the bands have a contrast of {contrast:.3f}, more than the light's own light_contrast={light_contrast:g}"
        )
    return float(period * brentq(lambda turns: np.sinc(turns) - ratio, 0.0, 1.0))
