from .frame_motion import RestorationWarning, trusted_vibration, visible_pixels
from .judge import TooLittleInCommonError, judge_restoration
from .noise import estimate_noise
from .restoration_verdict import RestorationVerdict
from .restore import VibrationRestorer, check_optics, restore
from .row_methods import FixedDewarp

__all__ = [
    "FixedDewarp",
    "RestorationVerdict",
    "RestorationWarning",
    "TooLittleInCommonError",
    "VibrationRestorer",
    "check_optics",
    "estimate_noise",
    "judge_restoration",
    "restore",
    "trusted_vibration",
    "visible_pixels",
]
