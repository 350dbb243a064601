"""What detection returns: vibration, standard deviations, verdict and the curve it stands on."""

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.registration import OffsetCurve

__all__ = ["DetectionResult", "OtherMotion", "stacked"]


@dataclass(frozen=True, eq=False)
class OtherMotion:
    """What rows tell that no vibration explains, per axis in px, with the part that noise explains taken out.

    Attributes:
        unexplained: (..., 2) rms displacement that the fit leaves.
        slant: (..., 2) rms difference between what the right and the left half of the rows miss.
    """

    unexplained: Tensor
    slant: Tensor

    def __getitem__(self, index: int) -> "OtherMotion":
        """The part of one stack out of a batch."""
        return OtherMotion(self.unexplained[index], self.slant[index])


@dataclass(frozen=True, eq=False)
class DetectionResult:
    """A detected vibration and how far it can be trusted. A batch of stacks, or of windows, leads all tensors.

    Attributes:
        vibration: The vibration in image axes; an axis without a significant tone has amplitude 0.
        std: Standard deviations of its parameters.
        offsets: The measured curve.
        fitted: (..., P, N, 2) px, the offsets simulated again from the result at the same bands.
        gain: (..., 2, K) gain of Eq. (7) from displacement to offset; near 0 the tone is nearly blind.
        residual: (..., 2) px, mean absolute difference of measured and fitted offsets.
        reliable: (..., 2) bool, verdict for each axis.
        reasons: Why not, for each axis (x, y); a tuple of those for a batch.
    """

    vibration: Vibration
    std: VibrationStd
    offsets: OffsetCurve
    fitted: Tensor
    gain: Tensor
    residual: Tensor
    reliable: Tensor
    reasons: tuple[Any, ...]

    def __getitem__(self, index: int) -> "DetectionResult":
        """The result of one stack out of a batch."""
        return DetectionResult(
            self.vibration[index],
            self.std[index],
            self.offsets[index],
            self.fitted[index],
            self.gain[index],
            self.residual[index],
            self.reliable[index],
            self.reasons[index],
        )


def stacked(results: list[DetectionResult]) -> DetectionResult:
    """Results of the windows of a batch of stacks as one: (B, number of windows, ...).

    Tones that only some windows have are padded with amplitude 0.
    """
    tones = max(result.gain.shape[-1] for result in results)

    def joined(values: list[Tensor]) -> Tensor:
        return torch.stack(values, dim=1)

    def padded(values: list[Tensor]) -> Tensor:
        return joined([torch.nn.functional.pad(v, (0, tones - v.shape[-1])) for v in values])

    def each(part: str, name: str) -> Tensor:
        values = [getattr(getattr(result, part), name) for result in results]
        return joined(values) if name.startswith("image") else padded(values)

    curves = [result.offsets for result in results]
    batch = curves[0].offsets.shape[0]
    return DetectionResult(
        vibration=Vibration(*(each("vibration", f.name) for f in fields(Vibration))),
        std=VibrationStd(*(each("std", f.name) for f in fields(VibrationStd))),
        offsets=OffsetCurve(
            curves[0].pairs,
            curves[0].rows,
            joined([curve.times.expand(batch, -1, -1) for curve in curves]),
            joined([curve.later_times.expand(batch, -1, -1) for curve in curves]),
            joined([curve.offsets for curve in curves]),
            joined([curve.quality for curve in curves]),
            curves[0].heights,
        ),
        fitted=joined([result.fitted for result in results]),
        gain=padded([result.gain for result in results]),
        residual=joined([result.residual for result in results]),
        reliable=joined([result.reliable for result in results]),
        reasons=tuple(tuple(result.reasons[index] for result in results) for index in range(batch)),
    )
