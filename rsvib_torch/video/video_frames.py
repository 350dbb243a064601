"""Restoration of one frame of a video: its planes.

Invariant: the displacement depends on the row only (docs/architecture.md); with roll and zoom also linearly on the
column.
"""

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv1d, embedding_bag

from rsvib_torch.execution.parallel import chunks, prefetched
from rsvib_torch.frames.full_scale import counts_to_frames, frames_to_counts
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.imaging.trajectory import places, recorded_offsets
from rsvib_torch.io.video import Picture, VideoReader
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.interpolation import mirrored
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import eight_bits
from rsvib_torch.restoration.restore import WITH_SATURATION, restore_prepared
from rsvib_torch.stacks.job import StackJob, stored_frame

_AHEAD = 4  # frames decoded before they are used
_LOBES = 4  # of the kernel of Lanczos on each side
# of pixels, or of Y and chroma: Y has 44.8 dB with Lanczos and 44.5 dB with the cubic kernel, chroma 46.9 and 47.0 dB
_KERNELS = cv2.INTER_LANCZOS4, cv2.INTER_CUBIC

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
        """Planes of a restored frame, as taken if it could not be used."""
        planes, method = self.planes(frame), self.job.chosen.method
        if track.fault is not None or not bool(track.motion.moving_axes().any()):
            return planes
        results: list[Frame] = []
        for number, plane in enumerate(planes):
            motion = track.motion if number == 0 else _on_half_pixels(track.motion)
            timing = self.timing_of(number, track.index)
            separately = number == 0 and method != "dewarp"
            if separately and isinstance(motion, Vibration) and bool((motion.amplitude > 0).any()):
                # The method undoes what varies between the rows along x and y, and the rest is moved afterwards.
                rowwise = motion.translation()
                plane = self._without_vibration(plane, timing, replace(rowwise, image_shift=torch.zeros(2)))  # noqa: PLW2901
                rest = {name: getattr(motion, name).clone() for name in ("image_motion", "image_acceleration")}
                for values in rest.values():
                    values[:2] = 0.0
                motion = replace(motion, amplitude=torch.zeros_like(motion.amplitude), **rest)
            offsets, weights = recorded_offsets(motion, timing, plane.shape[-2:])
            if len(weights) == 1:  # all columns are displaced alike
                results.append(_with_rows_moved(plane, offsets[..., 0], rows_first=timing.scan_axis == -2))
            else:
                source = places(offsets, weights, timing, plane.shape[-2:])
                results.append(_with_pixels_moved(plane, source, _KERNELS[number]))
        return results

    def timing_of(self, plane: int, index: int) -> SensorTiming:
        """Timing of a plane of a frame, with the time origin in its middle; rows of chroma lie between two of luma."""
        timing = self.job.timing
        if self.exposures is not None:
            rows = float(self.exposures[index]) / timing.row_time
            timing = replace(timing, exposure_rows=min(rows, timing.frame_rows))
        half = timing.time_to_middle(self.size[int(timing.scan_axis)])  # of this frame
        if plane == 0:
            return replace(timing, frame_start_times=(-half,))
        return replace(
            timing,
            row_time=2.0 * timing.row_time,
            exposure_rows=0.5 * timing.exposure_rows,
            frame_rows=0.5 * timing.frame_rows,
            frame_start_times=(0.5 * timing.row_time - half,),
        )

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


def _with_pixels_moved(plane: Frame, source: NDArray[np.float32], kernel: int) -> Frame:
    """Pixels (..., H, W) interpolated at places (2, H, W); beyond the border, the plane is mirrored."""
    stored = plane if plane.dtype in (np.uint8, np.uint16, np.float32) else plane.astype(np.float32)
    x, y = np.ascontiguousarray(source[0]), np.ascontiguousarray(source[1])
    flat = stored.reshape(-1, *stored.shape[-2:])
    moved = np.stack([cv2.remap(one, x, y, kernel, borderMode=cv2.BORDER_REFLECT_101) for one in flat])
    return _as_counts(moved.reshape(plane.shape), plane.dtype)


def _with_rows_moved(plane: Frame, offsets: Array, *, rows_first: bool) -> Frame:
    """Pixels (..., H, W) interpolated at offsets (2, n) along x and y that all pixels of a row of the sensor share.

    Interpolation first across and then along the rows takes a third of the time of ``_with_pixels_moved``.
    """
    flat = plane.reshape(-1, *plane.shape[-2:])
    along, across = offsets if rows_first else offsets[::-1]
    rows = np.ascontiguousarray(flat if rows_first else flat.swapaxes(-1, -2), dtype=np.float32)
    count, length = rows.shape[-2:]
    first, of_rows = _lanczos_taps(np.arange(count) + across)
    taps = mirrored(torch.from_numpy(first[:, None] + np.arange(2 * _LOBES)), count)
    begin, of_columns = _lanczos_taps(along)
    before, behind = max(0, -begin.min()), max(0, begin.max() + 2 * _LOBES - 1)
    moved = np.empty(rows.shape, plane.dtype)
    # Four images of float32 are made on the way. In blocks, Y of 1920 x 1080 px takes 14 ms instead of 25.
    blocks = chunks(count, 4 * rows.itemsize * length, torch.device("cpu"))
    for (one, result), block in product(zip(rows, moved, strict=True), blocks):
        # 1. Across the rows, then whole pixels along them.
        weights = torch.from_numpy(of_rows[block])
        mixed = embedding_bag(taps[block], torch.from_numpy(one), per_sample_weights=weights, mode="sum")
        wide = np.pad(mixed.numpy(), ((0, 0), (before, behind)), "reflect")
        shifted = sliding_window_view(wide, length + 2 * _LOBES - 1, 1)[np.arange(len(wide)), begin[block] + before]
        # 2. Parts of a pixel along the rows.
        kernels = torch.from_numpy(of_columns[block])[:, None]
        filtered = conv1d(torch.from_numpy(shifted)[None], kernels, groups=len(kernels))[0].numpy()
        result[block] = _as_counts(filtered, plane.dtype)
    image = moved if rows_first else moved.swapaxes(-1, -2)
    return image.reshape(plane.shape)


def _lanczos_taps(positions: Array) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The first pixels (N,) from which positions (N,) in px are interpolated, and the weights (N, 8) from there on."""
    cell = np.floor(positions)
    distance = (positions - cell)[:, None] - np.arange(1 - _LOBES, 1 + _LOBES)
    weights = np.sinc(distance) * np.sinc(distance / _LOBES)
    return cell.astype(np.int64) + 1 - _LOBES, (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def _as_counts(values: Frame, dtype: np.dtype) -> Frame:
    """Interpolated values, rounded in place if they are counts."""
    if values.dtype != dtype and dtype.kind in "iu":
        limits = np.iinfo(dtype)
        values = np.clip(np.rint(values, out=values), limits.min, limits.max, out=values)
    return values.astype(dtype, copy=False)


def _on_half_pixels(motion: Vibration | FreeMotion) -> Vibration | FreeMotion:
    """The motion in pixels of chroma, which are twice as large; roll and zoom are the same."""
    factors = torch.tensor([0.5, 0.5, 1.0, 1.0][: motion.num_axes], dtype=torch.float64)
    if isinstance(motion, Vibration):
        return motion.scaled(factors)
    camera = motion.camera and motion.camera.scaled(0.5)
    return FreeMotion(motion.coefficients * factors[:, None], motion.start, motion.spacing, camera=camera)
