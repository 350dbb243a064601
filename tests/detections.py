"""Detections with given standard deviations and verdicts."""

import torch

from rsvib_torch import DetectionResult, OffsetCurve, VibrationStd
from rsvib_torch.detection.sensitivity import TimingSensitivity
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.results.reason import Reason


def findings_of(texts):
    """Reasons with the given texts, in the same nested sequences."""
    if isinstance(texts, str):
        return Reason("unspecified", details={"text": texts})
    return tuple(map(findings_of, texts))


def detection_of(vibration, relative=1e-3, *, phase=1e-3, displacement=None, reliable=(True, True), reasons=((), ())):
    """A detection with standard deviations of ``relative`` times the amplitude, of the phase in rad, and 0.01 Hz.

    That of the ``displacement`` of the rows in px, along x and y, is stated or None.
    """
    drift = torch.zeros_like(vibration.image_motion)
    return DetectedVibration(
        vibration,
        VibrationStd(
            amplitude=relative * vibration.amplitude,
            frequency=torch.full_like(vibration.frequency, 0.01),
            period=torch.zeros_like(vibration.period),
            phase=torch.as_tensor(phase, dtype=torch.float64).expand_as(vibration.phase),
            image_motion=drift + 0.5,
            image_acceleration=drift,
            displacement=None if displacement is None else torch.tensor(displacement, dtype=torch.float64),
        ),
        gain=torch.ones_like(vibration.amplitude),
        residual=drift,
        reliable=torch.tensor(reliable),
        findings=findings_of(reasons),
        assumptions=((),) * len(vibration.amplitude) if vibration.batch_shape else (),
    )


def result_of(
    vibration, timing, std, *, last_row, num_pairs=1, reliable=(True, True), reasons=((), ()), assumptions=()
):
    """The result of ``detect_vibration`` with offsets without errors, every 16 rows; ``std`` of all parameters."""
    rows = torch.arange(16, last_row, 16).double()
    times = torch.arange(num_pairs)[:, None] * timing.frame_period + rows * timing.row_time
    later = times + timing.frame_period
    fitted = vibration.mean_displacement(later, timing.exposure_time)
    fitted = fitted - vibration.mean_displacement(times, timing.exposure_time)
    pairs = torch.tensor([[pair, pair + 1] for pair in range(num_pairs)])
    curve = OffsetCurve(pairs, rows, times, later, fitted.clone(), torch.full_like(times, 0.9), (32, 32))
    tones, axes = torch.full_like(vibration.amplitude, std), torch.full_like(vibration.image_motion, std)
    gain = vibration.gain(timing.frame_period)
    return DetectionResult(
        vibration,
        VibrationStd(tones, tones, tones.clone(), tones, axes, axes),
        gain,
        torch.zeros(2).double(),
        torch.tensor(reliable),
        findings_of(reasons),
        (),
        curve,
        fitted,
        TimingSensitivity(*[gain] * 9),
    )
