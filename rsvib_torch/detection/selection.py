"""How many tones: added one by one, strongest first, as long as the data ask for them."""

from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.blind_tones import with_blind_tones
from rsvib_torch.detection.fit import fit_roughly, fit_tones
from rsvib_torch.detection.inversion import BLIND, amplitude_deviation, offset_gain
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.periodogram import MAJORITY, strongest_frequencies
from rsvib_torch.detection.robust import of_each, residual_of, robust_fit, typical_size
from rsvib_torch.detection.tones import MotionModel, ToneFit, tone_response

__all__ = [
    "LEAST_GAIN",
    "LEAST_SIGNIFICANCE",
    "LEAST_SWING",
    "MAX_TONES",
    "find_tones",
    "significant_only",
    "strongest_only",
]

MAX_TONES = 4
LEAST_GAIN = 0.1  # |gain| below this multiplies noise more than tenfold
LEAST_SIGNIFICANCE = 4.0  # amplitude over its standard deviation
LEAST_SWING = 0.01  # px, offsets that a tone makes: less may be left over from interpolation
_FADED = 0.1  # of its amplitude is all that an exposure leaves of a tone
_F_THRESHOLD = 14.0  # of chi-square gained per parameter over noise: chance over a whole frequency grid stays below it
_LEAST_GAIN = 0.2  # of the residual chi-square that a further tone must explain
_HOPEFUL = 0.5  # of that share, before outliers are weighed anew: with less a tone need not be fitted to the end
_LEAST_APART = 0.7  # of one over the record: tones nearer than this are one that the noise has split
_CANDIDATES = 4  # peaks of the periodogram that are tried: outliers may raise a wrong one
_LEFT_OUT = 0.35  # of the record, the length of a stretch that is left out
_STRETCHES = 7  # that are left out one at a time, each overlapping the next by half
_ABSOLUTE_STEPS = 3  # rounds of reweighting towards least absolute residuals
_NEARLY_ALL, _LITTLE = 0.9, 0.05  # of the rows, and of their typical displacement: what is left when none pulls
_FEW_CANDIDATES = 2  # for each stretch


def _with_one_more(
    measurements: Measurements,
    weighed: Measurements,
    before: ToneFit,
    left: Tensor,
    active: Tensor,
    sample_interval: float,
    reckon: bool,
) -> tuple[Tensor, Tensor]:
    """Frequencies with one more tone (or family) an axis, the one that leaves the majority of rows least.

    Candidates come from the periodogram of what ``before`` has ``left``. To ``reckon`` with clouds and with things that
    move by themselves, which cover stretches of rows, every stretch of the record is left out once: where all that
    pulls the fit away is left out, the others fall in line.

    Returns:
        Frequencies (B, 2, K) and what a first fit with them leaves, (B, N, G, 2).
    """
    model, harmonics = before.model, before.model.harmonics
    unexplained = replace(measurements, displacements=left)
    parts, weights = measurements, weighed.weights[:, None]
    if reckon:
        counts = _stretches(measurements)
        parts = measurements.repeated(len(counts)).only(counts.repeat(len(measurements.moments), 1))
        without = counts[1:, :, None] * measurements.weights[:, None]
        weights = torch.cat([weights, without], 1)
    number = _FEW_CANDIDATES if reckon else _CANDIDATES
    peaks = strongest_frequencies(unexplained, sample_interval, harmonics, number, weights).flatten(0, 1)
    multiples = torch.arange(1, harmonics + 1, dtype=torch.float64, device=peaks.device)
    further = (peaks[..., None] * multiples).transpose(1, 2).flatten(0, 1)  # (B C, 2, H)
    count = len(further) // len(measurements.moments)
    known = before.frequencies[..., : active.shape[-1] - harmonics].repeat_interleave(count, 0)
    several, which = measurements.repeated(count), active.repeat_interleave(count, 0)
    rough, residual = fit_roughly(parts.repeated(peaks.shape[-1]), torch.cat([known, further], -1), which, model)
    size = several.sizes(residual).nanquantile(MAJORITY, dim=1).nan_to_num(0.0).unflatten(0, (-1, count))
    sighted = _sighted(several, rough.frequencies[..., -harmonics:]).unflatten(0, (-1, count))
    best = ((size.amax(1, keepdim=True) - size) * sighted).argmax(1)  # each axis for itself

    def chosen(values: Tensor, axis: int) -> Tensor:
        each = values.unflatten(0, (-1, count)).movedim(axis + 1, 2)  # (B, C, 2, ...)
        place = best.reshape(-1, 1, 2, *(1,) * (each.ndim - 3)).expand(-1, 1, -1, *each.shape[3:])
        picked: Tensor = each.gather(1, place)[:, 0].movedim(1, axis)
        return picked

    frequencies, residual = chosen(rough.frequencies, 1), chosen(residual, 3)
    for _ in range(_ABSOLUTE_STEPS if reckon else 0):
        nearer = measurements.for_least_absolute(residual)
        nearest, residual = fit_roughly(nearer, frequencies, active, model)
        frequencies = nearest.frequencies
    return frequencies, residual


