"""Motion of the frames of a batch of stacks: scene coordinates, visible pixels, frames restored together, strips.

Restoration methods require a displacement that depends on the row only. With roll or zoom it changes slowly along a
row. Frames are then restored in strips of columns that overlap by half, each by the ``ColumnMotion`` of its middle, and
added up with triangular weights: between two middles, the displacement is interpolated linearly.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_whole_number, described
from rsvib_torch.files.reading import Table, check_fits
from rsvib_torch.frames.prepare import PreparedFrames, offsets_from_row_order
from rsvib_torch.imaging.trajectory import exposure_trajectory, places, recorded_offsets, rows_showing
from rsvib_torch.motion.camera import largest_in_frame, largest_slope
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import ColumnMotion, ColumnStrips, Motion
from rsvib_torch.motion.timing import MAX_ROWS, RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.options import RestorationOptions
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """Motion of every frame of a batch of stacks, in row order.

    A restored frame contains the scene at rest, moved by ``shift``: the displacement by the uniform image motion at
    the middle of the frame, rounded to whole pixels. A push-scan frame is thus restored in place. Without image motion
    the shift is zero.
    """

    vibration: Motion  # the motion, batch shape (B,)
    timing: RowTiming  # the sensor, in row order
    frame_starts: Tensor  # (T,) seconds
    shift: Tensor  # (B, T, 2) whole px, axes (x, y), float64
    num_rows: int  # rows of a frame
    # standard deviation in px of the displacement of the columns of a strip about that of its middle, which is that
    # of all columns in this motion. Only the exact method with ``scale=2`` uses it
    neglected: float = 0.0

    def of(self, stacks: list[int], frames: list[int] | None = None) -> "FrameMotion":
        """The motion of some stacks of the batch, and of some of their frames; None for all."""
        if frames is None and stacks == list(range(len(self.shift))):
            return self
        members = slice(None) if frames is None else frames
        vibration = self.vibration.mapped(lambda values: values[stacks])
        shift = self.shift[stacks][:, members]
        return replace(self, vibration=vibration, frame_starts=self.frame_starts[members], shift=shift)

    def frame_rows(self, scene_rows: Tensor) -> tuple[Tensor, Tensor]:
        """Frame rows (B, T, S) that contain rows (S,) of the restored frames, and their ``mean_displacement``."""
        rows, displacement = rows_showing(
            scene_rows - self.shift[..., 1, None], self.frame_starts[:, None], self.timing, self.vibration
        )
        return rows, displacement - self.shift[..., None, :]

    @cached_property
    def bounds(self) -> list[list[float]]:
        """Bound on the displacement in any frame of each stack, beyond the shift, in px along (x, y)."""
        half = 0.5 * (self.num_rows * self.timing.row_time + self.timing.exposure_time)
        delays = torch.tensor([0.0, half, 2 * half], dtype=torch.float64, device=self.shift.device)
        times = self.frame_starts[:, None] + delays
        moved = self.vibration.drift(times.expand(len(self.shift), -1, -1)).detach()
        drift = (moved - moved[:, :, 1:2]).abs().amax((1, 2))
        return (self.vibration.largest_oscillation() + drift).tolist()

    def check_fits(self, width: int) -> None:
        """Raise a ``ValueError`` if frames of so many columns, in row order, may move by more than their own size.

        No content is then certain to stay in the frame, and kernels and padding grow with the motion.
        """
        largest = np.array(self.bounds).max(0)[:2].tolist()
        for direction, bound, size in zip(("along", "across"), largest, (width, self.num_rows), strict=True):
            if not bound <= size:  # also NaN
                raise ValueError(
                    f"the motion {direction} the rows reaches {bound:.4g} px within a frame, more than its size of "
                    f"{size} px; check the unit of amplitudes (px) and image motion (px/s)"
                )

    def displacement_bound(self) -> int:
        """Bound on the displacement along a row of any stack, beyond the shift, in whole px."""
        return max(math.ceil(bounds[0] + 0.5) for bounds in self.bounds)

    def row_starts(self, frame_rows: Tensor) -> Tensor:
        """Exposure starts of frame rows (B, T, S) in seconds."""
        return self.frame_starts[:, None] + frame_rows * self.timing.row_time

    @cached_property
    def exposures(self) -> tuple[Tensor, Tensor]:
        """Displacement (B, T, R, N, 2) in px of all rows at N nodes of exposures, with the shift; and weights (N,)."""
        rows = torch.arange(self.num_rows, dtype=torch.float64, device=self.frame_starts.device)
        starts = self.row_starts(rows).expand(*self.shift.shape[:2], self.num_rows)
        with torch.enable_grad():  # the first use may be an estimate without gradients
            return exposure_trajectory(self.vibration, starts, self.timing, "gauss")

    @cached_property
    def mean_displacement(self) -> Tensor:
        """Mean displacement (B, T, R, 2) in px of all rows during their exposures, beyond the shift."""
        displacement, node_weights = self.exposures
        with torch.enable_grad():
            return (displacement * node_weights[:, None]).sum(-2) - self.shift[:, :, None]

    @cached_property
    def blur_lengths(self) -> NDArray[np.float64]:
        """Largest range (B, T, 2) of the displacement along (x, y) during the exposure of a row, in px."""
        low, high = self.exposures[0].detach().aminmax(dim=-2)
        return (high - low).amax(2).cpu().numpy()


def frame_motion(vibration: Motion, timing: RowTiming, starts: Tensor, num_rows: int) -> FrameMotion:
    """Motion of frames of ``num_rows`` rows that start at ``starts`` (T,) in s, for a vibration (B,) in row order."""
    middle = starts + timing.time_to_middle(num_rows)
    shift = vibration.drift(middle.expand(*vibration.batch_shape, -1)).detach().round()
    return FrameMotion(vibration, timing, starts, shift, num_rows)


def motion_of_frames(frames: PreparedFrames, vibration: Motion) -> FrameMotion:
    """Motion of prepared frames by a vibration in image axes, batch shape () or (B,); one of another batch is refused.

    Roll and zoom remain in the vibration: ``restore_in_strips`` makes strips of columns of such frames.
    """
    batch, count, _, height, _ = frames.images.shape
    if vibration.batch_shape not in ((), (batch,)) or (vibration.batch_shape and not frames.batched):
        raise ValueError(
            f"vibration of batch shape {tuple(vibration.batch_shape)} does not fit frames of shape {frames.shape}; "
            "one vibration, or one per stack of a (B, T, C, H, W) batch"
        )
    motion = vibration.to_row_order(frames.image_timing).to(frames.images.device)
    motion = motion if motion.batch_shape else motion.expanded(batch)
    return frame_motion(motion, frames.timing, frames.timing.frame_starts(count, motion.device), height)


@dataclass(frozen=True, eq=False)
class MovingFrames:
    """Frames of B stacks in row order, as a restoration method takes them: with their motion and masks."""

    images: Tensor  # (B, T, C, H, W) float32 or float64, full scale 1, finite; local means at missing pixels
    motion: FrameMotion
    ignore: Tensor | None = None  # bool tensor shaped like the images, pixels without data; None for none
    clipped: Tensor | None = None  # likewise, saturated pixels, whose values are lower bounds
    colours: Tensor | None = None  # (B, T, 1, H, W), the colour 0 to 2 that each pixel of a mosaic measures
    strips: int = 1  # number of neighbouring stacks that are strips of columns of the same frames

    @classmethod
    def of(cls, frames: PreparedFrames, motion: FrameMotion) -> "MovingFrames":
        """Prepared frames with their motion."""
        return cls(frames.filled, motion, frames.missing, frames.saturated, frames.colours)

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The frames with a change of images and masks."""
        tensors = ((field.name, getattr(self, field.name)) for field in fields(self))
        changed: Table = {name: change(values) for name, values in tensors if isinstance(values, Tensor)}
        return replace(self, **changed)


