from .tracker import TrackedFrame, VibrationTracker
from .video_border import Margins, VideoBorder

__all__ = ["Margins", "TrackedFrame", "VibrationTracker", "VideoBorder"]
