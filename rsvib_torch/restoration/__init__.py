"""How frames become a scene."""

from rsvib_torch.restoration.motion import visible_pixels
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.restore import VibrationRestorer, restore
from rsvib_torch.restoration.verdict import RestorationVerdict, judge_restoration

__all__ = [
    "RestorationVerdict",
    "VibrationRestorer",
    "estimate_noise",
    "judge_restoration",
    "restore",
    "visible_pixels",
]
