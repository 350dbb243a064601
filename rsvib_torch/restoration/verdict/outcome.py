"""What is said of a restoration, without knowing the truth."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.motion.timing import SensorTiming

__all__ = ["OUTCOMES", "Outcome", "RestorationVerdict", "RestorationWarning", "TooLittleInCommonError"]

Outcome = Literal["helps", "unknown", "partly", "worse"]
OUTCOMES: tuple[Outcome, ...] = ("helps", "unknown", "partly", "worse")  # in order of concern


class RestorationWarning(UserWarning):
    """A restored frame may be worse than the raw one, or a part of the vibration was left alone."""


class TooLittleInCommonError(ValueError):
    """Two frames show too little of the same scene to be compared."""


@dataclass(frozen=True, eq=False)
class RestorationVerdict:
    """What P pairs of frames of one scene say about a restoration.

    Displacements and levels are root-mean-square values over the pixels that both frames show.

    Attributes:
        before: (P,) difference of the raw frames, moved onto each other by whole pixels, full scale 1.
        after: (P,) difference of the restored frames; NaN for one image restored jointly from all.
        misfit_before: (P, 2) px, how far the raw frames lie apart, axes (x, y).
        misfit_after: (P, 2) px, how far a raw frame lies from what the other one, restored and blurred again by the
            motion of the first, says it should show.
        resolution: (P, 2) px, misfits below this are not told from zero.
        noise: (P,) standard deviation of the noise of the raw frames.
        chi_square: (P,) mean square of that frame's difference from its prediction, over the variance of the noise:
            1 ... 2 where motion, blur and noise explain the frame.
        predicted_gain: (P,) dB, estimated PSNR of the restored frames less that of the raw ones.
        outcome: For each pair: ``"helps"``; ``"partly"``: closer together, but the vibration explains a part only;
            ``"worse"``; ``"unknown"``: the frames do not show this vibration (too small, or a blind frequency).
        reasons: Why, for each pair; empty where it helps.
    """

    before: Tensor
    after: Tensor
    misfit_before: Tensor
    misfit_after: Tensor
    resolution: Tensor
    noise: Tensor
    chi_square: Tensor
    predicted_gain: Tensor
    outcome: tuple[Outcome, ...]
    reasons: tuple[str, ...]

    @property
    def helped(self) -> Tensor:
        """(P,) whether restored is better than raw, as far as the pair tells."""
        return torch.tensor([outcome == "helps" for outcome in self.outcome], device=self.before.device)

    @property
    def overall(self) -> Outcome:
        """The outcome of greatest concern over all pairs."""
        return max(self.outcome, key=OUTCOMES.index)

    @property
    def summary(self) -> str:
        """The verdict in one line."""
        worst = self.outcome.index(self.overall)
        gain = float(self.predicted_gain.nanmean())
        counted = f" ({self.outcome.count(self.overall)} of {len(self.outcome)} pairs)" if len(self.outcome) > 1 else ""
        words = {
            "helps": f"restored frames agree; estimated gain {gain:+.1f} dB",
            "unknown": f"whether restoration helps cannot be told{counted}: {self.reasons[worst]}",
            "partly": f"restoration helps in part only{counted}: {self.reasons[worst]}",
            "worse": f"restored is no better than raw{counted}: {self.reasons[worst]}",
        }
        return words[self.overall]

    def in_image_axes(self, timing: SensorTiming) -> "RestorationVerdict":
        """The verdict on frames in row order, with axes named as in the image."""
        if timing.scan_axis == -2:
            return self
        swapped = {name: getattr(self, name).flip(-1) for name in ("misfit_before", "misfit_after", "resolution")}
        other = {"x: ": "y: ", "y: ": "x: "}
        reasons = tuple(
            "; ".join(other.get(part[:3], part[:3]) + part[3:] for part in why.split("; ")) for why in self.reasons
        )
        return replace(self, reasons=reasons, **swapped)
