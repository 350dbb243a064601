"""Passes through a video: decoding, tracking and steadying of its frames, verdict and record of its parts."""

import pickle
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from rsvib_torch.core.prefetch import prefetched
from rsvib_torch.core.presentation import AXIS_NAMES, plain_values
from rsvib_torch.core.reason import Reason
from rsvib_torch.core.text import number_of
from rsvib_torch.detection import DetectionResult
from rsvib_torch.frames.pixels import detailed_columns
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.io.full_scale import counts_to_frames
from rsvib_torch.io.stack_info import FrameError
from rsvib_torch.io.stack_reading import open_stack
from rsvib_torch.io.video_parts import planes_of
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.restoration import RestorationVerdict, TooLittleInCommonError
from rsvib_torch.restoration.restore import restore_prepared
from rsvib_torch.restoration.verdict.judge import judge_prepared
from rsvib_torch.stacks.job import StackJob
from rsvib_torch.stacks.video_frames import FrameLayout, VideoRestorer
from rsvib_torch.stacks.video_tracks import FrameTrack, followed
from rsvib_torch.tracking import Margins, VibrationTracker
from rsvib_torch.tracking.steadying import steadied

PART_FRAMES = 32  # of a part of the video, which is encoded by itself; an interrupted run repeats at most one part
_JUDGED_COLUMNS = 320  # with the most detail; the verdict itself takes 160 of them
_AHEAD = 4  # frames decoded, and frames tracked, before they are used

Frame = NDArray[Any]


