"""From row order to the user's layout: axes and units of the results of ``detect_vibration`` and of the tracker.

Detection works in row order with all components of the motion in px. A ``DetectionResult`` has image axes (x, y), roll
in rad and zoom relative.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import DetectionResult
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.sensitivity import assumptions, timing_sensitivity
from rsvib_torch.detection.strips import FieldScale
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements, motion_of_fit
from rsvib_torch.detection.verdict import Findings
from rsvib_torch.frames.orientation import (
    findings_from_row_order,
    magnitudes_from_row_order,
    offsets_from_row_order,
    sequence_from_row_order,
)
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import VibrationStd
from rsvib_torch.registration import OffsetCurve

__all__ = ["assembled", "offset_curve"]


def assembled(
    fit: ToneFit,
    std: VibrationStd,
    curve: OffsetCurve,
    fitted: Tensor,
    findings: Sequence[Findings],
    timing: SensorTiming,
    *,
    scale: FieldScale,
    num_frames: int,
    interval: float,
) -> DetectionResult:
    """The results of B stacks in image axes.

    Args:
        fit: Tones and image motion of each stack.
        std: Their standard deviations, in px.
        curve: The measured offsets (B, P, N, A) in px.
        fitted: (B, P, N, A) px, the offsets that the fit predicts.
        findings: For each stack and each axis in row order, the reasons against it.
        timing: The sensor, in image order.
        scale: Components of the motion.
        num_frames: Frames of a stack.
        interval: Seconds between two frames, for the gain.
    """
    row_timing = timing.in_row_order()
    units = scale.units(fitted)
    vibration = scale.motion(motion_of_fit(fit)).from_row_order(timing)
    sensitivity = timing_sensitivity(fit, row_timing, num_frames, scale.height)
    sensitivity = sensitivity.mapped(lambda values: magnitudes_from_row_order(values, timing, -2))
    heights = sequence_from_row_order(curve.heights, timing)
    residual = (curve.offsets - fitted).abs().nanmean(dim=(1, 2))
    reliable = [[not of_axis for of_axis in of_stack] for of_stack in findings]
    return DetectionResult(
        vibration=vibration,
        std=scale.std(std).from_row_order(timing),
        offsets=replace(
            curve,
            offsets=offsets_from_row_order(curve.offsets * units, timing),
            std=None if curve.std is None else magnitudes_from_row_order(curve.std * units, timing),
            heights=(heights[0], heights[1]),
        ),
        fitted=offsets_from_row_order(fitted * units, timing),
        gain=vibration.gain(interval),
        residual=magnitudes_from_row_order(residual * units, timing),
        reliable=magnitudes_from_row_order(torch.tensor(reliable, device=fitted.device), timing),
        findings=tuple(findings_from_row_order(of_stack, timing) for of_stack in findings),
        sensitivity=sensitivity,
        assumptions=tuple(
            assumptions(vibration[index], sensitivity[index], row_timing, num_frames, scale.height)
            for index in range(len(findings))
        ),
        timing=timing,
    )


def offset_curve(
    measurements: Measurements, fit: ToneFit, robust_weights: Tensor, group_frames: Sequence[int]
) -> tuple[OffsetCurve, Tensor]:
    """Measured offsets between consecutive frames, and those (B, P, N, A) in px that a fit predicts.

    Args:
        measurements: Displacements of the rows of all groups behind each other.
        fit: The fit to them.
        robust_weights: As in ``FittedRows``.
        group_frames: Number of frames of each group; neighbouring groups share a frame.
    """
    count = measurements.displacements.shape[1] // len(group_frames)
    parts = [
        (slice(number * count, (number + 1) * count), slice(frame, frame + 2))
        for number, frames in enumerate(group_frames)
        for frame in range(frames - 1)
    ]

    def of_pairs(values: Tensor) -> tuple[Tensor, Tensor]:
        """Values (B, N, G, ...) of the earlier and the later frame of each pair, (B, P, N, ...)."""
        earlier, later = torch.stack([values[:, rows, frames] for rows, frames in parts], 1).unbind(3)
        return earlier, later

    def of_rows(values: Tensor) -> Tensor:
        return torch.stack([values[:, rows] for rows, _ in parts], 1)

    starts, later_starts = of_pairs(measurements.exposure_starts)
    before, after = of_pairs(measurements.displacements)
    everywhere = replace(measurements, visible=torch.ones_like(measurements.visible))
    fitted_before, fitted_after = of_pairs(model_displacements(everywhere, fit))
    visible = torch.stack(of_pairs(measurements.visible)).amin(0) > 0
    weights, robust = of_rows(measurements.weights), of_rows(robust_weights)
    measured = visible & (weights > 0).any(-1)
    frames = torch.arange(len(parts), device=starts.device)
    curve = OffsetCurve(
        pairs=torch.stack([frames, frames + 1], -1),
        rows=BLOCK_ROWS * (torch.arange(count, dtype=torch.float64, device=starts.device) + 0.5) - 0.5,
        times=starts,
        later_times=later_starts,
        offsets=torch.where(measured[..., None], after - before, torch.nan),
        quality=torch.where(measured, robust.amin(-1), 0.0),
        heights=(BLOCK_ROWS, BLOCK_ROWS),
        std=torch.where(weights > 0, (2.0 * robust / weights).sqrt(), torch.nan),  # of a difference of two
    )
    return curve, fitted_after - fitted_before
