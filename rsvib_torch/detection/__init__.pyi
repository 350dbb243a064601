from .detect import VibrationDetector, detect_vibration
from .result import DetectionResult
from .shapes.free import MotionDetection, detect_motion
from .spectrum import DisplacementSpectrum

__all__ = [
    "DetectionResult",
    "DisplacementSpectrum",
    "MotionDetection",
    "VibrationDetector",
    "detect_motion",
    "detect_vibration",
]
