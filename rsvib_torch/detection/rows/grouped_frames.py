"""Measurement of the rows of grouped frames for a fit: of whole rows, or of strips of columns for roll and zoom.

Invariant: the displacement depends on the row only (docs/architecture.md), in each strip.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements, trimmed_mean
from rsvib_torch.detection.rows.displacements import (
    FrameGroups,
    MeasuredGroup,
    blur_ratio,
    column_pattern_of,
    differential_motion,
    displacements_of_parts,
    frame_groups,
    joined_groups,
    measure_group,
    measure_strips,
    stack_spectra,
    uneven_motion,
)
from rsvib_torch.detection.rows.warping import differently_blurred
from rsvib_torch.detection.start import FieldScale
from rsvib_torch.execution.progress import steps
from rsvib_torch.motion.camera import largest_slope
from rsvib_torch.motion.motion import ColumnMotion, ColumnStrips, Motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.tables import Array, table, take_stacks, tensor
from rsvib_torch.registration.gradients import RowGradients
from rsvib_torch.registration.row_spectra import MARGIN


@dataclass(frozen=True, eq=False)
class MeasuredRows:
    """One round of measurements."""

    measurements: Measurements  # the components of the motion of every row
    gradients: list[RowGradients]  # gradients of the scene, for further rounds
    # (B, N, 2) px^2, mean square difference of the displacements of strips from these components, less that by noise;
    # None if rows were measured as a whole
    strip_variance: Array | None = None

    @property
    def num_stacks(self) -> int:
        """Number B of stacks."""
        return len(self.measurements.visible)

    def stacks(self, stacks: Array) -> "MeasuredRows":
        """The measurements of some stacks."""
        gradients = []
        for part in self.gradients:
            group_indices = np.arange(len(part.variance)).reshape(self.num_stacks, -1)[stacks].ravel()
            gradients.append(part.stacks(tensor(group_indices).to(part.variance.device)))
        strip_variance = None if self.strip_variance is None else self.strip_variance[stacks]
        return MeasuredRows(take_stacks([self.measurements], stacks), gradients, strip_variance)

    def differential(self) -> Array:
        """(B, 2) px, rms difference of the displacements along a row that the components do not explain."""
        if self.strip_variance is None:
            return differential_motion(self.gradients, self.num_stacks)
        return np.sqrt(np.maximum(trimmed_mean(self.strip_variance), 0.0))

    def uneven(self) -> Array:
        """(B, 2) px, the part of the differences along a row that roll and zoom cannot explain."""
        if self.strip_variance is None:
            return uneven_motion(self.gradients, self.num_stacks)
        return self.differential()

    def row_variance(self) -> Array:
        """(B, M, S) residual variance of every row of M groups, see ``RowGradients``."""
        return np.concatenate([table(part.variance.unflatten(0, (self.num_stacks, -1))) for part in self.gradients], 1)

    def aliasing(self) -> Array:
        """(B,) px, expected size of the bias by aliasing, see ``RowGradients``."""
        parts = [gradients.aliasing.unflatten(0, (self.num_stacks, -1)) for gradients in self.gradients]
        return table(torch.cat(parts, 1).mean(1))


@dataclass(frozen=True, eq=False)
class GroupedFrames:
    """Frames whose rows are measured as a whole."""

    groups: list[FrameGroups]  # the frames
    timing: RowTiming  # the sensor, in row order

    unit: ClassVar[str] = "groups"  # of the progress

    def measure(
        self, motion: Vibration | FreeMotion, gradients: list[RowGradients] | None = None, *, keep_images: bool = True
    ) -> MeasuredRows:
        """All groups measured around a motion, as one record; ``keep_images`` for further rounds."""
        start_gradients = [None] * len(self.groups) if gradients is None else gradients
        count, view = sum(group.count for group in self.groups), self.view(motion)
        parts, scene, advance = [], list[RowGradients](), steps(count, self.unit)
        for group, known_gradients in zip(self.groups, start_gradients, strict=True):
            measured, group_gradients = self.measure_group(group, motion, view, known_gradients)
            parts.append(measured)
            scene.append(group_gradients if keep_images else group_gradients.without_images())
            advance(group.count)
        return MeasuredRows(joined_groups(parts, self.timing.exposure_time, count), scene, self.strip_variance(scene))

    def measure_group(
        self, group: FrameGroups, motion: Motion, view: Motion, gradients: RowGradients | None
    ) -> tuple[MeasuredGroup, RowGradients]:
        """``displacements.measure_group`` around a motion, of which ``view`` is the motion of the measured stacks."""
        return measure_group(group, self.timing, view, gradients)

    def strip_variance(self, gradients: list[RowGradients]) -> Array | None:
        """``MeasuredRows.strip_variance``."""
        return None

    def view(self, motion: Vibration | FreeMotion) -> Motion:
        """The motion of the stacks that are measured, with two components."""
        return motion

    def rows_of(self, stacks: Array) -> Tensor:
        """Indices of stacks in the batch of the groups."""
        return tensor(stacks).to(self.groups[0].starts.device)

    def stacks(self, stacks: Array) -> Self:
        """The frames of some stacks; they are copied."""
        rows = self.rows_of(stacks)
        return replace(self, groups=[group.stacks(rows) for group in self.groups])

    def column_pattern(self, motion: Vibration | FreeMotion, row_variance: Array) -> Tensor:
        """Spectrum of a pattern of columns in each row of the batch, see ``column_pattern_of``."""
        return column_pattern_of(self.groups, self.timing, self.view(motion), row_variance)

    def without(self, pattern: Tensor) -> Self:
        """The frames without a pattern of columns."""
        return replace(self, groups=[replace(group, spectra=group.spectra.without(pattern)) for group in self.groups])

    def blur_ratio(self, motion: Vibration | FreeMotion) -> Tensor:
        """(B, 3) ratio, standard deviation and size as in ``displacements.blur_ratio``."""
        return blur_ratio(self.groups, self.timing, self.view(motion))

    def differently_blurred(self, motion: Vibration) -> Array:
        """Whether the frames of any group of each stack are blurred differently, (B,) bool, as in ``warping``."""
        view, height = self.view(motion), self.groups[0].spectra.height
        different = (
            differently_blurred(group.starts_of_groups, height, self.timing, group.motion_of_groups(view))[0]
            for group in self.groups
        )
        return table(torch.cat([part.unflatten(0, (len(motion.amplitude), -1)) for part in different], 1).any(1))


def grouped_frames(
    frames: Tensor, valid: Tensor | None, timing: RowTiming, motion: Vibration | FreeMotion
) -> GroupedFrames:
    """Frames (B, T, H, W) in groups for a first estimate of a motion of two components.

    Pairs, whose blur can be equalised, are enough for tones; a free motion needs all frames that contain a row.
    """
    pairs: Literal["never", "very different"] = "never" if isinstance(motion, FreeMotion) else "very different"
    return GroupedFrames(frame_groups(stack_spectra(frames, valid), timing, motion, pairs=pairs), timing)


# Strips

_MAX_SLIDE_OF_BLUR = 0.15  # px
# px, difference of the displacements by roll and zoom of two neighbouring strips: the second order of their
# interpolation blurs as an exposure with a path of this length; and their distance: narrower ones are margins mostly
_MAX_SLIDE, _MIN_PITCH = 0.1, 48


def _pitch(slope: float) -> float:
    """The distance of strips in px where the displacement changes by ``slope`` px per column."""
    return max(_MIN_PITCH, _MAX_SLIDE / max(slope, 1e-9))


def _in_rad(motion: Vibration | FreeMotion, scale: FieldScale) -> Vibration | FreeMotion:
    """The motion with roll in rad and relative zoom."""
    return scale.free_motion(motion) if isinstance(motion, FreeMotion) else scale.motion(motion)


def _slope(field: Vibration | FreeMotion, scale: FieldScale, starts: Tensor) -> float:
    """Bound in px on the change of the displacement per column, by a motion between the first and the last start."""
    reached = field.largest_displacement(float(starts.amin()), float(starts.amax()))
    return float(largest_slope(reached, scale.width, scale.height, scale.camera).amax())


@dataclass(frozen=True, eq=False)
class GroupedStrips(GroupedFrames):
    """Frames whose strips of columns are measured."""

    scale: FieldScale  # components of the motion
    strips: ColumnStrips  # the strips
    columns: Tensor  # (S,) px from the centre of the frame, middles of the strips
    num_frames: int  # frames of a stack
    slide: float  # px, difference of the displacements of the middle of a strip and its ends

    unit: ClassVar[str] = "groups of strips"

    def measure_group(
        self, group: FrameGroups, motion: Motion, view: Motion, gradients: RowGradients | None
    ) -> tuple[MeasuredGroup, RowGradients]:
        """Components (B, N, G, A) of the motion of the rows of a group."""
        return measure_strips(group, self.timing, motion, view, self.strips, self.scale.factors, gradients)

    def strip_variance(self, gradients: list[RowGradients]) -> Array:
        """``MeasuredRows.strip_variance``."""
        excesses = []
        for group_gradients in gradients:
            residual, noise, regular = displacements_of_parts(group_gradients)
            share = 1 - 0.5 * self.scale.axes / residual.shape[2]  # the fit of the components reduces both
            excess = 0.5 * (residual.square() - share * noise).mean(2) / share
            excesses.append(torch.where(regular[..., None], excess, torch.nan))
        return table(torch.cat(excesses, 1))

    def rows_of(self, stacks: Array) -> Tensor:
        """Indices of the strips of stacks in the batch of the groups."""
        count = len(self.columns)
        return super().rows_of((stacks[:, None] * count + np.arange(count)).ravel())

    def column_pattern(self, motion: Vibration | FreeMotion, row_variance: Array) -> Tensor:
        """As for whole rows: all strips of a row have the same noise."""
        return super().column_pattern(motion, np.repeat(row_variance, len(self.columns), 0))

    def view(self, motion: Vibration | FreeMotion) -> Motion:
        """The motions of the strips (B S)."""
        field = _in_rad(motion, self.scale)
        return ColumnMotion.of_columns(field, self.columns, self.timing, self.num_frames, self.scale.height)

    def suits(self, motion: Vibration) -> bool:
        """Whether strips that are not much narrower would be chosen for a motion in px."""
        starts = self.timing.row_starts(self.num_frames, self.scale.height)
        pitch = float(self.columns[1] - self.columns[0])
        slope = _slope(_in_rad(motion, self.scale), self.scale, starts)
        # a second fit takes as long as the first; strips that are slightly too wide caused no bias that was measured
        return pitch <= 1.5 * _pitch(slope)

    def blur_ratio(self, motion: Vibration | FreeMotion) -> Tensor:
        """(B, 3), the weighted mean over every second strip: they contain all columns.

        A displacement that changes within a strip acts like blur: with a focal length of 400 px and 5 px, where the
        ends of strips slide by 0.3 px, the ratio was 0 instead of 1. Its size is then set to 0, so that it is ignored.
        """
        place = torch.arange(len(self.groups[0].starts), device=self.columns.device)
        index = place[place % len(self.columns) % 2 == 0]
        every_second = replace(self, groups=[group.stacks(index) for group in self.groups], columns=self.columns[::2])
        strip_ratios = GroupedFrames.blur_ratio(every_second, motion)
        ratio, std, size = strip_ratios.unflatten(0, (-1, len(every_second.columns))).unbind(-1)
        weight = torch.where(std > 0, std.square().reciprocal(), 0.0)
        total = weight.sum(1).clamp(min=1e-300)
        size = size.mean(1) if self.slide < _MAX_SLIDE_OF_BLUR else torch.zeros_like(total)
        return torch.stack([(weight * ratio).sum(1) / total, total.rsqrt(), size], -1)


def grouped_strips(
    frames: Tensor,
    valid: Tensor | None,
    timing: RowTiming,
    motion: Vibration | FreeMotion,
    scale: FieldScale,
    *,
    pairs: bool = True,
) -> GroupedStrips:
    """Frames (B, T, H, W) in strips of columns, for a motion in px; in ``pairs`` if they are blurred differently."""
    field, count = _in_rad(motion, scale), frames.shape[1]
    starts = timing.row_starts(count, scale.height, frames.device)[:, :: max(1, scale.height // 64)].flatten()
    ends = 0.5 * scale.width * torch.tensor([-1.0, 1.0], dtype=torch.float64, device=frames.device)
    end_motion = ColumnMotion.of_columns(field, ends, timing, count, scale.height)
    times = starts.expand(*end_motion.batch_shape, -1)
    at_ends = end_motion.mean_displacement(times, timing.exposure_time)[..., 0] - end_motion.drift(times)[..., 0]
    margin = math.ceil(float(at_ends.abs().amax()) + 1.0) + MARGIN  # 1 px: whole pixels of an image motion
    slope = _slope(field, scale, starts)
    strips = ColumnStrips.of(scale.width, _pitch(slope), margin, at_ends=True)
    spectra = stack_spectra(frames, valid, strips)
    columns = strips.columns.to(frames.device)
    view = ColumnMotion.of_columns(field, columns, timing, count, scale.height)
    # in larger groups, the standard deviations behind a lens are half as large, with the same errors
    groups = frame_groups(spectra, timing, view, pairs="different" if pairs else "never", one_at_a_time=True)
    slide = slope * float(columns[1] - columns[0])
    return GroupedStrips(groups, timing, scale, strips, columns, count, slide)
