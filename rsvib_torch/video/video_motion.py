"""The motion of all frames of a video: corners of neighbouring frames, what is removed, verdict and record of parts."""

import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from rsvib_torch.execution.parallel import ONE_BLAS_THREAD, prefetched
from rsvib_torch.gyroscope.corner_tracks import followed_pair, tracks_of_pairs
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates
from rsvib_torch.gyroscope.rotation_alignment import AlignOptions, RotationAlignment, align_rates
from rsvib_torch.imaging.trajectory import places_at_rest, recorded_offsets
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import ProcessVideoOptions
from rsvib_torch.registration.corners import CornerFollower, Corners, Grey, repetition
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason
from rsvib_torch.stacks.recorded_motion import compared_pairs
from rsvib_torch.stacks.windows import WindowRecord
from rsvib_torch.tracking.camera_path import WINDOW_FRAMES, CameraPath, camera_path, shake
from rsvib_torch.video import Margins
from rsvib_torch.video.part_detection import part_detection, tone_tables
from rsvib_torch.video.recorded_rotation import RecordedRotation
from rsvib_torch.video.steadying import steady_shifts
from rsvib_torch.video.video_frames import Frame, FrameTrack, VideoFrames

PART_FRAMES = 32  # of a part of the video, which is encoded by itself; an interrupted run repeats at most one part
CHECKED_FRAMES = 8  # of each part, in which the shaking is measured
# Of the usual change from frame to frame: at least 0.18 in 36 clips that a hand holds, and at most 0.12 of copies in a
# video of 24 frames per second that is stored as 30. More frames in a row are no copies: a pan has ended, or it is dark
_COPY, _MEMORY, _MOST_IN_A_ROW = 0.15, 8, 3
# Of the distance at which a scene repeats itself, a step from frame to frame, along it, up to which the part of the
# video shows by how much the frames move; a larger one may be another by the whole distance
_MOST_OF_REPETITION = 0.25
# More shaking makes a part, or a video, worse: wrong settings make it 1.5 to 5 times as shaky. 0.1 px is not visible.
_MORE_SHAKING, _VISIBLE_SHAKING = 1.1, 0.1  # -, px


class FirstPass:
    """Follows corners from each usable frame of a video to the next one; copies of the frame before do not count."""

    def __init__(self, frames: VideoFrames, *, for_gyroscope: bool) -> None:
        self._frames, self._for_gyroscope, self._times = frames, for_gyroscope, frames.middles
        self.exposed = frames.middles  # (N,) s, middle of every frame, and of copies that of the frame before
        self.faults: dict[int, str] = {}  # number of each frame that cannot be used, with the reason
        self.corners: dict[int, Corners] = {}  # between a frame and the next one, of the first frames of each part
        self.compared: dict[int, Array] = {}  # with a gyroscope, likewise, of some frames of the video
        self.repetitions: dict[int, Array | None] = {}  # without a gyroscope, of each part
        self._chosen = compared_pairs(len(frames.starts)) if for_gyroscope else []
        self._before: tuple[int, Grey] | None = None  # the usable frame before, and its number
        self._changes: deque[float] = deque(maxlen=_MEMORY)  # counts, of the frames before
        self._waiting: list[tuple[int, Grey, float]] = []  # possible copies of it, and their changes
        self._follower = CornerFollower(frames.job.timing, compare_blur=not for_gyroscope and not frames.stabilised)

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
        self.exposed[index] = self.exposed[before[0]]
        self._waiting.append((index, grey, changed))
        if len(self._waiting) <= _MOST_IN_A_ROW:
            return ()
        waiting, self._waiting = self._waiting, []
        return tuple(corners for one in waiting for corners in self._used(*one))

    def _used(self, index: int, grey: Grey, changed: float) -> tuple[Corners | None, ...]:
        """The corners between a frame that is no copy and the usable frame before, if there is one."""
        self.exposed[index], before = self._times[index], self._before
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
        if before[0] == index - 1:
            if corners is not None and index % PART_FRAMES < CHECKED_FRAMES:
                self.corners[index - 1] = corners
            if index - 1 in self._chosen:
                self.compared[index - 1] = followed_pair(before[1], grey)
        if corners is not None and self._frames.stabilised:
            both = np.broadcast_to(self.exposed[[before[0], index]], corners.times.shape)
            corners = replace(corners, times=both)
        return (corners,)


@dataclass(frozen=True, eq=False)
class VideoPart:
    """What is removed from the frames of a part of a video."""

    number: int
    tracks: list[FrameTrack]
    # ``WindowRecord.shaking``, from its first frames; None if it is unknown
    shaking: dict[str, tuple[float, ...]] | None
    is_worse: bool = False  # whether its rows are left as taken, because it would shake more otherwise


