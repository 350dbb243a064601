"""What is kept of every window: JSON that brings its detection back."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from rsvib_torch.core.validation import Section
from rsvib_torch.detection import DetectionResult
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.stacks.windows import Window

__all__ = ["DetectedWindow", "DetectionRecord", "WindowRecord", "detection_record", "plain"]

Numbers = list[float | None]


@dataclass(frozen=True, eq=False)
class DetectedWindow:
    """A detection without its offset curve: all that restoration needs.

    Attributes:
        vibration: In image axes; time begins with the window's first frame.
        std: Its standard deviations.
        gain: As in ``DetectionResult``.
        residual: As in ``DetectionResult``.
        reliable: As in ``DetectionResult``.
        reasons: As in ``DetectionResult``.
    """

    vibration: Vibration
    std: VibrationStd
    gain: Tensor
    residual: Tensor
    reliable: Tensor
    reasons: tuple[Any, ...]

    @classmethod
    def of(cls, result: DetectionResult) -> "DetectedWindow":
        """The same without the curve."""
        return cls(*(getattr(result, name) for name in cls.__dataclass_fields__))


def plain(values: Tensor) -> Any:
    """Numbers as JSON knows them: None stands for what is not finite."""

    def finite(value: Any) -> Any:
        if isinstance(value, list):
            return [finite(item) for item in value]
        return value if not isinstance(value, float) or math.isfinite(value) else None

    return finite(values.detach().cpu().tolist())


def _tensor(values: list[Any], unknown: float) -> Tensor:
    def known(value: Any) -> Any:
        return [known(item) for item in value] if isinstance(value, list) else unknown if value is None else value

    return torch.tensor(known(values), dtype=torch.float64)


class _VibrationRecord(Section):
    amplitude: list[list[float]]
    frequency: list[list[float]]
    phase: list[list[float]]
    image_motion: list[float]
    image_acceleration: list[float]


class _StdRecord(Section):
    amplitude: list[Numbers]
    frequency: list[Numbers]
    period: list[Numbers]
    phase: list[Numbers]
    image_motion: Numbers
    image_acceleration: Numbers


class DetectionRecord(Section):
    """A detection as JSON; lists are ordered (x, y), null stands for what is not finite."""

    vibration: _VibrationRecord
    std: _StdRecord
    gain: list[Numbers]
    residual: Numbers
    reliable: list[bool] = Field(min_length=2, max_length=2)
    reasons: list[list[str]] = Field(min_length=2, max_length=2)

    def detected(self) -> DetectedWindow:
        """The detection."""
        std = VibrationStd(*(_tensor(getattr(self.std, name), math.inf) for name in VibrationStd.__dataclass_fields__))
        vibration = Vibration(*(getattr(self.vibration, name) for name in Vibration.__dataclass_fields__))
        if any(t.shape != vibration.amplitude.shape for t in (std.amplitude, std.frequency, std.phase)):
            raise ValueError("std must have as many tones as the vibration")
        return DetectedWindow(
            vibration,
            std,
            _tensor(self.gain, math.nan),
            _tensor(self.residual, math.nan),
            torch.tensor(self.reliable),
            tuple(tuple(axis) for axis in self.reasons),
        )


def detection_record(detected: DetectionResult | DetectedWindow) -> dict[str, Any]:
    """The content of a ``DetectionRecord``."""
    return {
        "vibration": {n: plain(getattr(detected.vibration, n)) for n in _VibrationRecord.model_fields},
        "std": {n: plain(getattr(detected.std, n)) for n in _StdRecord.model_fields},
        "gain": plain(detected.gain),
        "residual": plain(detected.residual),
        "reliable": detected.reliable.tolist(),
        "reasons": [list(axis) for axis in detected.reasons],
    }


class WindowRecord(Section):
    """What became of one window.

    Attributes:
        window: Number of the window.
        first: Its first frame.
        last: Its last frame.
        start_time: Exposure start of its first row in seconds, where its time begins.
        written: Number of frames written.
        frames: What they are.
        detection: What was detected; None where nothing could be.
        left_alone: A sentence for each axis whose vibration was not undone.
        outcome: Whether restoration helps, as in ``RestorationVerdict.overall``; None where it could not be told.
        summary: The same in words.
        error: Why nothing was detected or restored.
        bad_frames: Frames that could not be used, with the reason.
    """

    window: int
    first: int
    last: int
    start_time: float
    written: int = Field(ge=0)
    frames: Literal["restored", "as taken"]
    detection: DetectionRecord | None
    left_alone: list[str]
    outcome: str | None
    summary: str | None
    error: str | None
    bad_frames: dict[str, str]

    @staticmethod
    def content(window: Window, start_time: float, **rest: Any) -> dict[str, Any]:
        """The content of a record."""
        return {"window": window.index, "first": window.first, "last": window.last, "start_time": start_time, **rest}
