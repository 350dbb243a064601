from .tracked_frame import TrackedFrame
from .tracker import VibrationTracker
from .video_border import Margins, VideoBorder

__all__ = ["Margins", "TrackedFrame", "VibrationTracker", "VideoBorder"]