@dataclass(frozen=True, eq=False)
class VideoMotion:
    """The motion of all frames of a video: what is removed, where frames are moved to, verdict and record of parts."""

    frames: VideoFrames  # source, settings, and how frames are restored
    path: CameraPath | RotationAlignment  # of the camera, from corners or by a gyroscope
    first_pass: FirstPass  # times, faults and corners of the frames
    removed: Callable[[int], Vibration | FreeMotion]  # from a frame, the middle of which is the time origin
    is_steady: bool  # whether the frames are moved to a smooth path

    def part(self, number: int) -> VideoPart:
        """A part. It is left alone if restoration makes its first frames shake more.

        If their shaking is unknown, it is if path and tones do not explain the corners of the part.
        """
        first = number * PART_FRAMES
        indices = range(first, min(first + PART_FRAMES, len(self.frames.starts)))
        tracks = [FrameTrack(index, self.removed(index), self.first_pass.faults.get(index)) for index in indices]
        shaking = self._shaking(tracks)
        is_worse = any(shakes_more(*pair) for pair in shaking.values()) if shaking else not self.is_explained(number)
        if not is_worse or not isinstance(self.path, CameraPath):
            return VideoPart(number, tracks, shaking)
        tracks = [  # rows are not moved apart
            replace(track, motion=replace(track.motion.scaled(0.0), image_shift=track.motion.image_shift))
            for track in tracks
            if isinstance(track.motion, Vibration)
        ]
        return VideoPart(number, tracks, self._shaking(tracks), is_worse=True)

    def is_explained(self, part: int) -> bool:
        """Whether the path of the camera and tones explain the corners of a part."""
        path, times = self.path, self.first_pass.exposed[part * PART_FRAMES : (part + 1) * PART_FRAMES]
        return not isinstance(path, CameraPath) or path.nearest(times[len(times) // 2]).residual < path.allowed

    def margins(self) -> Margins:
        """The widest margins of all frames: how far outside of the frame the content of its border was recorded.

        They are even, i.e. whole pixels of chroma.
        """
        widest = np.zeros(4)
        for index in range(len(self.frames.starts)):
            if index not in self.first_pass.faults:
                timing = self.frames.timing_of(index)
                (x, y), _ = recorded_offsets(self.removed(index), timing, self.frames.size)
                x, y = (x, y) if timing.scan_axis == -2 else (x.T, y.T)
                sides = [-y[0].min(), y[-1].max(), -x[:, 0].min(), x[:, -1].max()]
                widest = np.maximum(widest, sides)
        return Margins(*(2 * math.ceil(0.5 * (side + 0.5)) if side > 0.01 else 0 for side in widest))

    # Whether restoration helps, and the record of a part

    def _shaking(self, tracks: list[FrameTrack]) -> dict[str, tuple[float, ...]] | None:
        """``VideoPart.shaking`` of frames that follow each other.

        Before and after are of the same corners: in other frames, others are found, some of them on cars that pass.
        """
        measured: dict[int, Array] = {}  # (2, 3) px, before and after: x, y and rows, of a frame and the next one
        for pair in pairwise(tracks[:CHECKED_FRAMES]):
            raw = self.first_pass.corners.get(pair[0].index)
            if raw is not None:
                shakes = shake(raw), shake(self._restored_corners(pair, raw))
                measured[pair[0].index] = np.array([[*steps, rows] for steps, rows in shakes])
        changes = [measured[index + 1] - measured[index] for index in measured if index + 1 in measured]
        if not changes:
            return None
        steps, rows = np.array(changes)[..., :2], np.array(list(measured.values()))[..., 2]
        return {
            "frame_to_frame": tuple(np.sqrt(np.square(steps).sum(-1).mean(0)).tolist()),
            "rows": tuple(np.sqrt(np.square(rows).mean(0)).tolist()),
        }

    def _restored_corners(self, pair: tuple[FrameTrack, FrameTrack], corners: Corners) -> Corners:
        """Corners between two frames where they are in the restored ones."""
        places: list[Array] = []
        for number, track in enumerate(pair):
            exposure = self.frames.timing_of(track.index).exposure_time
            starts = corners.times[:, number] - self.first_pass.exposed[track.index] - 0.5 * exposure
            recorded = corners.places + (number - 0.5) * corners.offsets
            places.append(places_at_rest(track.motion, recorded, starts, exposure))
        return replace(corners, places=0.5 * (places[0] + places[1]), offsets=places[1] - places[0])

    def record(self, part: VideoPart) -> WindowRecord:
        """The record of a part of the video."""
        tracks, shaking, path = part.tracks, part.shaking, self.path
        first, last = tracks[0].index, tracks[-1].index
        detection = None
        if isinstance(path, CameraPath):
            detection = part_detection(self.frames, path, self.first_pass.exposed, slice(first, last + 1))
        reasons = []
        if detection is not None and not self.is_steady:  # the rows of axes without tones are not moved
            reasons = [
                Reason("axis_not_reliable", name, details={"action": "restored", "why": "; ".join(map(str, why))})
                for name, why, sizes in zip(
                    AXIS_NAMES[:2], detection.reasons, detection.vibration.amplitude, strict=True
                )
                if not sizes.any()
            ]
        is_moved = any(bool(track.motion.moving_axes().any()) for track in tracks if track.fault is None)
        helps = shaking is not None and any(after < before for before, after in shaking.values())
        outcome = "worse" if part.is_worse else "helps" if helps else None
        return WindowRecord(
            window=part.number,
            first=first,
            last=last,
            start_time=float(self.frames.starts[first]),
            written=len(tracks),
            frames="restored" if is_moved else "as taken",
            detection=detection,
            outcome=outcome,
            verdict="restored rows would shake more than those taken, and are left as taken" if part.is_worse else None,
            bad_frames={str(track.index): track.fault for track in tracks if track.fault is not None},
            left_alone=tuple(reasons),  # tones are removed as they were measured, whatever explains them
            shaking=shaking,
        )


def video_motion(
    frames: VideoFrames,
    options: ProcessVideoOptions,
    rates: AngularRates | None,
    camera: Camera | None,
    progress: Callable[[], None],
) -> VideoMotion:
    """The motion of all frames, from corners that are followed from each usable frame to the next one.

    With the ``rates`` of a gyroscope, its rotation is the path; the focal length is that of the ``camera``, or fitted.
    """
    first_pass, timing = FirstPass(frames, for_gyroscope=rates is not None), frames.job.timing

    def to_steady(path: Array, of_frames: Callable[[Array], Array] = np.asarray) -> Array:
        return steady_shifts(frames.middles, path, options.steady, frames.size, options.crop_limit, of_frames)

    if rates is None:
        with ONE_BLAS_THREAD:
            path = camera_path(first_pass.pairs(progress), timing, frames.size, has_tones=not frames.stabilised)
        places = path.places(first_pass.exposed)
        _check_repetitions(first_pass.repetitions, places[:, :2])
        shift = to_steady(places)
        derivatives = (path.derivatives(first_pass.exposed, order) for order in (1, 2))
        polynomials = np.stack([*derivatives, shift], 1)
        polynomials[:, :2] *= not frames.stabilised

        def by_corners(index: int) -> Vibration:
            """The tones, skew and wobble by the path, and what the path is not smooth by."""
            tones, polynomial = path.tones(float(first_pass.exposed[index])), polynomials[index]
            if options.steady == 0:  # axes without vibration stay as taken
                polynomial = polynomial * np.array([any(tone.axis == axis for tone in tones) for axis in range(4)])
            amplitude, frequency, phase, *_ = tone_tables(tones, 4)
            return Vibration(amplitude, frequency, phase, *polynomial)

        return VideoMotion(frames, path, first_pass, by_corners, options.steady > 0)
    deque(first_pass.pairs(progress), maxlen=0)  # all frames are followed, for ``found.compared`` and ``found.corners``
    tracks = tracks_of_pairs(first_pass.compared, frames.starts.tolist(), timing, frames.size)
    aligned = align_rates(tracks, timing, rates, AlignOptions(camera=camera))
    if not aligned.reliable:
        reasons = "; ".join(aligned.reasons)
        raise ValueError(f"the gyroscope ({rates.source}) does not fit the video: {reasons}")
    rotation = RecordedRotation.aligned(rates, aligned, first_pass.exposed)
    turned = to_steady(rotation.path, rotation.of_frames)
    half = timing.time_to_middle(frames.size[int(timing.scan_axis)])
    return VideoMotion(
        frames, aligned, first_pass, lambda index: rotation.motion(index, turned[index], half), options.steady > 0
    )


def _check_repetitions(repetitions: dict[int, Array | None], places: Array) -> None:
    """Raise a ``ValueError`` if the path (N, 2) of at least half of the parts may be wrong by whole repetitions.

    By the corners of a fence with a period of 20 px, the restored frames shook by 3.5 px instead of 2.6 px, and
    less shaking than before was measured.
    """
    unknown: list[tuple[float, float]] = []  # px, of a part: the distance, and the large steps along it
    for part, shift in repetitions.items():
        if shift is not None:
            distance = float(np.hypot(*shift))
            of_part = places[part * PART_FRAMES : (part + 1) * PART_FRAMES]
            steps = np.abs(np.diff(of_part, axis=0) @ shift) / distance
            largest = float(np.quantile(steps, 0.9)) if len(steps) else 0.0
            if largest > _MOST_OF_REPETITION * distance:
                unknown.append((distance, largest))
    if unknown and 2 * len(unknown) >= len(repetitions):
        distance, largest = unknown[0]
        raise ValueError(
            f"the frames show the same again every {distance:.3g} px, such as a fence, and seem to move by "
            f"{largest:.2g} px from frame to frame: by how many repetitions they move is not known. Use a part of "
            "the video with another scene, or a gyroscope"
        )


def shakes_more(before: float, after: float) -> bool:
    """Whether frames shake visibly more, by rms motions in px, than before."""
    return after > _MORE_SHAKING * before + _VISIBLE_SHAKING
