"""The motion of every frame of a video, followed from frame to frame."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.tracking.tracker import VibrationTracker

_OPPOSITE: dict[str, Literal["forward", "reverse"]] = {"forward": "reverse", "reverse": "forward"}


@dataclass(frozen=True, eq=False)
class FrameTrack:
    """What is known of a frame of a video."""

    index: int  # number of the frame
    time: float  # s, exposure start of its first row, from the first frame
    motion: Vibration  # the motion to remove, in image axes; its time origin is the middle of the frame
    path: Tensor  # (2,) px, place on the path of the image motion; NaN if it is not known
    known: bool  # whether the motion is known
    fault: str | None = None  # why the frame could not be used; None if it was used
    # the vibration at this frame, with the time origin at its first row; None if it is not known
    detection: DetectionResult | None = None

    def moved_to(self, place: Tensor) -> "FrameTrack":
        """The frame with its content at another place (2,) of the path in px."""
        return replace(self, motion=replace(self.motion, image_shift=self.path - place))


def followed(
    frames: Iterator[tuple[int, float, NDArray[Any] | str, Any]],
    tracker: VibrationTracker,
    reports: Callable[[int], bool],
) -> Iterator[tuple[FrameTrack, Any]]:
    """Follow the vibration through a video.

    A frame is its number, its start in s, pixels to track or the reason why they cannot be used, and anything that
    belongs to it. The motion is known after a few frames. Those before are followed backwards in time, from frames
    behind them: the reversed video is that of a sensor which reads its rows in the opposite direction. ``reports``
    selects frames that get their detection.
    """
    first: deque[_Given] = deque()  # frames before the motion is known, and a window behind them
    start: int | None = None  # number of the first frame whose motion is known
    for index, time, pixels, item in frames:
        track = _tracked(tracker, index, time, pixels, reports=reports(index))
        if start is not None and not first:
            yield track, item
            continue
        first.append(_Given(track, pixels, item))
        if start is None:
            start = index if track.known else None
            if start is None and len(first) > 4 * tracker.options.window:  # the vibration is not known for a while
                yield first[0].track, first.popleft().item
        elif index >= start + tracker.options.window:
            yield from _followed_backwards(first, tracker)
            first.clear()
    yield from _followed_backwards(first, tracker)


@dataclass(frozen=True, eq=False)
class _Given:
    """A frame with what is known of it, and what belongs to it."""

    track: FrameTrack
    pixels: NDArray[Any] | str
    item: Any


def _followed_backwards(frames: Sequence[_Given], tracker: VibrationTracker) -> Iterator[tuple[FrameTrack, Any]]:
    """Tracks of frames, those of unknown motion followed backwards from the last frame."""
    known = [one.track for one in frames if one.track.known]
    unknown = {one.track.index for one in frames if not one.track.known and one.track.fault is None}
    found: dict[int, FrameTrack] = {}
    if known and unknown:
        backwards = VibrationTracker(
            replace(tracker.timing, readout_direction=_OPPOSITE[tracker.timing.readout_direction]),
            **vars(replace(tracker.options, steady=0.0, wobble=tracker.wobble)),
        )
        last = frames[-1].track.time
        for one in reversed(frames):
            if one.track.fault is None:
                track = _tracked(backwards, one.track.index, last - one.track.time, one.pixels, reports=False)
                found[track.index] = _reversed(track, one.track.time)
    both = next((track for track in known if track.index in found and found[track.index].known), None)
    apart = torch.zeros(2, dtype=torch.float64) if both is None else both.path - found[both.index].path
    for one in frames:
        track = one.track
        if both is not None and track.index in unknown and found[track.index].known:
            track = replace(found[track.index], path=found[track.index].path + apart)
        yield track, one.item


def _reversed(track: FrameTrack, time: float) -> FrameTrack:
    """What was found backwards in time, for a frame that starts at ``time`` in s."""
    motion = track.motion
    forwards = replace(motion, phase=torch.pi - motion.phase, image_motion=-motion.image_motion)
    return replace(track, time=time, motion=forwards)


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
        findings = tuple(() if good else why for good, why in zip(reliable.tolist(), detection.findings, strict=True))
        detection = replace(detection, reliable=reliable, findings=findings)
    return FrameTrack(index, time, tracked.motion, tracked.path.cpu(), known, fault, detection)
