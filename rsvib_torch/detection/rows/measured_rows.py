"""Rows of frames as they are measured for a fit: as a whole, or in strips of columns for roll and zoom.

Invariant: the displacement depends on the row only (docs/architecture.md), in each strip.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements, trimmed_mean
from rsvib_torch.detection.rows.displacements import (
    BLOCK_ROWS,
    FrameGroup,
    blur_ratio,
    differential_motion,
    differently_blurred,
    frame_groups,
    measure_groups,
    remove_column_pattern,
    slope_response,
    stack_spectra,
)
from rsvib_torch.detection.strips import FieldScale, combined_strips, cut_into_strips
from rsvib_torch.motion.field import ColumnMotion, largest_slope
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.registration.gradients import RowGradients
from rsvib_torch.registration.row_spectra import MARGIN

__all__ = ["MeasuredRows", "RowRecord", "strip_rows", "whole_rows"]


@dataclass(frozen=True, eq=False)
class RowRecord:
    """One round of measurements.

    Attributes:
        measurements: The components of the motion of every row.
        gradients: Gradients of the scene, for further rounds.
        apart: (B, N, 2) px^2, mean square difference of the displacements of strips from these components, less that by
            noise; None if rows were measured as a whole.
    """

    measurements: Measurements
    gradients: list[RowGradients]
    apart: Tensor | None = None

    def differential(self) -> Tensor:
        """(B, 2) px, rms difference of the displacements along a row that the components do not explain."""
        if self.apart is None:
            return differential_motion(self.gradients)
        return trimmed_mean(self.apart).clamp(min=0.0).sqrt()


@dataclass(frozen=True, eq=False)
class MeasuredRows:
    """Frames whose rows are measured as a whole.

    Attributes:
        groups: The frames.
        timing: The sensor, in row order.
    """

    groups: list[FrameGroup]
    timing: RowTiming
    slopes: ClassVar[bool] = False  # whether displacements change along the rows

    def measure(self, motion: Vibration | FreeMotion, gradients: list[RowGradients] | None = None) -> RowRecord:
        """Measurements around a motion, see ``measure_groups``."""
        return RowRecord(*measure_groups(self.groups, self.timing, self.view(motion), gradients, slopes=self.slopes))

    def view(self, motion: Vibration | FreeMotion) -> Motion:
        """The motion of the stacks that are measured, with two components."""
        return motion

    def remove_column_pattern(self, motion: Vibration | FreeMotion, gradients: list[RowGradients]) -> bool:
        """Subtract a pattern of columns that is fixed to the sensor; False if there is none."""
        return remove_column_pattern(self.groups, self.timing, self.view(motion), gradients)

    def blur_ratio(self, motion: Vibration) -> Tensor:
        """(B, 3) ratio, standard deviation and size as in ``displacements.blur_ratio``."""
        return torch.stack(blur_ratio(self.groups, self.timing, self.view(motion)), -1)

    def differently_blurred(self, motion: Vibration) -> bool:
        """Whether the frames of any group are blurred differently."""
        view = self.view(motion)
        height = self.groups[0].spectra.height
        return any(bool(differently_blurred(group.starts, height, self.timing, view).any()) for group in self.groups)


def whole_rows(frames: Tensor, valid: Tensor | None, timing: RowTiming, motion: Vibration) -> MeasuredRows:
    """Frames (B, T, H, W) in groups for a motion of two components.

    Args:
        frames: Grey frames in row order.
        valid: Their valid pixels, or None for all.
        timing: The sensor, in row order.
        motion: A first estimate of the motion.
    """
    spectra = stack_spectra(frames, valid)
    return MeasuredRows(frame_groups(spectra, timing, motion, pairs_if_blurred_differently=True), timing)


# Strips

_MAX_SLIDE_OF_BLUR = 0.15  # px


def _in_rad(motion: Vibration | FreeMotion, scale: FieldScale) -> Vibration | FreeMotion:
    """The motion with roll in rad and relative zoom."""
    return scale.free_motion(motion) if isinstance(motion, FreeMotion) else scale.motion(motion)


@dataclass(frozen=True, eq=False)
class StripRows(MeasuredRows):
    """Frames whose strips of columns are measured.

    Attributes:
        scale: Components of the motion.
        columns: (S,) px from the centre of the frame, middles of the strips.
        num_frames: Frames of a stack.
        slide: px, difference of the displacements of the middle of a strip and its ends.
    """

    scale: FieldScale
    columns: Tensor
    num_frames: int
    slide: float
    slopes: ClassVar[bool] = True

    def measure(self, motion: Vibration | FreeMotion, gradients: list[RowGradients] | None = None) -> RowRecord:
        """Components of the motion of every row (B, N, G, A), from the displacements in the strips.

        Roll moves the content of a scene row to different frame rows along the row, which are exposed at different
        times. The displacements are converted to the mean time of the row by the motion.
        """
        record = super().measure(motion, gradients)
        measured, (middles, factors) = record.measurements, self._factors(motion, record.gradients)
        starts = measured.exposure_starts.unflatten(0, (-1, len(self.columns)))  # (B, S, N, G)
        mean = starts.mean(1, keepdim=True).expand_as(starts)
        components = (motion.mean_displacement(when, self.timing.exposure_time) for when in (mean, starts))
        of_row, of_strips = components
        moved = torch.einsum("bsnia,bsnga->bsngi", factors, of_row - of_strips).flatten(0, 1)
        if self.scale.camera is not None:  # the displacement is not linear in the components
            linear = torch.einsum("bsnia,bsnga->bsngi", middles, of_strips).flatten(0, 1)
            exact = self.view(motion).mean_displacement(starts.flatten(0, 1), self.timing.exposure_time)
            moved = moved + linear - exact
        measured = replace(measured, displacements=measured.displacements + measured.relative(moved))
        measurements, apart = combined_strips(measured, factors)
        return RowRecord(measurements, record.gradients, apart)

    def view(self, motion: Vibration | FreeMotion) -> Motion:
        """The motions of the strips (B S)."""
        field = _in_rad(motion, self.scale)
        return ColumnMotion.of_columns(field, self.columns, self.timing, self.num_frames, self.scale.height)

    def _factors(self, motion: Vibration | FreeMotion, gradients: list[RowGradients]) -> tuple[Tensor, Tensor]:
        """Displacements (B, S, N, 2, A) by unit components in px: of the middles of strips, and those measured.

        Gradients measure a weighted mean of a displacement that changes along the row, which is not that of the middle
        of the strip (``slope_response``).
        """
        strips, view, each = len(self.columns), self.view(motion), []
        for group, own in zip(self.groups, gradients, strict=True):
            response = slope_response(own)  # (B S, N, 2, 2)
            middle = group.starts.mean(-1, keepdim=True) + 0.5 * self.scale.height * self.timing.row_time
            travelled = view.drift(middle).round()[..., 0, 1]  # as the scene rows of the group
            blocks = torch.arange(response.shape[1], device=response.device)
            rows = BLOCK_ROWS * (blocks + 0.5) - 0.5 * self.scale.height
            y = rows - travelled[:, None]
            x = self.columns.repeat(len(y) // strips)[:, None].expand_as(y)
            factors = self.scale.factors(x, y)
            along = self.scale.factors(x + 1, y) - factors  # change of the displacement per column
            each.append(torch.stack([factors, factors + response @ along]))
        of_middles, of_gradients = torch.cat(each, 2).unflatten(1, (-1, strips))
        return of_middles, of_gradients

    def blur_ratio(self, motion: Vibration) -> Tensor:
        """(B, 3), the weighted mean over the strips.

        A displacement that changes within a strip acts like blur: with a focal length of 400 px and 5 px, where the
        ends of strips slide by 0.3 px, the ratio was 0 instead of 1. Its size, which counts as evidence, is then 0.
        """
        ratio, std, size = super().blur_ratio(motion).unflatten(0, (-1, len(self.columns))).unbind(-1)
        weight = torch.where(std > 0, std.square().reciprocal(), 0.0)
        total = weight.sum(1).clamp(min=1e-300)
        size = size.mean(1) if self.slide < _MAX_SLIDE_OF_BLUR else torch.zeros_like(total)
        return torch.stack([(weight * ratio).sum(1) / total, total.rsqrt(), size], -1)


def strip_rows(
    frames: Tensor,
    valid: Tensor | None,
    timing: RowTiming,
    motion: Vibration | FreeMotion,
    scale: FieldScale,
    *,
    pairs_if_blurred_differently: bool = True,
    max_slide: float = 0.05,
    min_pitch: int = 48,
) -> StripRows:
    """Frames (B, T, H, W) in strips of columns.

    Args:
        frames: Grey frames in row order.
        valid: Their valid pixels, or None for all.
        timing: The sensor, in row order.
        motion: A first estimate of the motion, all components in px.
        scale: Components of the motion.
        pairs_if_blurred_differently: As in ``frame_groups``.
        max_slide: px, difference of the displacements of the middle of a strip and its ends; gradients measure
            such displacements without bias.
        min_pitch: Columns of a strip that count; narrower strips consist of their margins mostly.
    """
    field, count = _in_rad(motion, scale), frames.shape[1]
    starts = timing.row_starts(count, scale.height, frames.device)[:, :: max(1, scale.height // 64)].flatten()
    ends = 0.5 * scale.width * torch.tensor([-1.0, 1.0], dtype=torch.float64, device=frames.device)
    of_ends = ColumnMotion.of_columns(field, ends, timing, count, scale.height)
    times = starts.expand(*of_ends.batch_shape, -1)
    along = of_ends.mean_displacement(times, timing.exposure_time)[..., 0] - of_ends.drift(times)[..., 0]
    edge = math.ceil(float(along.abs().amax()) + 1.0) + MARGIN  # 1 px: whole pixels of an image motion
    reached = field.largest_displacement(float(starts[0]), float(starts[-1]))
    slope = float(largest_slope(reached, scale.width, scale.height, scale.camera).amax())
    pitch = max(min_pitch, 2 * max_slide / max(slope, 1e-9))
    number = max(2, math.ceil((scale.width - 2 * edge - MARGIN) / pitch))
    strips, columns = cut_into_strips(frames, number, edge)
    of_valid = None if valid is None else cut_into_strips(valid, number, edge)[0]
    spectra = stack_spectra(strips, of_valid)
    view = ColumnMotion.of_columns(field, columns, timing, count, scale.height)
    groups = frame_groups(spectra, timing, view, pairs_if_blurred_differently=pairs_if_blurred_differently)
    slide = 0.5 * slope * (scale.width - 2 * edge - MARGIN) / number
    return StripRows(groups, timing, scale, columns, count, slide)