def _undisturbed(measurements: Measurements, left: Tensor) -> Tensor:
    """(B,) bool: a fit has left so little of nearly all rows that no stretch of them can have pulled it away."""
    most = measurements.sizes(left).nanquantile(_NEARLY_ALL, dim=1)
    whole = measurements.sizes(measurements.relative(measurements.displacements)).nanmedian(1).values
    return (most < _LITTLE * whole).all(-1)


def _farthest(measurements: Measurements, left: Tensor) -> Tensor:
    """(B, 2) px, more than a fit that has ``left`` (B, N, G, 2) is off at nearly all rows which tell of an axis."""
    return measurements.distances(left).nanquantile(_NEARLY_ALL, dim=1).nan_to_num(torch.inf)


def _better_where(
    where: Tensor, measurements: Measurements, one: tuple[ToneFit, Measurements], other: tuple[ToneFit, Measurements]
) -> tuple[ToneFit, Measurements]:
    """Fit and weights of the one for the stacks (B,) where that is asked for and leaves the typical row less."""
    better = where & (typical_size(measurements, one[0]) < typical_size(measurements, other[0]))
    return of_each(better, one[0], other[0]), of_each(better, one[1], other[1])


def _stretches(measurements: Measurements) -> Tensor:
    """(S, N) bool, rows that count: all of them first, then all but a stretch, one stretch after the other."""
    rows = measurements.moments.shape[1]
    place = (torch.arange(rows, dtype=torch.float64, device=measurements.moments.device) + 0.5) / rows
    first = torch.linspace(0, 1 - _LEFT_OUT, _STRETCHES, dtype=torch.float64, device=place.device)[:, None]
    counts = (place < first) | (place > first + _LEFT_OUT)
    return torch.cat([torch.ones_like(counts[:1]), counts])


def _sighted(measurements: Measurements, frequencies: Tensor) -> Tensor:
    """(B, 2) 0 for frequencies (B, 2, H) that the record is blind to, 1 where the gain is large.

    The exposure fades tones near multiples of 1/T_e: what long exposures do to fine detail is not to be taken for one.
    """
    response = tone_response(measurements, frequencies)
    gain = 4 * response.abs().square().mean((1, 2)).amax(-1)
    shown = torch.sinc(frequencies * measurements.exposure_time).abs().amax(-1) > _FADED
    return gain / (gain + BLIND**2) * shown


