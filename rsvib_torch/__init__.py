"""See and undo the vibration of a rolling-shutter camera."""

from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration, blind_frequencies

__all__ = ["SensorTiming", "Vibration", "blind_frequencies"]
__version__ = "0.1.0"
