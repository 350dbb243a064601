from .tracked_frame import TrackedFrame
from .tracker import VibrationTracker

__all__ = ["TrackedFrame", "VibrationTracker"]
