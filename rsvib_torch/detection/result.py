"""What detection returns: vibration, standard deviations, verdict and the curve it stands on."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from rsvib_torch.registration import OffsetCurve
from rsvib_torch.vibration import Vibration

__all__ = ["DetectionResult", "VibrationStd"]


@dataclass(frozen=True, eq=False)
class VibrationStd:
    """Standard deviations in the layout of ``Vibration``: px, Hz, s, rad (..., 2, K) and px/s (..., 2)."""

    amplitude: Tensor
    frequency: Tensor
    period: Tensor
    phase: Tensor
    image_motion: Tensor

    def __getitem__(self, index: int) -> "VibrationStd":
        """The standard deviations of one stack out of a batch."""
        return VibrationStd(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class DetectionResult:
    """A detected vibration and how far it can be trusted. A batch of stacks leads all tensors with B.

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
