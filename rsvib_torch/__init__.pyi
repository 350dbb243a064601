from . import augmentation as augmentation
from . import calibration as calibration
from . import detection as detection
from . import evaluation as evaluation
from . import imaging as imaging
from . import io as io
from . import motion as motion
from . import registration as registration
from . import report as report
from . import restoration as restoration
from . import stacks as stacks
from .augmentation import RollingShutterVibration
from .calibration import RowTimeCalibration, calibrate_row_time, calibrate_row_time_by_exposure
from .detection import (
    ClockAlignment,
    DetectionResult,
    MotionCheck,
    MotionDetection,
    SweptTone,
    VibrationDetector,
    align_motion,
    check_motion,
    detect_motion,
    detect_swept_tone,
    detect_vibration,
)
from .evaluation import (
    MtfCurve,
    SlantedEdge,
    find_slanted_edges,
    offset_endpoint_error,
    psnr,
    slanted_edge_mtf,
    ssim,
)
from .imaging import Optics, RowVaryingBlur, SensorNoise, row_psf, simulate_frames
from .io import StackInfo, open_stack, read_stack, read_stack_info, write_stack
from .motion.recorded import read_motion
from .motion.spline import FreeMotion
from .motion.timing import SensorTiming
from .motion.vibration import Vibration, VibrationStd, blind_frequencies
from .registration import OffsetCurve, register_bands
from .restoration import (
    RestorationVerdict,
    RestorationWarning,
    VibrationRestorer,
    judge_restoration,
    predict_noise_gain,
    restore,
    trusted_vibration,
    visible_pixels,
)
from .stacks import StackReport, iterate_stack, process_stack, restore_block

__all__ = [
    "ClockAlignment",
    "DetectionResult",
    "FreeMotion",
    "MotionCheck",
    "MotionDetection",
    "MtfCurve",
    "OffsetCurve",
    "Optics",
    "RestorationVerdict",
    "RestorationWarning",
    "RollingShutterVibration",
    "RowTimeCalibration",
    "RowVaryingBlur",
    "SensorNoise",
    "SensorTiming",
    "SlantedEdge",
    "StackInfo",
    "StackReport",
    "SweptTone",
    "Vibration",
    "VibrationDetector",
    "VibrationRestorer",
    "VibrationStd",
    "align_motion",
    "blind_frequencies",
    "calibrate_row_time",
    "calibrate_row_time_by_exposure",
    "check_motion",
    "detect_motion",
    "detect_swept_tone",
    "detect_vibration",
    "find_slanted_edges",
    "iterate_stack",
    "judge_restoration",
    "offset_endpoint_error",
    "open_stack",
    "predict_noise_gain",
    "process_stack",
    "psnr",
    "read_motion",
    "read_stack",
    "read_stack_info",
    "register_bands",
    "restore",
    "restore_block",
    "row_psf",
    "simulate_frames",
    "slanted_edge_mtf",
    "ssim",
    "trusted_vibration",
    "visible_pixels",
    "write_stack",
]
__version__: str
