"""Geometry of restored frames: scene coordinates, reference shift, visible pixels, frames restored together.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.core.free_memory import check_fits
from rsvib_torch.frames.column_strips import ColumnStrips
from rsvib_torch.frames.orientation import frames_from_row_order, offsets_from_row_order
from rsvib_torch.imaging.trajectory import exposure_trajectory, rows_showing
from rsvib_torch.motion.field import ColumnMotion
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import MAX_ROWS, RowTiming, SensorTiming

__all__ = ["FrameMotion", "frame_motion", "joint_groups", "visible_pixels"]


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """Motion of every frame of a batch of stacks, in row order, relative to the frame's own reference shift.

    A restored frame contains the scene at rest, moved by ``shift``: the displacement by the uniform image motion at
    the middle of the frame, rounded to whole pixels. A push-scan frame is thus restored in place. Without image motion
    the shift is zero.

    Attributes:
        vibration: The motion, batch shape (B,).
        timing: The sensor, in row order.
        frame_starts: (T,) seconds.
        shift: (B, T, 2) whole px, axes (x, y), float64.
        neglected: Standard deviation in px of the differences of the columns, where the motion is that of one of them.
    """

    vibration: Motion
    timing: RowTiming
    frame_starts: Tensor
    shift: Tensor
    neglected: float = 0.0

    def frame_rows(self, scene_rows: Tensor) -> Tensor:
        """Frame rows (B, T, S) that contain rows (S,) of the restored frames."""
        return rows_showing(
            scene_rows - self.shift[..., 1, None], self.frame_starts[:, None], self.timing, self.vibration
        )

    def _bounds(self, num_rows: int) -> Tensor:
        """Bound (B, T, axes) on the displacement in a frame of ``num_rows`` rows, beyond the shift, in px."""
        half = 0.5 * (num_rows * self.timing.row_time + self.timing.exposure_time)
        first, middle, last = (
            self.vibration.drift((self.frame_starts + delay).expand(len(self.shift), -1)).detach()
            for delay in (0.0, half, 2 * half)
        )
        drift = torch.maximum((first - middle).abs(), (last - middle).abs())
        return self.vibration.largest_oscillation()[:, None] + drift

    def check_fits(self, height: int, width: int) -> None:
        """Raise a ``ValueError`` if frames of this size, in row order, may move by more than their own size.

        No content is then certain to stay in the frame, and kernels and padding grow with the motion.
        """
        bounds = self._bounds(height).amax((0, 1)).tolist()
        for direction, bound, size in zip(("along", "across"), bounds, (width, height), strict=False):
            if not bound <= size:  # also NaN
                raise ValueError(
                    f"the motion {direction} the rows reaches {bound:.4g} px within a frame, more than its size of "
                    f"{size} px; check the unit of amplitudes (px) and image motion (px/s)"
                )

    def reaches(self, num_rows: int) -> list[int]:
        """For each stack, a bound on the displacement along one of ``num_rows`` rows, beyond the shift, in whole px."""
        return [math.ceil(reach + 0.5) for reach in self._bounds(num_rows)[..., 0].amax(1).tolist()]

    def reach(self, num_rows: int) -> int:
        """The largest of ``reaches``."""
        return max(self.reaches(num_rows))

    def row_starts(self, frame_rows: Tensor) -> Tensor:
        """Exposure starts of frame rows (B, T, S) in seconds."""
        return self.frame_starts[:, None] + frame_rows * self.timing.row_time

    def exposures(self, num_rows: int) -> tuple[Tensor, Tensor]:
        """Displacement (B, T, R, N, 2) in px of rows 0 ... R - 1 at N nodes of their exposures, and weights (N,)."""
        rows = torch.arange(num_rows, dtype=torch.float64, device=self.frame_starts.device)
        starts = self.row_starts(rows).expand(*self.shift.shape[:2], num_rows)
        return exposure_trajectory(self.vibration, starts, self.timing, "gauss")


def frame_motion(vibration: Motion, timing: RowTiming, num_frames: int, num_rows: int) -> FrameMotion:
    """Motion of ``num_frames`` frames of ``num_rows`` rows for a vibration of batch shape (B,) in row order."""
    starts = timing.frame_starts(num_frames, vibration.device)
    middle = starts + 0.5 * ((num_rows - 1) * timing.row_time + timing.exposure_time)
    shift = vibration.drift(middle.expand(*vibration.batch_shape, -1)).detach().round()
    return FrameMotion(vibration, timing, starts, shift)


def _of_column(motion: Motion, column: Tensor, timing: RowTiming, num_frames: int, num_rows: int) -> Motion:
    """Displacement (B) of a column in px from the centre of the frame, by a motion (B) in row order."""
    if motion.same_for_all_columns:
        return motion
    return ColumnMotion.of_columns(motion, column[None], timing, num_frames, num_rows)


@checks_arguments
def visible_pixels(
    timing: SensorTiming, vibration: Motion, size: tuple[int, int], num_frames: int
) -> tuple[Tensor, Tensor]:
    """Pixels of the restored frames that were exposed, and the shift of every restored frame.

    Pixels outside the mask were never exposed; restoration extends the frame there by mirroring.

    Args:
        timing: The sensor.
        vibration: The motion, in image axes; batch shape () or (B,).
        size: (height, width) of the frames.
        num_frames: Number of frames T.

    Returns:
        Boolean mask (T, H, W) or (B, T, H, W), and the whole-pixel shift (T, 2) or (B, T, 2), axes (x, y), by which
        content of the scene at rest is moved in each restored frame (zero without image motion).

    Example:
        >>> from rsvib_torch import Vibration
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> mask, shift = visible_pixels(timing, Vibration(2.0, 50.0), (512, 64), 2)
        >>> mask.shape, mask[:, 4:-4, 4:-4].all().item(), mask.all().item()
        (torch.Size([2, 512, 64]), True, False)
    """
    check_whole_number("num_frames", num_frames, at_least=1)
    height, width = (check_whole_number("size", side, at_least=1, at_most=MAX_ROWS) for side in size)
    batch = vibration.batch_shape
    if vibration.device.type == "cpu":
        needed = 25 * math.prod(batch) * num_frames * height * width  # float64 columns, their comparisons, masks
        check_fits(f"masks of num_frames={num_frames} frames of {height} x {width} px", needed, "pass fewer frames")
    height, width = (height, width) if timing.scan_axis == -2 else (width, height)
    rowwise, row_timing = vibration.to_row_order(timing), timing.in_row_order()
    row_timing.check_rows(height)
    rowwise = rowwise if batch else rowwise.expanded(1)
    strips = ColumnStrips.of(width, max_pitch=width if rowwise.same_for_all_columns else 16, margin=0)
    parts = []
    for first, last, column in zip(strips.edges[:-1], strips.edges[1:], strips.columns, strict=True):
        motion = frame_motion(
            _of_column(rowwise, column, row_timing, num_frames, height), row_timing, num_frames, height
        )
        motion.check_fits(height, width)
        rows = motion.frame_rows(torch.arange(height, dtype=torch.float64, device=vibration.device))
        starts = motion.row_starts(rows)
        displacement = (
            motion.vibration.mean_displacement(starts, timing.exposure_time)[..., 0] - motion.shift[..., 0, None]
        )
        columns = torch.arange(first, last, device=vibration.device) + displacement[..., None]
        visible_rows = ((rows >= 0) & (rows <= height - 1))[..., None]
        parts.append(visible_rows & (columns >= 0) & (columns <= width - 1))
    mask = frames_from_row_order(torch.cat(parts, -1), timing)
    shift = offsets_from_row_order(motion.shift, timing)
    return (mask, shift) if batch else (mask[0], shift[0])


def joint_groups(count: int, joint: bool | int) -> list[tuple[list[int], int]]:
    """Indices of the frames that are restored together, and the index of the reference frame, for every result.

    The result is in the coordinates of the reference frame.

    Args:
        count: Frames of the stack.
        joint: ``True``: all frames, with the middle one as reference; a number K: every frame with its neighbours,
            K in all; ``False``: every frame by itself.

    Example:
        >>> joint_groups(3, True)
        [([0, 1, 2], 1)]
        >>> joint_groups(3, 2)
        [([0, 1], 0), ([1, 2], 1), ([1, 2], 2)]
    """
    if joint is True:
        return [(list(range(count)), count // 2)]
    size = 1 if joint is False else min(check_whole_number("joint", joint, at_least=1), count)
    starts = [min(max(frame - (size - 1) // 2, 0), count - size) for frame in range(count)]
    return [(list(range(first, first + size)), frame) for frame, first in enumerate(starts)]
