from .accelerometer import AccelerometerComparison, compare_accelerometer
from .alignment import ClockAlignment, align_motion
from .gpmf_track import CameraTrack, read_camera_track
from .gyroscope_rates import AngularRates
from .motion_check import MotionCheck, check_motion
from .read_gyroscope import read_gyroscope
from .rotation_alignment import RotationAlignment

__all__ = [
    "AccelerometerComparison",
    "AngularRates",
    "CameraTrack",
    "ClockAlignment",
    "MotionCheck",
    "RotationAlignment",
    "align_motion",
    "check_motion",
    "compare_accelerometer",
    "read_camera_track",
    "read_gyroscope",
]
