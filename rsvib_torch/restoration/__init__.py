"""How frames become a scene."""

from rsvib_torch.restoration.motion import visible_pixels
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.restore import VibrationRestorer, restore

__all__ = ["VibrationRestorer", "estimate_noise", "restore", "visible_pixels"]