@dataclass(frozen=True, eq=False)
class VideoPasses:
    """What the passes through a video have in common: how frames are read, tracked, steadied, judged and recorded."""

    job: StackJob  # source and settings
    layout: FrameLayout  # layout of the frames
    restorer: VideoRestorer  # restores them
    starts: list[float]  # s, exposure start of every frame, from the first one
    steady: float  # as in ``process_video``
    columns: int | None  # as in ``process_video``
    window: int  # as in ``process_video``

    @property
    def parts(self) -> int:
        """Number of parts."""
        return -(-len(self.starts) // PART_FRAMES)

    def ends_part(self, index: int) -> bool:
        """Whether a frame is the last one of a part."""
        return index % PART_FRAMES == PART_FRAMES - 1 or index == len(self.starts) - 1

    def _decoded(self) -> Generator[tuple[int, float, Frame | str, Frame | str], None, None]:
        """Number and start of every frame, its luma, and the frame itself, or why it cannot be read."""
        reader = open_stack(self.job.source)
        try:
            if reader.info != self.job.info:
                raise ValueError(f"{self.job.source} has changed since it was first opened; start again")
            source: Any = planes_of(reader) or reader if self.layout.planar else reader
            for index, start in enumerate(self.starts):
                try:
                    frame = source.frame(index)
                except FrameError as error:
                    reason = " ".join(str(error).split())
                    yield index, start, reason, reason
                    continue
                yield index, start, self.layout.luma(frame), frame
        finally:
            reader.close()

    def tracked(self, found: BinaryIO | None = None) -> Generator[tuple[FrameTrack, Frame | str], None, None]:
        """Every frame with its motion, at its place in the steady video; decoded and tracked ahead in threads.

        Args:
            found: The tracks that ``margins`` has written, if the motion was followed before.
        """
        if found is not None:
            return prefetched(self._with_tracks(found), _AHEAD)
        tracker = VibrationTracker(
            replace(self.job.timing, frame_start_times=None),
            window=self.window,
            columns=self.columns,
            wobble=self.steady > 0,
            full_scale=self.layout.full_scale,
            channels="first",
        )

        def steady_frames() -> Generator[tuple[FrameTrack, Frame | str], None, None]:
            with closing(prefetched(self._decoded(), _AHEAD)) as decoded:
                yield from steadied(followed(decoded, tracker, self.ends_part), self.steady)

        return prefetched(steady_frames(), _AHEAD)

    def _with_tracks(self, found: BinaryIO) -> Generator[tuple[FrameTrack, Frame | str], None, None]:
        """Every frame with its track from a file."""
        found.seek(0)
        with closing(prefetched(self._decoded(), _AHEAD)) as decoded:
            for _, _, _, frame in decoded:
                yield pickle.load(found), frame  # written by this process to a file without a name

    def margins(self, found: BinaryIO, progress: Callable[[], None]) -> Margins:
        """The widest margins of all frames, from a pass that only follows the motion and writes the tracks."""
        widest = Margins()
        with closing(self.tracked()) as tracks:
            for track, _ in tracks:
                pickle.dump(track, found)
                if track.known and track.fault is None:
                    (visible,) = self.restorer.visible(track, luma_only=True)
                    widest = widest.widest(Margins.of(torch.from_numpy(visible)))
                progress()
        return self.layout.margins(widest)

    def verdict(self, frames: list[tuple[FrameTrack, Frame]]) -> RestorationVerdict | None:
        """Whether restoration helps, from two neighbouring frames before they are steadied; None if unknown."""
        (first, one), (_, other) = frames
        pixels = np.stack([self.layout.luma(one), self.layout.luma(other)])
        images = counts_to_frames(pixels, self.layout.full_scale, str(self.job.source)).to(self.job.device)
        timing = self.job.timing
        if timing.scan_axis == -2:
            images = images[..., detailed_columns(images, _JUDGED_COLUMNS)]
        start = self.restorer.timing_of(0).frame_start_times
        assert start is not None
        starts = (float(start[0]), float(start[0]) + frames[1][0].time - first.time)
        prepared = prepare_frames(images, replace(timing, frame_start_times=starts), channels="first")
        motion = replace(first.motion, image_shift=torch.zeros_like(first.motion.image_shift))
        if not bool(motion.moving_axes().any()):
            return None
        with suppress(TooLittleInCommonError), torch.no_grad():
            restored = restore_prepared(prepared, motion, self.restorer.options)
            return judge_prepared(prepared, restored, motion, most_pairs=1)
        return None

    def record(self, part: int, tracks: list[FrameTrack], verdict: RestorationVerdict | None) -> dict[str, Any]:
        """Content of the ``WindowRecord`` of a part of the video."""
        reported = next((track for track in reversed(tracks) if track.detection is not None), None)
        found = None if reported is None else reported.detection
        known = [track for track in tracks if track.known and track.fault is None]
        faults = {str(track.index): track.fault for track in tracks if track.fault is not None}
        unknown = len(tracks) - len(known) - len(faults)
        return {
            "window": part,
            "first": tracks[0].index,
            "last": tracks[-1].index,
            "start_time": (reported or tracks[0]).time,
            "written": len(tracks),
            "frames": "restored" if any(track.motion.moving_axes().any() for track in known) else "as taken",
            "detection": plain_values(found and DetectedVibration.of(found)),
            "left_alone": plain_values(_left_alone(known, found)),
            "outcome": None if verdict is None else verdict.overall,
            "summary": None if verdict is None else verdict.sentence,
            "predicted_gain": None if verdict is None else plain_values(verdict.predicted_gain.nanmean()),
            "error": f"the motion of {number_of(unknown, 'frame')} is not known" if unknown else None,
            "bad_frames": faults,
        }


def _left_alone(tracks: list[FrameTrack], detection: DetectionResult | None) -> list[Reason]:
    """A reason for each axis whose vibration is removed from none of the frames."""
    notes = []
    for axis, name in enumerate(AXIS_NAMES[:2]):
        if tracks and not any(bool((track.motion.amplitude[axis] > 0).any()) for track in tracks):
            why = "; ".join(() if detection is None else detection.reasons[axis]) or "not known"
            notes.append(Reason("axis_not_reliable", name, details={"action": "restored", "why": why}))
    return notes
