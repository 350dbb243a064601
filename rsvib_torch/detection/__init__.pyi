from .detect import VibrationDetector, detect_vibration
from .result import DetectionResult
from .shapes.free import MotionDetection, detect_motion
from .shapes.swept import SweptTone, detect_swept_tone
from .spectrum import DisplacementSpectrum

__all__ = [
    "DetectionResult",
    "DisplacementSpectrum",
    "MotionDetection",
    "SweptTone",
    "VibrationDetector",
    "detect_motion",
    "detect_swept_tone",
    "detect_vibration",
]
