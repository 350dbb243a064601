from .accelerometer import AccelerometerComparison, compare_accelerometer
from .alignment import ClockAlignment, align_motion
from .gyroscope_rates import AngularRates
from .motion_check import MotionCheck, check_motion
from .read_gyroscope import read_gyroscope
from .rotation_alignment import RotationAlignment

__all__ = [
    "AccelerometerComparison",
    "AngularRates",
    "ClockAlignment",
    "MotionCheck",
    "RotationAlignment",
    "align_motion",
    "check_motion",
    "compare_accelerometer",
    "read_gyroscope",
]
