from .detect import VibrationDetector, detect_vibration
from .diagnosis import TimingDiagnosis, diagnose_timing
from .recorded.accelerometer import AccelerometerComparison, compare_accelerometer
from .recorded.alignment import ClockAlignment, align_motion
from .recorded.motion_check import MotionCheck, check_motion
from .recorded.rotation_alignment import RotationAlignment
from .result import DetectionResult
from .row_time.by_motion import calibrate_row_time_by_motion
from .shapes.free import MotionDetection, detect_motion
from .shapes.swept import SweptTone, detect_swept_tone
from .spectrum import DisplacementSpectrum

__all__ = [
    "AccelerometerComparison",
    "ClockAlignment",
    "DetectionResult",
    "DisplacementSpectrum",
    "MotionCheck",
    "MotionDetection",
    "RotationAlignment",
    "SweptTone",
    "TimingDiagnosis",
    "VibrationDetector",
    "align_motion",
    "calibrate_row_time_by_motion",
    "check_motion",
    "compare_accelerometer",
    "detect_motion",
    "detect_swept_tone",
    "detect_vibration",
    "diagnose_timing",
]
