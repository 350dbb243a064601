"""How frames become a scene."""

from rsvib_torch.restoration.frame_motion import visible_pixels
from rsvib_torch.restoration.noise.high_pass import estimate_noise
from rsvib_torch.restoration.noise_gain import predict_noise_gain
from rsvib_torch.restoration.restore import VibrationRestorer, restore
from rsvib_torch.restoration.verdict.judge import RestorationVerdict, RestorationWarning, judge_restoration
from rsvib_torch.restoration.verdict.pairs import TooLittleInCommonError
from rsvib_torch.restoration.verdict.trust import displacement_uncertainty, trusted_vibration

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
