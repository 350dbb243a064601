"""How many tones: added one by one, strongest first, as long as the data ask for them."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.blind_tones import with_blind_tones
from rsvib_torch.detection.tones.candidates import Candidates, sighted
from rsvib_torch.detection.tones.fit import fit_tones
from rsvib_torch.detection.tones.inversion import amplitude_deviation, offset_gain
from rsvib_torch.detection.tones.robust import of_each, residual_of, robust_fit, typical_size
from rsvib_torch.detection.tones.tone_model import MotionModel, ToneFit

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
_F_THRESHOLD = 14.0  # of chi-square gained per parameter over noise: chance over a whole frequency grid stays below it
_LEAST_GAIN = 0.2  # of the residual chi-square that a further tone must explain
# of what a tone has to explain: by itself in the periodogram, and before outliers are weighed anew; with less it need
# not be fitted at all, or not to the end
_PROMISING, _HOPEFUL = 0.35, 0.5
_LEAST_APART = 0.7  # of one over the record: tones nearer than this are one that the noise has split
_NEARLY_ALL, _LITTLE = 0.9, 0.05  # of the rows, and of their typical displacement: what is left when none pulls


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


@dataclass(frozen=True, eq=False)
class _Search:
    """What a search for tones goes by.

    Attributes:
        measurements: The displacements.
        sample_interval: Seconds between neighbouring rows or bands.
        tones: Of each axis; None to choose their number.
        model: What is fitted beside the tones.
        least_gain: Share of the residual that a further tone must explain.
        reckon: With stretches of outliers.
    """

    measurements: Measurements
    sample_interval: float
    tones: int | None
    model: MotionModel
    least_gain: float
    reckon: bool

    def one_more(self, keep: Tensor, going: Tensor) -> Tensor:
        """Tones to keep (B, 2, K), and one more (or family) of the axes (B, 2) that go on."""
        return torch.cat([keep, going[..., None].expand(-1, -1, self.model.harmonics)], -1)

    def asked(self, before: Tensor, after: Tensor, active: Tensor) -> Tensor:
        """(B, 2) weighted squares, of those before, that the last of the active tones has to explain: an F-test."""
        parameters = 2 * self.model.harmonics + 1
        spare = self.measurements.known - parameters * active.sum(-1) // self.model.harmonics - 1
        noise = after / spare.clamp(min=1.0)
        return torch.maximum(_F_THRESHOLD * parameters * noise, self.least_gain * before)

    def further(
        self, keep: Tensor, going: Tensor, fit: ToneFit, weighed: Measurements, left: Tensor
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """The axes (B, 2) on which one more tone is worth being fitted to the end, and ``Candidates.best``."""
        candidates = self.candidates(weighed, left, reckon=False)
        if self.tones is not None or keep.shape[-1] == 0:
            return going, candidates.best(fit, self.one_more(keep, going))
        before, one_more = weighed.square(left), self.one_more(keep, torch.ones_like(going))
        pulled = torch.zeros_like(going)
        if self.reckon:
            pulled = ~_undisturbed(self.measurements, left)[:, None]

        def hopeful(explained: Tensor, share: float) -> Tensor:
            return (explained > share * self.asked(before, before - explained, one_more)) | pulled

        going = going & hopeful(candidates.explained, _PROMISING)
        if not bool(going.any()):
            return going, (fit.frequencies, left)
        best = candidates.best(fit, self.one_more(keep, going))
        return going & hopeful(before - weighed.square(best[1]), _HOPEFUL), best

    def candidates(self, weighed: Measurements, left: Tensor, *, reckon: bool) -> Candidates:
        """Candidates for one more tone to explain what a fit has left."""
        return Candidates.of(
            self.measurements, weighed, left, self.sample_interval, self.model.harmonics, reckon=reckon
        )

    def fitted(
        self,
        keep: Tensor,
        going: Tensor,
        fit: ToneFit,
        weighed: Measurements,
        left: Tensor,
        best: tuple[Tensor, Tensor],
    ) -> tuple[ToneFit, Measurements]:
        """A fit with one more tone of the axes that go on, and its weights."""
        active = self.one_more(keep, going)
        trial = robust_fit(self.measurements, best[0], active, self.model, best[1])
        if not self.reckon:
            return trial
        disturbed = ~_undisturbed(self.measurements, residual_of(self.measurements, trial[0]))
        if not bool(disturbed.any()):
            return trial
        frequencies, residual = self.candidates(weighed, left, reckon=True).best(fit, active)
        careful = robust_fit(self.measurements, frequencies, active, self.model, residual)
        return _better_where(disturbed, self.measurements, careful, trial)


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
    search = _Search(measurements, sample_interval, tones, model, least_gain, start is None)
    none = measurements.moments.new_zeros(len(measurements.moments), 2, model.harmonics, dtype=torch.bool)
    if start is None:
        keep, (fit, weighed) = none[..., :0], robust_fit(measurements, none.double(), none, model)
    else:
        keep, given = start.active, residual_of(measurements, start)
        fit, weighed = robust_fit(measurements, start.frequencies, keep, model, given)

    def not_invented(trial: ToneFit) -> Tensor:
        """(B, 2) whether the last tone may stand: what the record hardly sees may be refused, but not beside others."""
        shown = sighted(measurements, trial.frequencies[..., -model.harmonics :]) > 0.5
        return shown if keep.shape[-1] > 0 else torch.ones_like(shown)

    going = torch.ones_like(none[..., 0])  # an axis that stopped stays stopped
    for _ in range(keep.shape[-1] // model.harmonics, MAX_TONES if tones is None else tones):
        left = residual_of(measurements, fit)
        if enough and keep.shape[-1] > 0:
            going = going & (_farthest(measurements, left) > enough)
        if bool(going.any()):
            going, best = search.further(keep, going, fit, weighed, left)
        if not bool(going.any()):
            break
        trial, trial_weighed = search.fitted(keep, going, fit, weighed, left, best)
        if tones is None:
            # both fits are judged with the weights of the richer one
            before = trial_weighed.square(left)
            after = trial_weighed.square(residual_of(measurements, trial))
            gained = before - after > search.asked(before, after, search.one_more(keep, going))
            accepted = going & gained & _resolved(measurements, trial) & not_invented(trial)
            while bool(accepted.any()) and not bool((accepted == going).all()):
                going = accepted
                active = search.one_more(keep, going)
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
