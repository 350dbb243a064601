"""Restoration of one frame of a video: its planes, the pixels that the sensor did not record, and margins."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.io.full_scale import counts_to_frames, frames_to_counts
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.options import RestorationOptions
from rsvib_torch.restoration.frame_motion import visible_pixels
from rsvib_torch.restoration.restore import METHODS, restore_prepared
from rsvib_torch.stacks.video_tracks import FrameTrack
from rsvib_torch.tracking import Margins

Frame = NDArray[Any]


@dataclass(frozen=True)
class FrameLayout:
    """How the pixels of a frame are stored."""

    shape: tuple[int, ...]  # (H, W) or (C, H, W) of the pixels
    planar: bool  # whether a frame is the planes Y, U and V of a 4:2:0 video (``PlaneReader``), instead of pixels
    full_scale: float | None  # count that corresponds to 1.0; None for floats
    white: float | None  # count from which pixels are saturated; None for none
    dtype: np.dtype[Any]  # data type of the counts

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the frames in px."""
        return self.shape[-2], self.shape[-1]

    def luma(self, frame: Frame) -> Frame:
        """The part of a frame in which motion is measured."""
        return frame[: self.size[0]] if self.planar else frame

    def planes(self, frame: Frame) -> list[Frame]:
        """Planes (..., H, W): all pixels, or Y (H, W) and the chroma (2, H / 2, W / 2)."""
        if not self.planar:
            return [frame]
        height, width = self.size
        return [frame[:height], frame[height:].reshape(2, height // 2, width // 2)]

    def frame(self, planes: list[Frame]) -> Frame:
        """The frame with these planes."""
        return np.concatenate([planes[0], planes[1].reshape(-1, planes[0].shape[1])]) if self.planar else planes[0]

    def black(self) -> list[Frame]:
        """Planes of a frame without content."""
        if not self.planar:
            return [np.zeros(self.shape, self.dtype)]
        height, width = self.size
        return [np.full((height, width), 16, self.dtype), np.full((2, height // 2, width // 2), 128, self.dtype)]

    def margins(self, margins: Margins) -> Margins:
        """The margins, widened to whole pixels of every plane."""
        if not self.planar:
            return margins
        return Margins(*(side + side % 2 for side in (margins.top, margins.bottom, margins.left, margins.right)))


@dataclass(frozen=True, eq=False)
class RestoredFrame:
    """A restored frame.

    Attributes:
        planes: Its planes.
        visible: For each plane, the pixels (H, W) that the sensor recorded; None if it recorded all.
        fault: Why the frame could not be used; its planes are then those of the frame as taken, if there are any.
    """

    planes: list[Frame] | None
    visible: list[NDArray[np.bool_]] | None
    fault: str | None = None


@dataclass(frozen=True, eq=False)
class VideoRestorer:
    """Restores the frames of a video one by one.

    Args:
        layout: Layout of the frames.
        timing: The sensor.
        options: Method of ``restore`` and its options; chroma of half the resolution is only dewarped, because its blur
            is half as wide.
        device: Device for the computation.
        masks: Whether ``RestoredFrame.visible`` is needed.
    """

    layout: FrameLayout
    timing: SensorTiming
    options: RestorationOptions
    device: str = "cpu"
    masks: bool = True

    def restored(self, frame: Frame | str, track: FrameTrack) -> RestoredFrame:
        """Restore a frame as stored, or the reason why it cannot be read."""
        if isinstance(frame, str):
            return RestoredFrame(None, None, frame)
        planes = self.layout.planes(frame)
        if track.fault is not None or not track.known:
            return RestoredFrame(planes, None, track.fault)
        motions = [(self.timing_of(0), track.motion), (self.timing_of(1), track.motion.scaled(0.5))]
        results = [self._plane(plane, number, *motions[number]) for number, plane in enumerate(planes)]
        return RestoredFrame(results, self.visible(track) if self.masks else None)

    def visible(self, track: FrameTrack, *, luma_only: bool = False) -> list[NDArray[np.bool_]]:
        """For each plane, the pixels of the restored frame that the sensor recorded."""
        height, width = self.layout.size
        parts = [(self.timing_of(0), track.motion, (height, width))]
        if self.layout.planar and not luma_only:
            parts.append((self.timing_of(1), track.motion.scaled(0.5), (height // 2, width // 2)))
        return [visible_pixels(timing, motion, size, 1)[0][0].numpy() for timing, motion, size in parts]

    def timing_of(self, plane: int) -> SensorTiming:
        """Timing of one frame, with the time origin in its middle; rows of chroma lie between two of luma."""
        timing, rows = self.timing, self.layout.size[0 if self.timing.scan_axis == -2 else 1]
        half = 0.5 * ((rows - 1) * timing.row_time + timing.exposure_time)
        if plane == 0:
            return replace(timing, frame_start_times=(-half,))
        return replace(
            timing,
            row_time=2.0 * timing.row_time,
            exposure_rows=0.5 * timing.exposure_rows,
            frame_rows=0.5 * timing.frame_rows,
            frame_start_times=(0.5 * timing.row_time - half,),
        )

    def _plane(self, plane: Frame, number: int, timing: SensorTiming, motion: Vibration) -> Frame:
        if number == 1 and plane.min() == plane.max():  # no colours
            return plane
        options = self.options if number == 0 else RestorationOptions(method="dewarp")
        level = self.layout.white if number == 0 and "clipped" in METHODS[options.method].masks else None
        scale = self.layout.full_scale
        images: Tensor = counts_to_frames(plane[None], scale, "the video").to(self.device)
        saturation = None if level is None else level / (scale or 1.0)
        prepared = prepare_frames(images, timing, saturation=saturation, channels="first")
        with torch.no_grad():
            restored = restore_prepared(prepared, motion, options)
        return frames_to_counts(prepared.from_row_order(restored)[0], self.layout.dtype, scale)
