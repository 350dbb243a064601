"""From offsets to a vibration."""

from rsvib_torch.detection.detect import DetectionMethod, VibrationDetector, detect_vibration
from rsvib_torch.detection.recorded.alignment import ClockAlignment, align_motion
from rsvib_torch.detection.recorded.motion_check import MotionCheck, check_motion
from rsvib_torch.detection.result import DetectionResult
from rsvib_torch.detection.shapes.free import MotionDetection, detect_motion
from rsvib_torch.detection.shapes.swept import SweptTone, detect_swept_tone
from rsvib_torch.motion.vibration import VibrationStd

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
