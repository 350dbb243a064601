"""JSON schema of timing, vibration, standard deviations and detections, shared by all files that the package writes.

``vibration.json``, ``manifest.json`` and the journal of a stack, and the TOML configuration use these records. Lists
are ordered (x, y), with one list of tones for each axis; a motion with roll and zoom has three or four axes. null
stands for a value that is unknown or not finite.
"""

import math
from typing import Annotated, Any, Literal, Self

import torch
from pydantic import AliasChoices, Field, PlainSerializer, PlainValidator, model_validator
from torch import Tensor

from rsvib_torch.core.presentation import plain_values
from rsvib_torch.core.reason import Reason, read_findings
from rsvib_torch.core.validation import Section, checked
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd

__all__ = [
    "DetectionRecord",
    "ReasonRecord",
    "StdRecord",
    "TimingRecord",
    "VibrationRecord",
    "check_same_timing",
    "detection_to_json",
]

Tones = list[float] | list[list[float]]
Numbers = list[float | None]
ReasonRecord = Annotated[Reason, PlainValidator(read_findings), PlainSerializer(Reason.to_dict)]


def _to_tensor(values: Any, missing: float) -> Tensor:
    """Nested lists as a float64 tensor with ``missing`` in place of None."""

    def filled(value: Any) -> Any:
        return [filled(part) for part in value] if isinstance(value, list) else missing if value is None else value

    return torch.tensor(filled(values), dtype=torch.float64, device="cpu")


class TimingRecord(Section):
    """Fields of ``SensorTiming``, which checks their values."""

    row_time: float
    exposure_rows: float
    frame_rows: float
    scan_axis: Literal["y", "x"]
    readout_direction: Literal["forward", "reverse"]
    frame_start_times: list[float] | None

    @model_validator(mode="after")
    def _check(self) -> Self:
        checked(self.to_timing)
        return self

    @classmethod
    def from_timing(cls, timing: SensorTiming) -> Self:
        """The record of a timing."""
        return cls(**timing.to_dict())

    def to_timing(self) -> SensorTiming:
        """The timing."""
        return SensorTiming(**{name: getattr(self, name) for name in TimingRecord.model_fields})


class CameraRecord(Section):
    """Fields of ``Camera``, which checks their values."""

    focal_length: float
    principal_point: list[float] = Field(default_factory=lambda: [0.0] * 2, min_length=2, max_length=2)
    distortion: list[float] = Field(default_factory=lambda: [0.0] * 5, min_length=5, max_length=5)


class VibrationRecord(Section):
    """Fields of ``Vibration``, which checks their values.

    An axis is one number (one tone) or a list of tones.
    """

    amplitude: Tones
    frequency: Tones
    phase: Tones
    image_motion: list[float]
    image_acceleration: list[float] = Field(default_factory=lambda: [0.0, 0.0])
    image_shift: list[float] = Field(default_factory=lambda: [0.0, 0.0])
    camera: CameraRecord | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in ("amplitude", "frequency", "phase"):
            rows = getattr(self, name)
            if not 2 <= len(rows) <= 4 or len({len(row) if isinstance(row, list) else 1 for row in rows}) != 1:
                raise ValueError(
                    f"{name} must be two numbers (x, y), or two lists of the same length (three with roll, four with "
                    f"zoom), got {rows}"
                )
        checked(self.to_vibration)
        return self

    @classmethod
    def from_vibration(cls, vibration: Vibration) -> Self:
        """The record of one vibration (not a batch)."""
        return cls(**{name: plain_values(getattr(vibration, name)) for name in VibrationRecord.model_fields})

    def to_vibration(self) -> Vibration:
        """The vibration."""
        values = {name: getattr(self, name) for name in VibrationRecord.model_fields}
        return Vibration(**values | {"camera": None if self.camera is None else Camera(**self.camera.model_dump())})


