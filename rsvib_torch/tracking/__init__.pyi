from .following import follow_vibration
from .tracked_frame import TrackedFrame
from .tracker import VibrationTracker

__all__ = ["TrackedFrame", "VibrationTracker", "follow_vibration"]
