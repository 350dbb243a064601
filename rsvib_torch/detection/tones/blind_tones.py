"""Side tones of a tone that the frames cannot see, known for what they are."""

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import fit_tones
from rsvib_torch.detection.tones.robust import residual_of, robust_fit
from rsvib_torch.detection.tones.tone_model import ToneFit

__all__ = ["with_blind_tones"]

_WEAK = 0.2  # of the largest tone along the scan: side tones of a blind one are smaller


def with_blind_tones(measurements: Measurements, weighed: Measurements, fit: ToneFit, blind: Tensor) -> ToneFit:
    """The fit with one tone of a blind frequency in place of its side tones, where that explains no less.

    Motion along the scan lets a little of a tone through to which evenly spaced frames are blind: its rows are not
    taken exactly one frame apart. It shows at its frequency plus and minus that of the motion, as tones that are not
    there; the tone itself, of which the verdict knows that it is blind, is the simpler explanation.
    """
    if fit.model.harmonics > 1 or len(blind) == 0:
        return fit
    size = torch.where(fit.active, fit.coefficients.abs(), 0.0)
    carrier = size[:, 1] > _WEAK * size[:, 1].amax(-1, keepdim=True)  # (B, K) along the scan
    swing = torch.where(carrier, fit.frequencies[:, 1], torch.nan)[:, None, None, None]  # (B, 1, 1, 1, K)
    span = (measurements.moments.amax((1, 2)) - measurements.moments.amin((1, 2)))[:, None, None, None, None]
    tone, middle = fit.frequencies[..., None, None], blind[:, None]
    sides = torch.stack([middle + swing, (middle - swing).abs()], -1)  # (B, 1, 1, F, K, 2)
    miss = ((tone[..., None] - sides).abs() * span[..., None]).nan_to_num(torch.inf).amin((-2, -1))  # (B, 2, K, F)
    weak = fit.active & (size > 0) & (size < _WEAK * size[:, 1].amax(-1)[:, None, None])
    near = (miss < 1.0) & weak[..., None]
    score = near.sum(2) + 0.5 / (1 + miss.amin(2))  # most side tones first, then the nearest
    best = score.argmax(-1)  # (B, 2)
    side = near.gather(-1, best[:, :, None, None].expand(-1, -1, near.shape[2], 1))[..., 0]  # (B, 2, K)
    suspected = side.any(-1)
    if not bool(suspected.any()):
        return fit
    place = side & (side.cumsum(-1) == 1)  # the first of them makes room

    def explained_otherwise(where: Tensor) -> tuple[Tensor, Tensor]:
        changed = where[..., None]
        frequencies = torch.where(place & changed, blind[best][..., None], fit.frequencies)
        return frequencies, fit.active & ~(side & ~place & changed)

    frequencies, active = explained_otherwise(suspected)
    other = fit_tones(weighed, frequencies, active, fit.model)
    before = weighed.square(residual_of(measurements, fit))
    after = weighed.square(residual_of(measurements, other))
    free = measurements.known - 3 * fit.active.sum(-1)
    fewer = 3 * (fit.active.sum(-1) - active.sum(-1))
    better = suspected & (after / (free + fewer).clamp(min=1.0) <= before / free.clamp(min=1.0))
    if not bool(better.any()):
        return fit
    frequencies, active = explained_otherwise(better)
    return robust_fit(measurements, frequencies, active, fit.model)[0]
