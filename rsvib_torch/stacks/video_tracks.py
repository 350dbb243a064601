"""The motion of every frame of a video, followed from frame to frame."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.tracking.tracker import VibrationTracker, displaced

__all__ = ["FrameTrack", "followed"]


@dataclass(frozen=True, eq=False)
class FrameTrack:
    """What is known of a frame of a video.

    Attributes:
        index: Number of the frame.
        time: s, exposure start of its first row, from the first frame.
        motion: The motion of the rows to remove, in image axes; its time origin is the middle of the frame.
        path: (2,) px, place on the path of the image motion; NaN if it is not known.
        known: Whether the motion is known.
        fault: Why the frame could not be used; None if it was used.
        detection: The vibration at this frame, with the time origin at its first row; None if it is not known.
        shift: (2,) px, by which the restored frame is moved back in addition; None for none.
    """

    index: int
    time: float
    motion: Vibration
    path: Tensor
    known: bool
    fault: str | None = None
    detection: DetectionResult | None = None
    shift: Tensor | None = None

    @property
    def removed(self) -> Vibration:
        """All that is removed: the motion and the shift."""
        return self.motion if self.shift is None else displaced(self.motion, self.shift)

    def moved_to(self, place: Tensor) -> "FrameTrack":
        """The frame with its content at another place (2,) of the path in px."""
        return replace(self, shift=self.path - place)

    def before(self, index: int, time: float, velocity: Tensor) -> "FrameTrack":
        """The motion at an earlier frame, if the vibration was steady and the path moved at (2,) px/s.

        Args:
            index: Number of the frame.
            time: s, its start.
            velocity: Of the path at this frame.
        """
        motion, passed = self.motion, time - self.time
        phase = motion.phase + 2.0 * torch.pi * motion.frequency * passed
        speed = motion.image_motion + motion.image_acceleration * passed
        earlier = Vibration(motion.amplitude, motion.frequency, phase, speed, motion.image_acceleration)
        return FrameTrack(index, time, earlier, self.path + velocity * passed, known=True)


def followed(
    frames: Iterator[tuple[int, float, NDArray[Any] | str, Any]],
    tracker: VibrationTracker,
    reports: Callable[[int], bool],
) -> Iterator[tuple[FrameTrack, Any]]:
    """Follow the vibration through a video.

    It is known after a few frames; the motion of those before is that of the first one at which it is known, continued
    backwards.

    Args:
        frames: Number, start time in s, pixels to track or the reason why they cannot be used, and anything that
            belongs to the frame.
        tracker: A new tracker.
        reports: Whether a frame of this number gets its detection.

    Yields:
        What is known of every frame, and what belongs to it.
    """
    first: deque[tuple[FrameTrack, Any]] = deque()  # frames up to that at which the motion is known
    start: FrameTrack | None = None
    for index, time, pixels, item in frames:
        track = _tracked(tracker, index, time, pixels, reports=reports(index))
        if start is not None:
            if first:
                velocity = (track.path - start.path) / (track.time - start.time)
                yield from _continued(first, start, torch.where(torch.isfinite(velocity), velocity, 0.0))
                first.clear()
            yield track, item
            continue
        first.append((track, item))
        if track.known:
            start = track
        elif len(first) > 4 * tracker.window:  # the vibration is not known for a while
            yield first.popleft()
    yield from first if start is None else _continued(first, start, torch.zeros(2, dtype=torch.float64))


def _tracked(
    tracker: VibrationTracker, index: int, time: float, pixels: NDArray[Any] | str, *, reports: bool
) -> FrameTrack:
    nowhere = torch.full((2,), torch.nan, dtype=torch.float64)
    if isinstance(pixels, str):
        return FrameTrack(index, time, Vibration.still(), nowhere, known=False, fault=pixels)
    tracked = tracker.update(pixels, time)
    fault = f"frame {index} is constant, or a copy of the frame before" if tracked.state == "unusable" else None
    known = bool(torch.isfinite(tracked.path).all())
    detection = tracked.detection if reports and known else None
    if detection is not None:  # an axis is restored if it was reliable in one of the last frames
        reliable = tracked.motion.moving_axes() & (tracked.motion.amplitude > 0).any(-1)
        reasons = tuple(() if good else why for good, why in zip(reliable.tolist(), detection.reasons, strict=True))
        detection = replace(detection, reliable=reliable, reasons=reasons)
    return FrameTrack(index, time, tracked.motion, tracked.path.cpu(), known, fault, detection)


def _continued(
    frames: deque[tuple[FrameTrack, Any]], start: FrameTrack, velocity: Tensor
) -> Iterator[tuple[FrameTrack, Any]]:
    for track, item in frames:
        usable = not track.known and track.fault is None
        yield (start.before(track.index, track.time, velocity) if usable else track), item
