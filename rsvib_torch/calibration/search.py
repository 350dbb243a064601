"""Finding bands: where to start a fit, and whether there is anything to fit."""

import torch
from torch import Tensor

from rsvib_torch.calibration.period import BandFit, SceneModel, fit_period
from rsvib_torch.calibration.profiles import Profiles

__all__ = ["find_bands", "moves", "same_everywhere"]

_LEAST_PERIODS = 1.5  # in a frame
_LEAST_ROWS = 4.0  # of a period: bands that are finer cannot be told from coarser ones
_CANDIDATES = 6
_PADDING = 4
_CERTAIN = 50.0  # power of the bands over that of the scene beside them
_LEAST_CONTRAST = 2e-3
_ALIKE = 0.7  # of the columns' bands
_MOVED = 0.02  # of the bands' power


def _spectrum(brightness: Tensor) -> tuple[Tensor, Tensor]:
    """Power (N,) of the brightness of rows over a smooth one, and its frequencies in cycles per row."""
    height = brightness.shape[1]
    place = torch.linspace(-1, 1, height, dtype=torch.float64)
    smooth = torch.stack([torch.ones_like(place), place, place.square()], 1)
    weight = torch.linalg.lstsq(smooth, brightness.T).solution
    flat = (brightness - (smooth @ weight).T) / brightness.mean(1, keepdim=True)
    length = _PADDING * height
    window = torch.hann_window(height, dtype=torch.float64)
    return torch.fft.rfft(flat * window, n=length).abs().square().sum(0), torch.fft.rfftfreq(length).double()


def _starts(brightness: Tensor) -> list[float]:
    """Periods in rows at the peaks of the spectrum, the highest and those highest above their surroundings."""
    power, frequencies = _spectrum(brightness)
    height = brightness.shape[1]
    usable = (frequencies >= 0.8 * _LEAST_PERIODS / height) & (frequencies <= 0.45)
    reach = 8 * _PADDING
    around = torch.nn.functional.pad(power[None, None], (reach, reach), mode="reflect")[0, 0]
    background = around.unfold(0, 2 * reach + 1, 1).median(-1).values
    peak = torch.zeros_like(usable)
    peak[1:-1] = (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
    starts: list[float] = []
    for score in (power, power / background.clamp(min=1e-300)):
        ranked = torch.where(usable & peak, score, 0.0).argsort(descending=True)[:_CANDIDATES]
        starts += [float(1 / frequencies[place]) for place in ranked if bool(usable[place] & peak[place])]
    return sorted(set(starts))


def find_bands(profiles: Profiles) -> tuple[BandFit, SceneModel]:
    """The bands that explain most of the brightness of the rows.

    Several frames of a still scene are taken together where their bands move, so that its texture drops out.

    Returns:
        The fit, and the model of the scene that it stands on.

    Raises:
        ValueError: If there are no bands, or they are too fine or too coarse.
    """
    brightness = profiles.rows
    found: list[tuple[BandFit, SceneModel]] = []
    scenes: list[tuple[SceneModel, Tensor]] = [("smooth", brightness)]
    if len(brightness) > 1:
        even = brightness / brightness.mean(1, keepdim=True)
        scenes.append(("fixed", even - even.mean(0) + 1.0))
    for scene, curve in scenes:
        fits = [fit_period(brightness, start, scene) for start in _starts(curve)]
        usable = [fit for fit in fits if fit is not None and fit.period <= brightness.shape[1]]
        if scene == "fixed":  # a pattern that stays is texture, whatever harmonics of it do
            usable = [fit for fit in usable if moves(fit)]
        found += [(max(usable, key=lambda fit: fit.evidence), scene)] if usable else []
    trusted = [
        (fit, scene)
        for fit, scene in found
        if fit.certainty > _CERTAIN
        and float(fit.coefficients[:, 0].abs().amax()) > _LEAST_CONTRAST
        and (scene == "smooth" or moves(fit))
        and same_everywhere(profiles, fit, scene)
    ]
    if not trusted:
        raise ValueError(
            "no flicker found: no bands of the same period across all columns stand out of the scene; "
            f"at least {_LEAST_PERIODS:g} periods of the flicker must fit into a frame, its contrast must show, and "
            "texture of the scene drops out where two or more frames of a still scene are given"
        )
    best, model = min(trusted, key=lambda item: item[0].period_std / item[0].period)
    if best.period < _LEAST_ROWS:
        raise ValueError(
            f"the bands repeat every {best.period:.2f} rows: flicker this fast is not told from slower one; "
            f"take a flicker with bands of at least {_LEAST_ROWS:g} rows"
        )
    if brightness.shape[1] / best.period < _LEAST_PERIODS:
        raise ValueError(
            f"flicker is slower than a frame: {brightness.shape[1] / best.period:.2f} periods in its rows, at least "
            f"{_LEAST_PERIODS:g} are needed; take a faster flicker"
        )
    return best, model


def moves(fit: BandFit) -> bool:
    """Whether the bands move from frame to frame."""
    first = fit.coefficients[:, 0]
    spread = (first - first.mean()).abs().square().mean()
    return bool(spread > _MOVED * first.abs().square().mean())


def same_everywhere(profiles: Profiles, fit: BandFit, scene: SceneModel) -> bool:
    """Whether the bands lie at the same rows in all parts of the columns, as light makes them and texture does not."""
    rows = torch.arange(profiles.rows.shape[1], dtype=torch.float64)
    parts = profiles.parts
    height = parts.shape[-1]
    periods = int(height / fit.period)
    kept = round(periods * fit.period) if periods >= 2 else height
    if scene == "fixed":
        parts = parts - parts.mean(0) * (parts.mean(-1) / parts.mean((0, -1)))[..., None]
    else:
        place = torch.linspace(-1, 1, height, dtype=torch.float64)
        smooth = torch.stack([torch.ones_like(place), place, place.square()], 1)
        weight = torch.linalg.lstsq(smooth, parts.flatten(0, 1).T).solution
        parts = parts - (smooth @ weight).T.unflatten(0, parts.shape[:2])
    wave = torch.polar(torch.hann_window(kept, dtype=torch.float64), -2 * torch.pi * rows[:kept] / fit.period)
    amplitude = parts[..., :kept].to(wave.dtype) @ wave
    together, each = amplitude.sum(1).abs().sum(), amplitude.abs().sum()
    return bool(together > _ALIKE * each)
