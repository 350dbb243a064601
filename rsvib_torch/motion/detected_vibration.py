"""A detected vibration with its uncertainty and verdict: what restoration needs of a detection."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from rsvib_torch.core.presentation import JudgedResult, verdict_table
from rsvib_torch.core.text import wrapped
from rsvib_torch.motion.vibration import Vibration, VibrationStd, image_motion_line, tone_head, tone_rows

__all__ = ["Detected", "DetectedVibration", "detection_summary"]


@runtime_checkable
class Detected(Protocol):
    """A vibration in image axes with its standard deviations and a verdict; what restoration needs of a detection."""

    @property
    def vibration(self) -> Vibration:
        """The vibration, of batch shape () or (B,)."""

    @property
    def std(self) -> Any:
        """Standard deviations ``amplitude``, ``frequency``, ``phase``, ``image_motion``, shaped as the vibration's."""

    @property
    def reliable(self) -> Any:
        """(..., A) verdict for each axis."""

    @property
    def reasons(self) -> tuple[Any, ...]:
        """Texts of the reasons against each axis; a tuple of those for a batch."""


@runtime_checkable
class Detection(Detected, Protocol):
    """The attributes of ``DetectedVibration``; a ``DetectionResult`` that is not a batch has them as well."""

    @property
    def gain(self) -> Tensor: ...
    @property
    def residual(self) -> Tensor: ...
    @property
    def findings(self) -> tuple[Any, ...]: ...
    @property
    def assumptions(self) -> tuple[Any, ...]: ...


def detection_summary(detection: Detection) -> str:
    """Tones of each axis with standard deviations, then the verdict; of a batch, a table with one row per axis."""
    vibration, std = detection.vibration, detection.std
    rows = [cells for _, cells in tone_rows(vibration, std)]
    head = tone_head(axes=vibration.num_axes)
    table, *verdict = verdict_table(head, rows, vibration.batch_shape, detection.reliable, detection.reasons)
    if not vibration.batch_shape:
        verdict += [wrapped(f"assumed: {text}") for text in detection.assumptions]
    return "\n".join([table, *image_motion_line(vibration, std), *verdict])


@dataclass(frozen=True, eq=False, repr=False)
class DetectedVibration(JudgedResult):
    """A detection without its offset curve: everything that restoration needs.

    Attributes:
        vibration: The vibration in image axes.
        std: Standard deviations of its parameters, infinite where unknown.
        gain: (2, K) offset gain of Eq. (7) from displacement to offset.
        residual: (2,) px, mean absolute difference of measured and fitted offsets.
        reliable: (2,) bool, verdict for each axis (x, y).
        findings: Each ``Reason`` against each axis; ``reasons`` has their texts.
        assumptions: What the frames cannot contradict, one sentence for each.
    """

    vibration: Vibration
    std: VibrationStd
    gain: Tensor
    residual: Tensor
    reliable: Tensor
    findings: tuple[Any, ...]
    assumptions: tuple[Any, ...] = ()

    def summary(self) -> str:
        """Tones of each axis with standard deviations, then the verdict."""
        return detection_summary(self)
