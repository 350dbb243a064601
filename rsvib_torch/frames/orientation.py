"""Row order: any scan axis and readout direction become rows on axis -2 with the row read first at index 0.

A transpose swaps the x and y components of displacements; a flip along the rows changes the sign of y. Both change the
sign of roll. This is the only place outside of motions (``Motion.from_row_order``) where components are permuted.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from torch import Tensor

from rsvib_torch.motion.timing import SensorTiming, row_axes
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason

Entry = TypeVar("Entry")


def frames_to_row_order(frames: Tensor, timing: SensorTiming) -> Tensor:
    """Turn frames (..., H, W) so that rows lie on axis -2 and row 0 is read first."""
    frames = frames.transpose(-2, -1) if timing.scan_axis == -1 else frames
    return frames.flip(-2) if timing.readout_direction == "reverse" else frames


def frames_from_row_order(frames: Tensor, timing: SensorTiming) -> Tensor:
    """Inverse of ``frames_to_row_order``."""
    frames = frames.flip(-2) if timing.readout_direction == "reverse" else frames
    return frames.transpose(-2, -1) if timing.scan_axis == -1 else frames


def offsets_from_row_order(offsets: Tensor, timing: SensorTiming) -> Tensor:
    """Turn displacements or offsets (..., A) in row order back to image axes (x, y) and, if A > 2, roll and zoom."""
    _, signs = row_axes(timing, offsets.shape[-1])
    if min(signs) < 0:
        offsets = offsets * offsets.new_tensor(signs)
    return magnitudes_from_row_order(offsets, timing)


def magnitudes_from_row_order(values: Tensor, timing: SensorTiming, axis: int = -1) -> Tensor:
    """Turn values without a sign back to image axes: standard deviations, gains, residuals, verdicts.

    Values are (..., A) for ``axis=-1`` and (..., A, K) for ``axis=-2``, with components in row order, of any dtype.

    Example:
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512, scan_axis="x")
        >>> magnitudes_from_row_order(Tensor([[1, 2, 3]]), timing).tolist()
        [[2.0, 1.0, 3.0]]
    """
    order, _ = row_axes(timing, values.shape[axis])
    if order == sorted(order):
        return values
    return values[..., order] if axis == -1 else values[..., order, :]


def sequence_from_row_order(values: Sequence[Entry], timing: SensorTiming) -> tuple[Entry, ...]:
    """Turn one entry for each component, back to image axes.

    Example:
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512, scan_axis="x")
        >>> sequence_from_row_order(["along the row", "along the scan"], timing)
        ('along the scan', 'along the row')
    """
    order, _ = row_axes(timing, len(values))
    return tuple(values[axis] for axis in order)


def reasons_from_row_order(reasons: Sequence[Reason], timing: SensorTiming) -> tuple[Reason, ...]:
    """Reasons with the names of their axes in the image."""
    order, _ = row_axes(timing, len(AXIS_NAMES))
    names = {AXIS_NAMES[axis]: name for axis, name in zip(order, AXIS_NAMES, strict=True)}
    return tuple(replace(one, axis=names.get(one.axis or "")) for one in reasons)


def findings_from_row_order(
    findings: Sequence[Sequence[Reason]], timing: SensorTiming
) -> tuple[tuple[Reason, ...], ...]:
    """Turn the reasons against each component back to image axes."""
    return sequence_from_row_order([reasons_from_row_order(reasons, timing) for reasons in findings], timing)
