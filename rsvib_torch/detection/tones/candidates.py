"""What a further tone may be: peaks of the periodogram of what a fit leaves."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import fit_roughly
from rsvib_torch.detection.tones.inversion import BLIND
from rsvib_torch.detection.tones.periodogram import MAJORITY, strongest_frequencies
from rsvib_torch.detection.tones.tone_model import ToneFit, tone_response

__all__ = ["Candidates", "sighted"]

_NUMBER = 4  # peaks of the periodogram that are tried: outliers may raise a wrong one
_LEFT_OUT = 0.35  # of the record, the length of a stretch that is left out
_STRETCHES = 7  # that are left out one at a time, each overlapping the next by half
_FEW = 2  # candidates for each stretch
_ABSOLUTE_STEPS = 3  # rounds of reweighting towards least absolute residuals
_FADED = 0.1  # of its amplitude is all that an exposure leaves of a tone


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates for one more tone (or family) of each axis.

    Attributes:
        measurements: Of B stacks.
        frequencies: (B C, 2, H) Hz, C candidates of each stack.
        parts: (B C) the measurements, with the weights that each was found with.
        explained: (B, 2) weighted squares that the best one explains by itself.
        reckon: Whether stretches of rows were left out.
    """

    measurements: Measurements
    frequencies: Tensor
    parts: Measurements
    explained: Tensor
    reckon: bool

    @classmethod
    def of(
        cls,
        measurements: Measurements,
        weighed: Measurements,
        left: Tensor,
        sample_interval: float,
        harmonics: int,
        *,
        reckon: bool,
    ) -> "Candidates":
        """Peaks of the periodogram of what a fit has left.

        Args:
            measurements: The displacements.
            weighed: The same with the weights of that fit.
            left: (B, N, G, 2) px.
            sample_interval: Seconds between neighbouring rows or bands.
            harmonics: Multiples that every tone comes with.
            reckon: With clouds and with things that move by themselves, which cover stretches of rows: every stretch
                of the record is left out once, and where all that pulls the fit away is, the others fall in line.
        """
        unexplained = replace(measurements, displacements=left)
        parts, weights = measurements, weighed.weights[:, None]
        if reckon:
            counts = _stretches(measurements)
            parts = measurements.repeated(len(counts)).only(counts.repeat(len(measurements.moments), 1))
            without = counts[1:, :, None] * measurements.weights[:, None]
            weights = torch.cat([weights, without], 1)
        number = _FEW if reckon else _NUMBER
        peaks, explained = strongest_frequencies(unexplained, sample_interval, harmonics, number, weights)
        multiples = torch.arange(1, harmonics + 1, dtype=torch.float64, device=peaks.device)
        frequencies = (peaks.flatten(0, 1)[..., None] * multiples).transpose(1, 2).flatten(0, 1)
        return cls(measurements, frequencies, parts.repeated(peaks.shape[-1]), explained[:, 0], reckon)

    def best(self, before: ToneFit, active: Tensor) -> tuple[Tensor, Tensor]:
        """The candidate that, with the tones of a fit, leaves the majority of rows least, each axis for itself.

        Args:
            before: The fit.
            active: (B, 2, K) bool, its tones and the further one.

        Returns:
            Frequencies (B, 2, K) and what a first fit with them leaves, (B, N, G, 2).
        """
        model, harmonics = before.model, before.model.harmonics
        count = len(self.frequencies) // len(self.measurements.moments)
        known = before.frequencies[..., : active.shape[-1] - harmonics].repeat_interleave(count, 0)
        several, which = self.measurements.repeated(count), active.repeat_interleave(count, 0)
        rough, residual = fit_roughly(self.parts, torch.cat([known, self.frequencies], -1), which, model)
        size = several.sizes(residual).nanquantile(MAJORITY, dim=1).nan_to_num(0.0).unflatten(0, (-1, count))
        shown = sighted(several, rough.frequencies[..., -harmonics:]).unflatten(0, (-1, count))
        best = ((size.amax(1, keepdim=True) - size) * shown).argmax(1)

        def chosen(values: Tensor, axis: int) -> Tensor:
            each = values.unflatten(0, (-1, count)).movedim(axis + 1, 2)  # (B, C, 2, ...)
            place = best.reshape(-1, 1, 2, *(1,) * (each.ndim - 3)).expand(-1, 1, -1, *each.shape[3:])
            picked: Tensor = each.gather(1, place)[:, 0].movedim(1, axis)
            return picked

        frequencies, residual = chosen(rough.frequencies, 1), chosen(residual, 3)
        for _ in range(_ABSOLUTE_STEPS if self.reckon else 0):
            nearer = self.measurements.for_least_absolute(residual)
            nearest, residual = fit_roughly(nearer, frequencies, active, model)
            frequencies = nearest.frequencies
        return frequencies, residual


def _stretches(measurements: Measurements) -> Tensor:
    """(S, N) bool, rows that count: all of them first, then all but a stretch, one stretch after the other."""
    rows = measurements.moments.shape[1]
    place = (torch.arange(rows, dtype=torch.float64, device=measurements.moments.device) + 0.5) / rows
    first = torch.linspace(0, 1 - _LEFT_OUT, _STRETCHES, dtype=torch.float64, device=place.device)[:, None]
    counts = (place < first) | (place > first + _LEFT_OUT)
    return torch.cat([torch.ones_like(counts[:1]), counts])


def sighted(measurements: Measurements, frequencies: Tensor) -> Tensor:
    """(B, 2) 0 for frequencies (B, 2, H) that the record is blind to, 1 where the gain is large.

    The exposure fades tones near multiples of 1/T_e: what long exposures do to fine detail is not to be taken for one.
    """
    response = tone_response(measurements, frequencies)
    gain = 4 * response.abs().square().mean((1, 2)).amax(-1)
    shown = torch.sinc(frequencies * measurements.exposure_time).abs().amax(-1) > _FADED
    return gain / (gain + BLIND**2) * shown
