"""Table of a vibration in configuration files: an axis is one number (one tone) or a list of tones."""

from typing import Self

from pydantic import Field, model_validator

from rsvib_torch.core.validation import Section, checked
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.vibration import Vibration

Tones = list[float] | list[list[float]]


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

    def to_vibration(self) -> Vibration:
        """The vibration."""
        values = {name: getattr(self, name) for name in VibrationRecord.model_fields}
        return Vibration(**values | {"camera": None if self.camera is None else Camera(**self.camera.model_dump())})