def find_tones(
    measurements: Measurements,
    sample_interval: float,
    tones: int | None = None,
    model: MotionModel | None = None,
    least_gain: float = _LEAST_GAIN,
    start: ToneFit | None = None,
    blind: Tensor | None = None,
    enough: float = 0.0,
) -> ToneFit:
    """Find and fit the tones of both axes without start values.

    The strongest tone of the gain-aware periodogram is added and all parameters are fitted again, until ``tones`` are
    there, or until the next one is not significant: it must lower the weighted sum of squares by far more than noise
    would over all frequencies tried (an F-test), and explain ``least_gain`` of what is left.

    Args:
        measurements: The displacements.
        sample_interval: Seconds between neighbouring rows or bands.
        tones: Number of tones of each axis (of families, where harmonics are tied); None to choose it from the data.
        model: What is fitted beside the tones.
        least_gain: Share of the residual that a further tone must explain.
        start: Tones that are known to be there; without it the search reckons with stretches of outliers.
        blind: (F,) Hz that the frames cannot see, so that side tones of such a tone are known for what they are.
        enough: An axis with a tone that leaves nearly all rows less than so many px needs no further one.

    Returns:
        The fit, with K the largest number of tones of any axis (at least 1).
    """
    model = model or MotionModel()
    none = measurements.moments.new_zeros(len(measurements.moments), 2, model.harmonics, dtype=torch.bool)
    reckon = start is None
    if start is None:
        keep, (fit, weighed) = none[..., :0], robust_fit(measurements, none.double(), none, model)
    else:
        keep, given = start.active, residual_of(measurements, start)
        fit, weighed = robust_fit(measurements, start.frequencies, keep, model, given)
    parameters = 2 * model.harmonics + 1

    def not_invented(trial: ToneFit) -> Tensor:
        """(B, 2) whether the last tone may stand: what the record hardly sees may be refused, but not beside others."""
        sighted = _sighted(measurements, trial.frequencies[..., -model.harmonics :]) > 0.5
        return sighted if keep.shape[-1] > 0 else torch.ones_like(sighted)

    going = torch.ones_like(none[..., 0])  # an axis that stopped stays stopped
    for _ in range(keep.shape[-1] // model.harmonics, MAX_TONES if tones is None else tones):
        left = residual_of(measurements, fit)
        going = going & (_farthest(measurements, left) > enough) if enough and keep.shape[-1] > 0 else going
        if not bool(going.any()):
            break
        active = torch.cat([keep, going[..., None].expand_as(none)], -1)
        further = _with_one_more(measurements, weighed, fit, left, active, sample_interval, False)
        if tones is None and keep.shape[-1] > 0:
            before, after = weighed.square(left), weighed.square(further[1])
            hopeful = before - after > _HOPEFUL * least_gain * before
            going = going & (hopeful if not reckon else hopeful | ~_undisturbed(measurements, left)[:, None])
            if not bool(going.any()):
                break
            active = torch.cat([keep, going[..., None].expand_as(none)], -1)
        trial, trial_weighed = robust_fit(measurements, further[0], active, model, further[1])
        if reckon:
            disturbed = ~_undisturbed(measurements, residual_of(measurements, trial))
            if bool(disturbed.any()):
                further = _with_one_more(measurements, weighed, fit, left, active, sample_interval, True)
                careful = robust_fit(measurements, further[0], active, model, further[1])
                trial, trial_weighed = _better_where(disturbed, measurements, careful, (trial, trial_weighed))
        if tones is None:
            # both fits are judged with the weights of the richer one
            before = trial_weighed.square(left)
            after = trial_weighed.square(residual_of(measurements, trial))
            spare = (measurements.known - parameters * active.sum(-1) // model.harmonics - 1).clamp(min=1.0)
            least = _F_THRESHOLD * parameters * after / spare  # an F-test
            gained = before - after > torch.maximum(least, least_gain * before)
            accepted = going & gained & _resolved(measurements, trial) & not_invented(trial)
            while bool(accepted.any()) and not bool((accepted == going).all()):
                going = accepted
                active = torch.cat([keep, accepted[..., None].expand_as(none)], -1)
                trial, trial_weighed = robust_fit(measurements, trial.frequencies, active, model)
                accepted = accepted & not_invented(trial)
            if not bool(accepted.any()):
                break
        fit, weighed = trial, trial_weighed
        keep = fit.active
    return fit if blind is None or tones is not None else with_blind_tones(measurements, weighed, fit, blind)


def _resolved(measurements: Measurements, fit: ToneFit) -> Tensor:
    """(B, 2) bool: whether all tones of an axis are far enough apart for the record to tell them from one."""
    span = measurements.moments.amax((1, 2)) - measurements.moments.amin((1, 2))
    order = torch.where(fit.active, fit.frequencies, torch.nan).sort(dim=-1).values
    return ~((order[..., 1:] - order[..., :-1]) * span[:, None, None] < _LEAST_APART).any(-1)


def significant_only(measurements: Measurements, fit: ToneFit, intervals: Tensor) -> ToneFit:
    """The fit without the tones, but the strongest of an axis, that are not significant or too small.

    Less than four standard deviations may be noise, and less than 0.01 px of offsets what interpolation and blur leave.
    Where the gain is small that is no small amplitude, and the tone stays for the verdict. With harmonics, a family
    goes as a whole.

    Args:
        measurements: What was fitted.
        fit: With its covariance.
        intervals: (M,) s, times between the frames compared.
    """
    while True:
        size = torch.where(fit.active, fit.coefficients.abs(), 0.0)
        gain = offset_gain(fit.frequencies, intervals)
        small = (size * gain < LEAST_SWING) & (gain >= LEAST_GAIN)
        tall = (size > LEAST_SIGNIFICANCE * amplitude_deviation(fit)) & ~small & fit.active
        strongest = size == size.amax(-1, keepdim=True)
        families = ((tall | strongest) & fit.active).unflatten(-1, (-1, fit.model.harmonics)).any(-1)
        keep = families.repeat_interleave(fit.model.harmonics, -1) & fit.active
        if bool((keep == fit.active).all()):
            return fit
        fit = fit_tones(measurements, fit.frequencies, keep, fit.model)


def strongest_only(fit: ToneFit) -> ToneFit:
    """The fit with the strongest tone (or family) of each axis alone."""
    harmonics = fit.model.harmonics
    size = torch.where(fit.active, fit.coefficients.abs(), 0.0).unflatten(-1, (-1, harmonics))
    family = size.sum(-1).argmax(-1)[..., None, None].expand(-1, -1, 1, harmonics)

    def pick(values: Tensor) -> Tensor:
        picked: Tensor = values.unflatten(-1, (-1, harmonics)).gather(2, family)[:, :, 0]
        return picked

    return replace(fit, coefficients=pick(fit.coefficients), frequencies=pick(fit.frequencies), active=pick(fit.active))
