"""Result of detection: vibration, standard deviations, verdict, and the offset curve; how it is assembled.

Detection works in row order with all components of the motion in px. A ``DetectionResult`` has image axes (x, y), roll
in rad and zoom relative.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.sensitivity import TimingSensitivity, assumptions, timing_sensitivity, with_row_time_std
from rsvib_torch.detection.spectrum import DisplacementSpectrum, displacement_spectrum
from rsvib_torch.detection.start import FieldScale
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements, motion_of_fit
from rsvib_torch.detection.verdict import contradicted_axes
from rsvib_torch.files.reading import Table
from rsvib_torch.frames.prepare import (
    findings_from_row_order,
    magnitudes_from_row_order,
    offsets_from_row_order,
)
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.results.presentation import plain_values
from rsvib_torch.results.reason import Findings


@dataclass(frozen=True, eq=False, repr=False)
class DetectionResult(
    DetectedVibration,
    units={**Vibration.units, "residual": "px", "gain": "px of offset per px of displacement", "offsets": "s and px"},
    shapes={**DetectedVibration.shapes, "fitted": "... P N A"},
    file_format="rsvib vibration",
):
    """A detected vibration with its uncertainty and verdict. Batches of stacks or windows lead all tensors.

    Attributes:
        vibration: The vibration in image axes; an axis without a significant tone has amplitude 0.
        std: Standard deviations of its parameters, given the tones that were found.
        std_if_hidden_tone: The same if the record may contain a further tone, which few frames cannot exclude.
        gain: (..., 2, K) offset gain of Eq. (7) from displacement to offset between the first two frames. A tone with a
            gain near 0 is nearly blind, unless other frames are at other intervals.
        residual: (..., 2) px, mean absolute difference of measured and fitted offsets.
        reliable: (..., 2) bool, verdict for each axis.
        findings: Each ``Reason`` against each axis (x, y) that is not reliable; a tuple of those for a batch.
            ``reasons`` has their texts.
        assumptions: What the frames cannot contradict, one sentence for each; a tuple of those for a batch.
        offsets: The measured offset curve.
        fitted: (..., P, N, 2) px, offsets of the same bands predicted by the vibration.
        sensitivity: Effect of the stated timing on amplitudes and frequencies.
        timing: The sensor of the frames.

    ``save`` writes a ``vibration.json`` as the program does, which ``rsvib restore`` and ``read_vibration`` read.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, vibration = example_frames()
        >>> detection = rsv.detect_vibration(frames, timing)
        >>> detection.std.amplitude.shape, detection.offsets.offsets.shape[-1]  # (axis, tone); x and y
        (torch.Size([2, 1]), 2)
        >>> (detection.vibration.amplitude - vibration.amplitude).abs().max().item() < 0.02
        True
        >>> detection.gain[:, 0].round(decimals=2).tolist()  # offset of the later frame over displacement
        [-1.69, -0.5]
        >>> detection.save("vibration.json")  # doctest: +SKIP
        >>> detection = rsv.DetectionResult.load("vibration.json")  # doctest: +SKIP
    """

    offsets: OffsetCurve
    fitted: Tensor
    sensitivity: TimingSensitivity
    timing: SensorTiming | None = None

    def spectrum(self) -> DisplacementSpectrum:
        """Amplitude spectrum and power spectral density of the displacement, from the offset curve.

        Raises:
            ValueError: If it is a batch, the timing is unknown, or fewer than 8 offsets were measured.
        """
        if self.timing is None:
            raise ValueError("timing unknown: replace(result, timing=SensorTiming(...)) has a spectrum")
        return displacement_spectrum(self.offsets, self.timing, self.vibration, self.fitted)

    def to_dict(self) -> Table:
        """All values as nested lists, numbers and texts, as in a ``vibration.json``; None for unknown numbers."""
        values = super().to_dict()
        values["period"] = plain_values(self.vibration.period)
        curve = {name: values.pop(name) for name in ("offsets", "fitted")}  # long, therefore last
        return values | curve

    def _middle_time(self, batch: tuple[int, ...]) -> float | None:
        curve, exposure_time = self.offsets, 0.0 if self.timing is None else self.timing.exposure_time
        selection = batch if curve.times.ndim > 2 else ()  # stacks of one timing have their times in common
        return 0.5 * (float(curve.times[selection].min()) + float(curve.later_times[selection].max()) + exposure_time)

    def with_axes(self, count: int) -> "DetectionResult":
        """The result with the first axes of (x, y, roll, zoom) only."""
        batch = len(self.batch_shape)

        def first(values: Tensor) -> Tensor:
            """The first axes of values (..., A), or (..., A, K) of tones."""
            return values[..., :count, :] if values.ndim == batch + 2 else values[..., :count]

        def first_findings(findings: Findings, depth: int) -> Findings:
            return findings[:count] if depth == 0 else tuple(first_findings(part, depth - 1) for part in findings)

        curve, hidden = self.offsets, self.std_if_hidden_tone
        std = None if curve.std is None else curve.std[..., :count]
        return replace(
            self,
            vibration=self.vibration.mapped(first),
            std=self.std.mapped(first),
            std_if_hidden_tone=None if hidden is None else hidden.mapped(first),
            gain=first(self.gain),
            residual=first(self.residual),
            reliable=first(self.reliable),
            findings=first_findings(self.findings, batch),
            offsets=replace(curve, offsets=curve.offsets[..., :count], std=std),
            fitted=self.fitted[..., :count],
            sensitivity=self.sensitivity.mapped(first),
        )


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
    residual = (curve.offsets - predicted).abs().nanmean(dim=(1, 2))
    reliable = [[not reasons for reasons in stack_findings] for stack_findings in findings]
    # The axes of a stack have one timing, which the rows of one of them may contradict.
    contradicted = [any(contradicted_axes(stack_findings)) and not all(stack_findings) for stack_findings in findings]
    stds = [
        px_std and with_row_time_std(scale.std(px_std).from_row_order(timing), vibration, sensitivity, timing)
        for px_std in (std, std_if_hidden_tone)
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
        ),
        fitted=offsets_from_row_order(predicted * units, timing),
        gain=vibration.gain(interval),
        residual=magnitudes_from_row_order(residual * units, timing),
        reliable=magnitudes_from_row_order(torch.tensor(reliable, device="cpu"), timing),
        findings=tuple(findings_from_row_order(stack_findings, timing) for stack_findings in findings),
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

    def pair_values(values: Array) -> Array:
        """Values (B, N, G, ...) of the earlier and the later frame of each pair, (2, B, P, N, ...)."""
        return np.moveaxis(np.stack([values[:, rows, frames] for rows, frames in parts], 1), 3, 0)

    def row_values(values: Array) -> Array:
        return np.stack([values[:, rows] for rows, _ in parts], 1)

    starts, later_starts = pair_values(measurements.exposure_starts)
    before, after = pair_values(measurements.displacements)
    everywhere = replace(measurements, visible=np.ones_like(measurements.visible))
    fitted_before, fitted_after = pair_values(model_displacements(everywhere, fit))
    weights, robust = row_values(measurements.weights), row_values(robust_weights)
    measured = (pair_values(measurements.visible).min(0) > 0) & (weights > 0).any(-1)
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
    return OffsetCurve(**on_device, heights=(BLOCK_ROWS, BLOCK_ROWS)), fitted_after - fitted_before
