from .gpmf_track import CameraTrack, read_camera_track
from .gyroscope_rates import AngularRates
from .read_gyroscope import read_gyroscope
from .rotation_alignment import AlignOptions, RotationAlignment, align_motion

__all__ = [
    "AlignOptions",
    "AngularRates",
    "CameraTrack",
    "RotationAlignment",
    "align_motion",
    "read_camera_track",
    "read_gyroscope",
]
