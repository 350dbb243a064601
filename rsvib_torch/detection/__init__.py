"""From offsets to a vibration."""

from rsvib_torch.detection.detect import DetectionMethod, VibrationDetector, detect_vibration
from rsvib_torch.detection.result import DetectionResult, VibrationStd

__all__ = ["DetectionMethod", "DetectionResult", "VibrationDetector", "VibrationStd", "detect_vibration"]
