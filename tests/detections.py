"""Detections with given standard deviations and verdicts."""

import torch

from rsvib_torch import VibrationStd
from rsvib_torch.core.reason import Reason
from rsvib_torch.motion.detected_vibration import DetectedVibration


def findings_of(texts):
    """Reasons with the given texts, in the same nested sequences."""
    if isinstance(texts, str):
        return Reason("unspecified", details={"text": texts})
    return tuple(map(findings_of, texts))


def detection_of(vibration, relative=1e-3, *, phase=1e-3, reliable=(True, True), reasons=((), ())):
    """A detection with standard deviations of ``relative`` times the amplitude, of the phase in rad, and 0.01 Hz."""
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
        ),
        gain=torch.ones_like(vibration.amplitude),
        residual=drift,
        reliable=torch.tensor(reliable),
        findings=findings_of(reasons),
        assumptions=((),) * len(vibration.amplitude) if vibration.batch_shape else (),
    )
