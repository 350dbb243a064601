from .tracker import TrackedFrame, VibrationTracker

__all__ = ["TrackedFrame", "VibrationTracker"]
