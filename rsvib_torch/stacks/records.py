"""What is stored of every window of a stack."""

from typing import Any, Literal

from pydantic import Field

from rsvib_torch.core.validation import Section
from rsvib_torch.io.schema import DetectionRecord
from rsvib_torch.stacks.windows import Window

__all__ = ["WindowRecord"]


class WindowRecord(Section):
    """Result of one window.

    Attributes:
        window: Number of the window.
        first: Its first frame.
        last: Its last frame.
        start_time: Exposure start of its first row in seconds, the time origin of its detection.
        written: Number of frames written.
        frames: Whether the frames written are restored, or as taken.
        detection: The detection; None if it failed.
        left_alone: A sentence for each axis that was not restored.
        outcome: ``RestorationVerdict.overall``; None if the frames could not be compared.
        summary: ``RestorationVerdict.summary``.
        error: Why detection or restoration failed.
        bad_frames: Index of each frame that could not be used, with the reason.
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
