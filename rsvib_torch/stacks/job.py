"""What is done with every window, wherever it is done."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.detection import DetectionResult, detect_vibration
from rsvib_torch.io.files import open_stack
from rsvib_torch.io.formats import FrameReader
from rsvib_torch.io.full_scale import counts_to_frames, frames_to_counts
from rsvib_torch.io.schema import DetectedVibration, detection_to_json
from rsvib_torch.io.stack_info import FrameError, StackInfo
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks.frame_faults import frame_fault, placeholder
from rsvib_torch.stacks.records import WindowRecord
from rsvib_torch.stacks.window_restoration import RestoredFrames, restore_trusted
from rsvib_torch.stacks.windows import Window, window_timing

__all__ = ["BadFrames", "StackJob", "StoredWindow", "WindowFrames", "WindowReader", "WindowResult"]

BadFrames = Literal["pass", "skip"]
WindowFrames = list[NDArray[Any] | str]  # pixels as stored, or why there are none
_JUDGED_PAIRS, _JUDGED_PAIRS_ALONE = 2, 8  # of a window, evenly spread


@dataclass(frozen=True, eq=False)
class WindowResult:
    """One window of a stack, restored.

    Attributes:
        window: Which frames it has and which of them it writes.
        indices: Numbers of ``frames`` in the stack; empty where all frames became one image.
        frames: Restored frames, full scale 1: (T, H, W) or (T, C, H, W). Where nothing was restored, as taken.
        restored: Whether they are restored.
        detection: What was detected; its time begins with the window's first frame. None where nothing could be.
        restoration: What is known of the restoration; None without a detection.
        error: Why nothing was detected or restored.
        bad_frames: Frames of ``window.written`` that could not be used, with the reason; they are not in ``frames``.
    """

    window: Window
    indices: tuple[int, ...]
    frames: Tensor
    restored: bool
    detection: DetectionResult | DetectedVibration | None
    restoration: RestoredFrames | None
    error: str | None
    bad_frames: Mapping[int, str]


@dataclass(frozen=True, eq=False)
class StoredWindow:
    """Frames of a window as they go into the file, with the record of it."""

    frames: list[NDArray[Any]]
    record: dict[str, Any]


@dataclass(frozen=True, eq=False)
class StackJob:
    """Everything that the result of a window depends on, besides its frames.

    Attributes:
        source: The stack.
        info: What it says of itself.
        timing: The sensor, for the whole stack.
        full_scale: Count that means 1.0; None for floats.
        detection: Options of ``detect_vibration``.
        restoration: Options of ``restore``, for frames whose full scale is 1; None to detect only.
        given: Detections to use instead, by number of the window; None where a window has none.
        bad_frames: Whether frames that cannot be used are written as they are, or left out.
        force: Keep restored frames even where they are judged no better than raw.
        device: Where to compute.
    """

    source: Path
    info: StackInfo
    timing: SensorTiming
    full_scale: float | None
    detection: Mapping[str, Any] = field(default_factory=dict)
    restoration: Mapping[str, Any] | None = field(default_factory=dict)
    given: Mapping[int, DetectedVibration | None] | None = None
    bad_frames: BadFrames = "pass"
    force: bool = False
    device: str = "cpu"

    @property
    def joined(self) -> bool:
        """Whether the frames of a window become one image."""
        return self.restoration is not None and self.restoration.get("joint", False) is True

    def of_window(self, window: Window) -> "StackJob":
        """The same for one window: of the detections to use only its own."""
        return self if self.given is None else replace(self, given={window.index: self.given[window.index]})

    def compute(self, window: Window, pixels: WindowFrames) -> WindowResult:
        """Detect, restore and judge one window.

        Args:
            window: Which frames it has.
            pixels: The frames, or why there are none.
        """
        faults = {
            index: frame if isinstance(frame, str) else frame_fault(frame, index, self.full_scale)
            for index, frame in zip(window.frames, pixels, strict=True)
        }
        good = [index for index, fault in faults.items() if fault is None]
        bad = {index: fault for index in window.written if (fault := faults[index]) is not None}
        usable = [frame for frame, fault in zip(pixels, faults.values(), strict=True) if fault is None]
        kept = tuple(index for index in good if index in window.written)
        shape = (0, *self.info.shape[1:])
        taken = torch.empty(shape)
        if usable:
            taken = counts_to_frames(np.stack(usable), self.full_scale, str(self.source)).to(self.device)
        if len(usable) < 2 and any(fault is not None for fault in faults.values()):
            reason = next(fault for fault in faults.values() if fault is not None)
            return WindowResult(window, kept, taken[: len(kept)], False, None, None, reason, bad)
        timing = window_timing(self.timing, window, good)
        detection: DetectionResult | DetectedVibration | None = None
        try:
            detection = self._detect(window, taken, timing)
            if detection is None or self.restoration is None:
                unknown = "no vibration is known for this window" if detection is None else None
                return WindowResult(window, kept, taken[: len(kept)], False, detection, None, unknown, bad)
            fewer = len(kept) if len(kept) > 1 and not self.restoration.get("joint", False) else None
            restored = restore_trusted(
                taken,
                timing,
                detection,
                self.restoration,
                force=self.force,
                first_frames=fewer,
                most_pairs=_JUDGED_PAIRS_ALONE if window.alone else _JUDGED_PAIRS,
            )
        except (ValueError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
            message = " ".join(str(error).split())
            return WindowResult(window, kept, taken[: len(kept)], False, detection, None, message, bad)
        if self.joined and restored.restored:
            return WindowResult(window, (), restored.frames, True, detection, restored, None, bad)
        return WindowResult(
            window, kept, restored.frames[: len(kept)], restored.restored, detection, restored, None, bad
        )

    def _detect(
        self, window: Window, frames: Tensor, timing: SensorTiming
    ) -> DetectionResult | DetectedVibration | None:
        if self.given is not None:
            return self.given[window.index]
        found: DetectionResult = detect_vibration(frames, timing, **self.detection)
        return found

    def stored(self, result: WindowResult, pixels: WindowFrames) -> StoredWindow:
        """The frames of a result as they go into the file: what was not restored goes there unchanged."""
        dtype = np.dtype(self.info.dtype)
        window, rows = result.window, list(result.window.written)
        if result.restored and not result.indices:
            frames = list(frames_to_counts(result.frames, dtype, self.full_scale))
        else:
            new = dict(zip(result.indices, result.frames, strict=True)) if result.restored else {}
            frames = []
            for index in [rows[len(rows) // 2]] if self.joined else rows:
                if index in new:
                    frames.append(frames_to_counts(new[index], dtype, self.full_scale))
                elif self.bad_frames == "pass" or index not in result.bad_frames:
                    old = pixels[index - window.first]
                    frames.append(placeholder(self.info.shape[1:], self.info.dtype) if isinstance(old, str) else old)
        return StoredWindow(frames, self.record(result, len(frames)))

    def record(self, result: WindowResult, written: int) -> dict[str, Any]:
        """What is kept of a result."""
        restoration = result.restoration
        verdict = None if restoration is None else restoration.verdict
        return WindowRecord.content(
            result.window,
            float(self.timing.frame_starts(result.window.first + 1)[-1]),
            written=written,
            frames="restored" if result.restored else "as taken",
            detection=detection_to_json(result.detection),
            left_alone=[] if restoration is None else list(restoration.left_alone),
            outcome=None if verdict is None else verdict.overall,
            summary=None if verdict is None else verdict.summary,
            error=result.error,
            bad_frames={str(index): reason for index, reason in result.bad_frames.items()},
        )


class WindowReader:
    """Reads the frames of windows in order; the frame that neighbours share is read once.

    Args:
        source: The stack.
        info: What it said of itself when the run began.
    """

    def __init__(self, source: Path, info: StackInfo) -> None:
        self._source, self._info = source, info
        self._reader: FrameReader | None = None
        self._last: tuple[int, NDArray[Any] | str] | None = None

    def read(self, window: Window) -> WindowFrames:
        """Pixels of the frames of a window as stored, or why there are none."""
        if self._reader is None:
            self._reader = open_stack(self._source)
            if self._reader.info != self._info:
                raise ValueError(f"{self._source} has changed while it was read")
        frames = [self._frame(self._reader, index) for index in window.frames]
        self._last = (window.last, frames[-1])
        return frames

    def _frame(self, reader: FrameReader, index: int) -> NDArray[Any] | str:
        if self._last is not None and self._last[0] == index:
            return self._last[1]
        try:
            return reader.frame(index)
        except FrameError as error:
            return " ".join(str(error).split())

    def close(self) -> None:
        """Let go of the stack."""
        if self._reader is not None:
            self._reader.close()
