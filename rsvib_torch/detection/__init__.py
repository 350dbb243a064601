"""From offsets to a vibration."""

from rsvib_torch.detection.alignment import ClockAlignment, align_motion
from rsvib_torch.detection.detect import DetectionMethod, VibrationDetector, detect_vibration
from rsvib_torch.detection.freeform import MotionDetection, detect_motion
from rsvib_torch.detection.known import MotionCheck, check_motion
from rsvib_torch.detection.result import DetectionResult, VibrationStd
from rsvib_torch.detection.swept import SweptTone, detect_swept_tone

__all__ = [
    "ClockAlignment",
    "DetectionMethod",
    "DetectionResult",
    "MotionCheck",
    "MotionDetection",
    "SweptTone",
    "VibrationDetector",
    "VibrationStd",
    "align_motion",
    "check_motion",
    "detect_motion",
    "detect_swept_tone",
    "detect_vibration",
]
