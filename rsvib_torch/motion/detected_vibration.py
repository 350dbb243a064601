"""A detected vibration with its uncertainty and verdict: what restoration needs of a detection."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from rsvib_torch.core.presentation import Result, verdict_table
from rsvib_torch.core.text import wrapped
from rsvib_torch.motion.vibration import Vibration, VibrationStd, image_motion_line, tone_head, tone_rows

__all__ = ["DetectedVibration", "detection_summary"]


@runtime_checkable
class Detection(Protocol):
    """The attributes of ``DetectedVibration``; a ``DetectionResult`` that is not a batch has them as well."""

    @property
    def vibration(self) -> Vibration: ...
    @property
    def std(self) -> VibrationStd: ...
    @property
    def gain(self) -> Tensor: ...
    @property
    def residual(self) -> Tensor: ...
    @property
    def reliable(self) -> Tensor: ...
    @property
    def reasons(self) -> tuple[Any, ...]: ...
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
class DetectedVibration(Result):
    """A detection without its offset curve: everything that restoration needs.

    Attributes:
        vibration: The vibration in image axes.
        std: Standard deviations of its parameters, infinite where unknown.
        gain: (2, K) offset gain of Eq. (7) from displacement to offset.
        residual: (2,) px, mean absolute difference of measured and fitted offsets.
        reliable: (2,) bool, verdict for each axis (x, y).
        reasons: Why an axis is not reliable, for each axis.
        assumptions: What the frames cannot contradict, one sentence for each.
    """

    vibration: Vibration
    std: VibrationStd
    gain: Tensor
    residual: Tensor
    reliable: Tensor
    reasons: tuple[Any, ...]
    assumptions: tuple[Any, ...] = ()

    def summary(self) -> str:
        """Tones of each axis with standard deviations, then the verdict."""
        return detection_summary(self)
