"""How frames become a scene."""

from rsvib_torch.restoration.gain import predict_noise_gain
from rsvib_torch.restoration.judging import judge_restoration
from rsvib_torch.restoration.motion import visible_pixels
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.restore import VibrationRestorer, restore
from rsvib_torch.restoration.trust import displacement_uncertainty, trusted_vibration
from rsvib_torch.restoration.verdict import RestorationVerdict, RestorationWarning, TooLittleInCommonError

__all__ = [
    "RestorationVerdict",
    "RestorationWarning",
    "TooLittleInCommonError",
    "VibrationRestorer",
    "displacement_uncertainty",
    "estimate_noise",
    "judge_restoration",
    "predict_noise_gain",
    "restore",
    "trusted_vibration",
    "visible_pixels",
]
