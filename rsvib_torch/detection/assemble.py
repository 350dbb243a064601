"""From row order to the user's layout: axes and units of the results of ``detect_vibration`` and of the tracker.

Detection works in row order with all components of the motion in px. A ``DetectionResult`` has image axes (x, y), roll
in rad and zoom relative.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import DetectionResult
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.sensitivity import assumptions, timing_sensitivity, with_row_time_std
from rsvib_torch.detection.strips import FieldScale
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements, motion_of_fit
from rsvib_torch.detection.verdict import Findings, contradicted_axes
from rsvib_torch.frames.prepare import (
    findings_from_row_order,
    magnitudes_from_row_order,
    offsets_from_row_order,
    sequence_from_row_order,
)
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import VibrationStd
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration import OffsetCurve


def assembled(
    fit: ToneFit,
    std: VibrationStd,
    std_if_hidden_tone: VibrationStd | None,
    offsets: tuple[OffsetCurve, Array],
    findings: Sequence[Findings],
    timing: SensorTiming,
    *,
    scale: FieldScale,
    num_frames: int,
    interval: float,
    blur: Array | None = None,
) -> DetectionResult:
    """The results of B stacks in image axes, from the fit and the standard deviations of its vibration in px.

    ``offsets`` are those that were measured and those (B, P, N, A) in px that the fit predicts; ``findings`` are the
    reasons against each axis in row order; the timing is in image order, and ``interval`` in s is that between two
    frames, for the gain. ``blur`` (B, 3) as in ``OtherMotion`` is None if it was not measured.
    """
    row_timing, (curve, fitted) = timing.in_row_order(), offsets
    predicted = torch.from_numpy(fitted).to(curve.offsets.device)
    units = scale.units(predicted)
    vibration = scale.motion(motion_of_fit(fit)).from_row_order(timing)
    sensitivity = timing_sensitivity(fit, row_timing, num_frames, scale.height)
    sensitivity = sensitivity.mapped(lambda values: magnitudes_from_row_order(values, timing, -2))
    heights = sequence_from_row_order(curve.heights, timing)
    residual = (curve.offsets - predicted).abs().nanmean(dim=(1, 2))
    reliable = [[not of_axis for of_axis in of_stack] for of_stack in findings]
    # The axes of a stack have one timing, which the rows of one of them may contradict.
    contradicted = [any(contradicted_axes(of_stack)) and not all(of_stack) for of_stack in findings]
    stds = [
        of and with_row_time_std(scale.std(of).from_row_order(timing), vibration, sensitivity, timing)
        for of in (std, std_if_hidden_tone)
    ]
    assert stds[0] is not None
    return DetectionResult(
        vibration=vibration,
        std=stds[0],
        std_if_hidden_tone=stds[1],
        offsets=replace(
            curve,
            offsets=offsets_from_row_order(curve.offsets * units, timing),
            std=None if curve.std is None else magnitudes_from_row_order(curve.std * units, timing),
            heights=(heights[0], heights[1]),
        ),
        fitted=offsets_from_row_order(predicted * units, timing),
        gain=vibration.gain(interval),
        residual=magnitudes_from_row_order(residual * units, timing),
        reliable=magnitudes_from_row_order(torch.tensor(reliable, device="cpu"), timing),
        findings=tuple(findings_from_row_order(of_stack, timing) for of_stack in findings),
        sensitivity=sensitivity,
        assumptions=assumptions(vibration, sensitivity, row_timing, num_frames, scale.height, blur, contradicted),
        timing=timing,
    ).to(curve.offsets.device)


def offset_curve(
    measurements: Measurements, fit: ToneFit, robust_weights: Array, group_frames: Sequence[int], device: torch.device
) -> tuple[OffsetCurve, Array]:
    """Measured offsets between consecutive frames of groups, and those (B, P, N, A) in px that a fit predicts."""
    count = measurements.displacements.shape[1] // len(group_frames)
    parts = [
        (slice(number * count, (number + 1) * count), slice(frame, frame + 2))
        for number, frames in enumerate(group_frames)
        for frame in range(frames - 1)
    ]

    def of_pairs(values: Array) -> Array:
        """Values (B, N, G, ...) of the earlier and the later frame of each pair, (2, B, P, N, ...)."""
        return np.moveaxis(np.stack([values[:, rows, frames] for rows, frames in parts], 1), 3, 0)

    def of_rows(values: Array) -> Array:
        return np.stack([values[:, rows] for rows, _ in parts], 1)

    starts, later_starts = of_pairs(measurements.exposure_starts)
    before, after = of_pairs(measurements.displacements)
    everywhere = replace(measurements, visible=np.ones_like(measurements.visible))
    fitted_before, fitted_after = of_pairs(model_displacements(everywhere, fit))
    weights, robust = of_rows(measurements.weights), of_rows(robust_weights)
    measured = (of_pairs(measurements.visible).min(0) > 0) & (weights > 0).any(-1)
    frames = np.arange(len(parts))
    values = {
        "pairs": np.stack([frames, frames + 1], -1),
        "rows": BLOCK_ROWS * (np.arange(count) + 0.5) - 0.5,
        "times": starts,
        "later_times": later_starts,
        "offsets": np.where(measured[..., None], after - before, np.nan),
        "quality": np.where(measured, robust.min(-1), 0.0),
        "std": np.sqrt(np.where(weights > 0, 2.0 * robust / np.maximum(weights, 1e-300), np.nan)),  # of a difference
    }
    on_device = {name: torch.from_numpy(array).to(device) for name, array in values.items()}
    curve = OffsetCurve(**on_device, heights=(BLOCK_ROWS, BLOCK_ROWS))
    return curve, fitted_after - fitted_before