class StdRecord(Section):
    """Fields of ``VibrationStd``; null where a standard deviation is unknown."""

    amplitude: list[Numbers]
    frequency: list[Numbers]
    period: list[Numbers]
    phase: list[Numbers]
    image_motion: Numbers
    image_acceleration: Numbers = Field(default_factory=lambda: list[float | None]([None, None]))
    displacement: Numbers | None = None

    @classmethod
    def from_std(cls, std: VibrationStd) -> Self:
        """The record of the standard deviations of one vibration."""
        values = {name: getattr(std, name) for name in cls.model_fields}
        return cls(**{name: plain_values(value) for name, value in values.items() if value is not None})

    def to_std(self) -> VibrationStd:
        """The standard deviations, infinite where unknown."""
        values = {name: getattr(self, name) for name in StdRecord.model_fields}
        return VibrationStd(
            **{name: _to_tensor(value, math.inf) for name, value in values.items() if value is not None}
        )


class DetectionRecord(Section):
    """Fields of ``DetectedVibration``."""

    vibration: VibrationRecord
    std: StdRecord
    gain: list[Numbers]
    residual: Numbers
    reliable: list[bool] = Field(min_length=2, max_length=4)
    # files of earlier versions have the texts of reasons
    findings: list[list[ReasonRecord]] = Field(
        validation_alias=AliasChoices("findings", "reasons"), min_length=2, max_length=4
    )
    assumptions: list[str] = Field(default_factory=list[str])

    @classmethod
    def from_detection(cls, detection: DetectedVibration, **fields: Any) -> Self:
        """The record of a detection (not a batch); ``fields`` are those of a derived record."""
        return cls(
            vibration=VibrationRecord.from_vibration(detection.vibration),
            std=StdRecord.from_std(detection.std),
            gain=plain_values(detection.gain),
            residual=plain_values(detection.residual),
            reliable=detection.reliable.tolist(),
            findings=[list(axis) for axis in detection.findings],
            assumptions=list(detection.assumptions),
            **fields,
        )

    def to_detection(self) -> DetectedVibration:
        """The detection.

        Raises:
            ValueError: If vibration and standard deviations have different numbers of tones.
        """
        vibration, std = self.vibration.to_vibration(), self.std.to_std()
        if any(values.shape != vibration.amplitude.shape for values in (std.amplitude, std.frequency, std.phase)):
            raise ValueError("std must have as many tones as the vibration")
        if not len(self.reliable) == len(self.findings) == vibration.num_axes:
            raise ValueError(f"reliable and findings must have {vibration.num_axes} entries, one for each axis")
        return DetectedVibration(
            vibration,
            std,
            _to_tensor(self.gain, math.nan),
            _to_tensor(self.residual, math.nan),
            torch.tensor(self.reliable, device="cpu"),
            tuple(tuple(axis) for axis in self.findings),
            tuple(self.assumptions),
        )


def detection_to_json(detection: DetectedVibration | None) -> dict[str, Any] | None:
    """Content of the ``DetectionRecord`` of a detection; None for None."""
    return None if detection is None else DetectionRecord.from_detection(detection).model_dump()


def check_same_timing(source: str, stored: TimingRecord, timing: SensorTiming) -> None:
    """Check that a stored detection was made with the timing of the frames that are to be restored.

    Args:
        source: File of the detection, for the message.
        stored: Timing in that file.
        timing: Timing of the frames.

    Raises:
        ValueError: If they differ by more than rounding.
    """
    theirs, ours = stored.model_dump(), TimingRecord.from_timing(timing).model_dump()
    different = [name for name in ours if not _equal(theirs[name], ours[name])]
    if different:
        values = ", ".join(f"{name}={theirs[name]!r} (here {ours[name]!r})" for name in different)
        raise ValueError(
            f"{source}: the vibration was detected with another timing: {values}; detect it again, or correct [sensor]"
        )


def _equal(first: Any, second: Any) -> bool:
    """Whether two values of a record are equal up to rounding."""
    if isinstance(first, list) and isinstance(second, list):
        return len(first) == len(second) and all(map(_equal, first, second))
    if isinstance(first, float) and isinstance(second, float):
        return math.isclose(first, second, rel_tol=1e-9)
    return bool(first == second)
