from .dewarp import FixedDewarp
from .frame_motion import visible_pixels
from .noise import estimate_noise
from .restoration_warning import RestorationWarning
from .restore import VibrationRestorer, check_optics, restore
from .verdict.judge import judge_restoration
from .verdict.pairs import TooLittleInCommonError
from .verdict.restoration_verdict import RestorationVerdict
from .verdict.trust import displacement_uncertainty, trusted_vibration

__all__ = [
    "FixedDewarp",
    "RestorationVerdict",
    "RestorationWarning",
    "TooLittleInCommonError",
    "VibrationRestorer",
    "check_optics",
    "displacement_uncertainty",
    "estimate_noise",
    "judge_restoration",
    "restore",
    "trusted_vibration",
    "visible_pixels",
]
