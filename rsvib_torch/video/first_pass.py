"""The first pass through a video: corners between neighbouring frames that show the same scene at different times."""

import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rsvib_torch.execution.parallel import prefetched
from rsvib_torch.gyroscope.corner_tracks import followed_pair
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import CornerFollower, Corners, repetition
from rsvib_torch.stacks.recorded_motion import compared_pairs
from rsvib_torch.tracking.camera_path import WINDOW_FRAMES
from rsvib_torch.video.video_frames import Frame, VideoFrames

PART_FRAMES = 32  # of a part of the video, which is encoded by itself; an interrupted run repeats at most one part
CHECKED_FRAMES = 8  # of each part, in which the shaking is measured
# Of the usual change from frame to frame: at least 0.18 in 36 clips that a hand holds, and at most 0.12 of copies in a
# video of 24 frames per second that is stored as 30. More frames in a row are no copies: a pan has ended, or it is dark
_COPY, _MEMORY, _MOST_IN_A_ROW = 0.15, 8, 3
# Of the contrast of two frames of 16 x 16 px, their mean difference: at least 0.9 at 14 cuts, at most 0.7 in 13 clips.
# Light that flickers more leaves many corners; those of unrelated frames that agree by chance are few
_CUT, _THUMBNAIL, _FEW = 0.8, (16, 16), 64


class FirstPass:
    """Follows corners from each usable frame of a video to the next one; copies of the frame before do not count."""

    def __init__(self, frames: VideoFrames, *, for_gyroscope: bool) -> None:
        self._frames, self._timing, self._for_gyroscope = frames, frames.job.timing, for_gyroscope
        self._times = frames.middles
        self.taken = frames.middles  # (N,) s, middle of every frame, and of copies that of the frame before
        self.faults: dict[int, str] = {}  # number of each frame that cannot be used, with the reason
        self.corners: dict[int, Corners] = {}  # between a frame and the next one, of the first frames of each part
        self.compared: dict[int, Array] = {}  # with a gyroscope, likewise, of some frames of the video
        self.repetitions: dict[int, Array | None] = {}  # without a gyroscope, of each part
        self._chosen = compared_pairs(len(frames.starts)) if for_gyroscope else []
        self._others: set[int] = set()  # frames that show something else than the frame before
        self._before: tuple[int, NDArray[np.uint8]] | None = None  # the usable frame before, and its number
        self._changes: deque[float] = deque(maxlen=_MEMORY)  # counts, of the frames before
        self._waiting: list[tuple[int, NDArray[np.uint8], float]] = []  # possible copies of it, and their changes
        self._follower = CornerFollower(self._timing, compare_blur=not for_gyroscope and not frames.stabilised)

    @property
    def cuts(self) -> list[int]:
        """Numbers of the first frames of further shots; two other frames in a row are a flash."""
        return [index for index in sorted(self._others) if not self._others & {index - 1, index + 1}]

    def pairs(self, progress: Callable[[], None]) -> Iterator[Corners | None]:
        """Corners between each usable frame and the one before; a thread follows them, up to a window ahead."""
        with closing(self._frames.decoded()) as frames:
            known = (self._next(index, frame) for index, frame in enumerate(frames))
            with closing(prefetched(known, WINDOW_FRAMES)) as followed:
                for corners in followed:
                    progress()
                    yield from corners

    def _next(self, index: int, frame: Frame | str) -> tuple[Corners | None, ...]:
        """The corners between usable frames that are known with a frame."""
        if isinstance(frame, str):
            self.faults[index] = frame
            return ()
        grey, before = self._frames.grey(frame), self._before
        changed = math.inf if before is None else cv2.norm(grey, before[1], cv2.NORM_L1) / grey.size
        usual = float(np.median(self._changes)) if len(self._changes) >= _MEMORY // 2 else 0.0
        if before is None or changed > _COPY * usual:
            self._waiting.clear()
            return self._used(index, grey, changed)
        self.taken[index] = self.taken[before[0]]
        self._waiting.append((index, grey, changed))
        if len(self._waiting) <= _MOST_IN_A_ROW:
            return ()
        waiting, self._waiting = self._waiting, []
        return tuple(corners for one in waiting for corners in self._used(*one))

    def _used(self, index: int, grey: NDArray[np.uint8], changed: float) -> tuple[Corners | None, ...]:
        """The corners between a frame that is no copy and the usable frame before, if there is one."""
        self.taken[index], before = self._times[index], self._before
        if grey.min() == grey.max():
            self.faults[index] = f"frame {index} is constant"
            return ()
        if not self._for_gyroscope and index // PART_FRAMES not in self.repetitions:
            self.repetitions[index // PART_FRAMES] = repetition(grey)
        corners = self._follower.next(grey, float(self._frames.starts[index]))
        self._before = index, grey
        if before is None:
            return ()
        self._changes.append(changed)
        if (corners is None or len(corners.rows) < _FEW) and _shows_other(grey, before[1]):
            corners = None
            self._others.add(index)
        if before[0] == index - 1:
            if corners is not None and index % PART_FRAMES < CHECKED_FRAMES:
                self.corners[index - 1] = corners
            if index - 1 in self._chosen:
                self.compared[index - 1] = followed_pair(before[1], grey)
        if corners is not None and self._frames.stabilised:
            both = np.broadcast_to(self.taken[[before[0], index]], corners.times.shape)
            corners = replace(corners, times=both)
        return (corners,)


def _shows_other(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> bool:
    """Whether two frames (H, W) show different scenes, not one scene that moves by a part of the frame."""
    small = [
        cv2.resize(frame, _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float64) for frame in (first, second)
    ]
    contrast = min(float(frame.std()) for frame in small)
    return float(np.abs(small[0] - small[1]).mean()) > _CUT * contrast