Method = Callable[[MovingFrames, RestorationOptions], Tensor]  # see ``METHODS`` of restore.py


@checks_arguments
def visible_pixels(
    timing: SensorTiming, vibration: Motion, size: tuple[int, int], num_frames: int
) -> tuple[Tensor, Tensor]:
    """Pixels of the restored frames that were exposed, and the shift of every restored frame.

    Pixels outside the mask were never exposed: ``restore`` extrapolates or mirrors the frame there.

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
    limits = np.array([width, height])[:, None, None] - 1
    rows, columns = (height, width) if timing.scan_axis == -2 else (width, height)
    row_timing = timing.in_row_order()
    row_timing.check_rows(rows)
    masks, shifts = [], []
    for one in [vibration[stack] for stack in range(batch[0])] if batch else [vibration]:
        motion = one.detached()
        bounding: Motion = motion.to_row_order(timing).expanded(1)
        starts = row_timing.frame_starts(num_frames, motion.device)
        of_frames = frame_motion(bounding, row_timing, starts, rows)
        shift = offsets_from_row_order(of_frames.shift, timing)[0, :, :2]
        if not motion.same_for_all_columns:
            ends = torch.tensor([-0.5, 0.5], dtype=torch.float64, device=motion.device) * (columns - 1)
            bounding = ColumnMotion.of_columns(bounding, ends, row_timing, num_frames, rows)
            of_frames = frame_motion(bounding, row_timing, starts, rows)
        of_frames.check_fits(columns)
        for frame in range(num_frames):
            # the place in the frame where each pixel of the restored frame was recorded
            offsets, weights = recorded_offsets(motion, timing, (height, width), frame, shift[frame])
            recorded = places(offsets, weights, timing, (height, width), np.float64)
            masks.append(((recorded >= 0) & (recorded <= limits)).all(0))
        shifts.append(shift)
    mask = torch.from_numpy(np.stack(masks)).to(vibration.device)
    return mask.view(*batch, num_frames, height, width), torch.stack(shifts).view(*batch, num_frames, 2)


def joint_groups(count: int, joint: bool | int) -> list[tuple[list[int], int]]:
    """Indices of the frames that are restored together, and the index of the reference frame, for every result.

    With ``joint=True`` all frames, with the middle one as reference; a number K: every frame with its neighbours, K in
    all; ``False``: every frame by itself. The result is in the coordinates of the reference frame.
    """
    if joint is True:
        return [(list(range(count)), count // 2)]
    size = 1 if joint is False else min(check_whole_number("joint", joint, at_least=1), count)
    starts = [min(max(frame - (size - 1) // 2, 0), count - size) for frame in range(count)]
    return [(list(range(first, first + size)), frame) for frame, first in enumerate(starts)]


# px, difference of the displacements of neighbouring strips; frames of 384 x 384 px with roll of 0.5 px at their ends
# are restored to 53.77 dB, with 0.16 px to 53.83 dB in 1.2 times the time, with 0.25 px to 53.61 dB
_SLIDE = 0.2
_PITCHES = (48, 160)  # px, bounds on the distance of the strips: narrow ones cost time, wide ones memory
# px of a strip without weight, beyond the displacement; the restoration is not exact near its ends. With 24 px, the
# restored frames of 384 x 384 px have at most 0.02 dB more, with exposures of 20 to 400 rows
_MARGIN = 8


def _strips(motion: Motion, size: tuple[int, int], first: float, last: float) -> tuple[ColumnStrips, float]:
    """Strips for frames of (height, width), for a motion (B) between two times in seconds.

    Also the standard deviation in px of the displacement of their columns about that of their middle.
    """
    reached = motion.largest_displacement(first, last)
    slope = float(largest_slope(reached, size[1], size[0], motion.camera).amax())
    narrowest, widest = _PITCHES
    pitch = min(max(_SLIDE / max(slope, 1e-9), narrowest), widest)
    moving = torch.cat([motion.largest_oscillation()[..., :2], reached[..., 2:]], -1)
    along = float(largest_in_frame(moving, size[1], size[0], motion.camera)[..., 0].amax())
    strips = ColumnStrips.of(size[1], pitch, _MARGIN + math.ceil(along))
    centres = (first + 0.5 * (strips.width - 1) for first in strips.firsts)
    distance = max(abs(centre - middle) for centre, middle in zip(centres, strips.middles, strict=True))
    return strips, slope * math.hypot(strips.width / math.sqrt(12), distance)


def restore_in_strips(method: Method, frames: MovingFrames, options: RestorationOptions) -> Tensor:
    """Frames restored by one of ``METHODS``, in strips of columns if the motion has roll or zoom."""
    motion, timing = frames.motion, frames.motion.timing
    count, (height, width) = frames.images.shape[1], frames.images.shape[-2:]
    if motion.vibration.same_for_all_columns:
        motion.check_fits(width)
        return method(frames, options)
    first, last = motion.frame_starts[[0, -1]].tolist()
    end = last + height * timing.row_time + timing.exposure_time
    strips, neglected = _strips(motion.vibration, (height, width), first, end)
    of_strips = ColumnMotion.of_columns(motion.vibration, strips.columns, timing, count, height)
    of_frames = replace(frame_motion(of_strips, timing, motion.frame_starts, height), neglected=neglected)
    of_frames.check_fits(width)
    cut = replace(frames.mapped(strips.cut), motion=of_frames, strips=len(strips.firsts))
    restored = method(cut, options)
    return strips.joined(restored)


class RestorationWarning(UserWarning):
    """A restored frame may be worse than the raw one, or a part of the vibration was not undone."""


def warn_of_restoration(message: str) -> None:
    """Raise a ``RestorationWarning`` that refers to the line of the caller of the package."""
    package = __name__.partition(".")[0]
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, RestorationWarning, stacklevel=level)


@checks_arguments
def trusted_vibration(detected: DetectedVibration, timing: SensorTiming) -> tuple[Vibration, tuple[Reason, ...]]:
    """The part of a detected vibration that is accurate enough to be undone.

    The amplitude and the image motion of an axis are set to zero if the axis is not reliable, or if the variance of its
    displacement exceeds half of the mean square displacement: its rows stay where they are. Two frames that are
    displaced as a whole have the same offsets as frames that move uniformly, so that an image motion without a
    reliable tone is not known.

    Args:
        detected: A detection.
        timing: The sensor.

    Returns:
        The vibration, and a ``Reason`` for each axis that is not restored.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> blind = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 83.0], phase=[0.5, 1.0])  # Hz; 83.3 is blind
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, blind, num_frames=2)
        >>> detection = rsv.detect_vibration(frames, timing)
        >>> vibration, (reason,) = rsv.trusted_vibration(detection, timing)
        >>> (vibration.amplitude[:, 0] > 0).tolist(), reason.code, reason.axis
        ([True, False], 'axis_not_reliable', 'y')
    """
    vibration, std = detected.vibration, detected.std_if_hidden_tone or detected.std
    amplitude = vibration.amplitude
    reliable = torch.as_tensor(detected.reliable, dtype=torch.bool, device=vibration.device)
    # rms displacement A sinc(f T_e) / sqrt(2) of the rows, and its standard deviation; if that is not stated, by those
    # of amplitude and phase
    attenuation = 0.5 * torch.sinc(vibration.frequency * timing.exposure_time).square()
    size = (attenuation * amplitude.square()).sum(-1).sqrt()
    if std.displacement is None:
        relative = (std.amplitude.to(amplitude) / amplitude).square() + std.phase.to(amplitude).square()
        error = torch.where(amplitude > 0, attenuation * amplitude.square() * relative, 0.0).sum(-1).sqrt()
    else:
        error = torch.where((amplitude > 0).any(-1), std.displacement.to(amplitude), 0.0)
    error = error.nan_to_num(nan=math.inf)
    accurate = error.square() <= 0.5 * size.square()
    # of all stacks and axes in one transfer
    figures = torch.stack([error, size, reliable.to(error), accurate.to(error)], -1)
    batched = len(vibration.batch_shape) > 0
    left_alone = []
    for stack, of_axes in enumerate(figures.view(-1, *figures.shape[-2:]).tolist()):
        reasons = detected.reasons[stack] if batched else detected.reasons
        where: dict[str, float | str] = {"action": "restored"} | ({"stack": stack} if batched else {})
        for axis, (value, is_moving, is_reliable, is_accurate) in enumerate(of_axes):
            name = AXIS_NAMES[axis]
            if not is_reliable:
                left_alone.append(Reason("axis_not_reliable", name, details=where | {"why": "; ".join(reasons[axis])}))
            elif not is_accurate:
                details = where | {"size": is_moving, "unit": ("px", "px", "rad", "(zoom)")[axis]}
                left_alone.append(Reason("axis_not_accurate", name, value, math.sqrt(0.5) * is_moving, details))
    return vibration.scaled(reliable & accurate), tuple(left_alone)


def vibration_to_undo(vibration: Motion | DetectedVibration, timing: SensorTiming) -> tuple[Motion, tuple[Reason, ...]]:
    """A given motion unchanged; of a detection the accurate part, and a reason for each axis not restored."""
    if isinstance(vibration, Motion):
        return vibration, ()
    if not isinstance(vibration, DetectedVibration):
        made_by = DetectedVibration._MADE_BY
        raise TypeError(f"vibration must be a Motion or a DetectedVibration ({made_by}), got {described(vibration)}")
    return trusted_vibration(vibration, timing)
