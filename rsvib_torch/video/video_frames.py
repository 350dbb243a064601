"""Restoration of one frame of a video: its planes.

Invariant: the displacement depends on the row only (docs/architecture.md); with roll and zoom also linearly on the
column.
"""

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.execution.parallel import prefetched
from rsvib_torch.frames.full_scale import counts_to_frames, frames_to_counts
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.imaging.trajectory import places, recorded_offsets
from rsvib_torch.io.video import Picture, VideoReader
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import eight_bits
from rsvib_torch.restoration.restore import WITH_SATURATION, restore_prepared
from rsvib_torch.stacks.job import StackJob, stored_frame

_AHEAD = 4  # frames decoded before they are used

Frame = Array


@dataclass(frozen=True, eq=False)
class FrameTrack:
    """What is removed from a frame of a video."""

    index: int  # number of the frame
    motion: Vibration | FreeMotion  # the motion to remove, in image axes; its time origin is the middle of the frame
    fault: str | None = None  # why the frame could not be used; None if it was used


@dataclass(frozen=True, eq=False)
class VideoFrames:
    """How the frames of a video are stored, and how they are restored one by one.

    ``"dewarp"`` interpolates once, in the frame as stored. Of other methods, the vibration is undone first, and then
    the frame is moved; chroma of half the resolution is only dewarped, because its blur is half as wide.
    """

    job: StackJob  # source and settings
    picture: Picture | None  # if frames are the planes Y, U and V of a 4:2:0 video (``VideoReader.planes``)
    starts: Array  # (N,) s, exposure start of every frame, from the first one
    exposures: Array | None  # (N,) s, of the frames; None: all that of the sensor
    stabilised: bool  # by the camera: frames move as a whole, without rows that are read one after another

    def decoded(self) -> Generator[Frame | str, None, None]:
        """Every frame, or why it cannot be read; decoded ahead in a thread."""
        return prefetched(self._decoded(), _AHEAD)

    def _decoded(self) -> Generator[Frame | str, None, None]:
        with closing(self.job.open()) as reader:
            read = reader.planes if self.picture is not None and isinstance(reader, VideoReader) else reader.frame
            for index in range(len(self.starts)):
                yield stored_frame(read, index)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the frames in px."""
        return self.job.info.shape[-2], self.job.info.shape[-1]

    @property
    def middles(self) -> Array:
        """(N,) s, middle of every frame by the timing of the sensor."""
        return self.starts + self.job.timing.time_to_middle(self.size[int(self.job.timing.scan_axis)])

    def grey(self, frame: Frame) -> NDArray[np.uint8]:
        """The frame as 8-bit counts (H, W), in which corners are followed."""
        luma: Array = self.planes(frame)[0]
        luma = luma if luma.ndim == 2 else luma.mean(0)
        return luma.astype(np.uint8, copy=False) if luma.dtype == np.uint8 else eight_bits(luma)

    def planes(self, frame: Frame) -> list[Frame]:
        """Planes (..., H, W): all pixels, or Y (H, W) and the chroma (2, H / 2, W / 2)."""
        if self.picture is None:
            return [frame]
        height, width = self.size
        return [frame[:height], frame[height:].reshape(2, height // 2, width // 2)]

    def frame(self, planes: list[Frame]) -> Frame:
        """The frame with these planes."""
        luma, *chroma = planes
        return np.concatenate([luma, *(plane.reshape(-1, luma.shape[1]) for plane in chroma)]) if chroma else luma

    def black(self) -> list[Frame]:
        """Planes of a frame without content."""
        if self.picture is None:
            return [np.zeros(self.job.info.shape[1:], self.job.info.dtype)]
        height, width = self.size
        return [np.full((height, width), 16, np.uint8), np.full((2, height // 2, width // 2), 128, np.uint8)]

    def restored(self, frame: Frame, track: FrameTrack) -> list[Frame]:
        """Planes of a restored frame."""
        (luma, *chroma), motion, timing = self.planes(frame), track.motion, self.timing_of(track.index)
        if not bool(motion.moving_axes().any()):
            return [luma, *chroma]
        source = places(*recorded_offsets(motion, timing, self.size), timing, self.size)
        for number, plane in enumerate(chroma):
            # its pixels have the mean place of four pixels of luma, in pixels that are twice as large
            halves = [0.5 * cv2.resize(at, plane.shape[:0:-1], interpolation=cv2.INTER_AREA) - 0.25 for at in source]
            chroma[number] = _with_pixels_moved(plane, np.stack(halves))
        if self.job.chosen.method != "dewarp" and isinstance(motion, Vibration) and bool((motion.amplitude > 0).any()):
            # The method undoes what varies between the rows along x and y, and the rest is moved afterwards.
            luma = self._without_vibration(luma, timing, replace(motion.translation(), image_shift=torch.zeros(2)))
            remaining = {name: getattr(motion, name).clone() for name in ("image_motion", "image_acceleration")}
            for values in remaining.values():
                values[:2] = 0.0
            motion = replace(motion, amplitude=torch.zeros_like(motion.amplitude), **remaining)
            source = places(*recorded_offsets(motion, timing, self.size), timing, self.size)
        return [_with_pixels_moved(luma, source), *chroma]

    def timing_of(self, index: int) -> SensorTiming:
        """Timing of a frame, with the time origin in its middle."""
        timing = self.job.timing
        if self.exposures is not None:
            rows = float(self.exposures[index]) / timing.row_time
            timing = replace(timing, exposure_rows=min(rows, timing.frame_rows))
        return replace(timing, frame_start_times=(-timing.time_to_middle(self.size[int(timing.scan_axis)]),))

    def _without_vibration(self, plane: Frame, timing: SensorTiming, motion: Vibration) -> Frame:
        scale, options = self.job.options.full_scale if self.picture is None else 255.0, self.job.chosen
        images: Tensor = counts_to_frames(plane[None], scale, "the video").to(self.job.options.device)
        saturation = options.saturation if isinstance(options.saturation, float) else None
        if saturation is not None and self.picture is not None:
            black, white = self.picture.levels
            saturation = (black + saturation * (white - black)) / 255.0
        if options.method not in WITH_SATURATION:
            saturation = None
        prepared = prepare_frames(images, timing, saturation=saturation, channels="first")
        with torch.no_grad():
            restored = restore_prepared(prepared, motion, options)
        return frames_to_counts(prepared.from_row_order(restored)[0], plane.dtype, scale)


def _with_pixels_moved(plane: Frame, source: NDArray[np.float32]) -> Frame:
    """Pixels (..., H, W) interpolated at places (2, H, W); beyond the border, the plane is mirrored.

    The kernel is cubic: with that of Lanczos of 8 x 8 pixels, which takes four times as long, Y had 0.1 dB more in a
    clip without noise, and 0.1 to 0.3 dB less in compressed and noisy ones.
    """
    stored = plane if plane.dtype in (np.uint8, np.uint16, np.float32) else plane.astype(np.float32)
    x, y = np.ascontiguousarray(source[0]), np.ascontiguousarray(source[1])
    flat = stored.reshape(-1, *stored.shape[-2:])
    interpolated = np.stack([cv2.remap(one, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101) for one in flat])
    if interpolated.dtype != plane.dtype and plane.dtype.kind in "iu":
        limits = np.iinfo(plane.dtype)
        interpolated = np.clip(np.rint(interpolated), limits.min, limits.max)
    return interpolated.reshape(plane.shape).astype(plane.dtype, copy=False)
