"""Measure and remove the vibration of a rolling-shutter camera."""

from rsvib_torch.augmentation import RollingShutterVibration
from rsvib_torch.calibration import RowTimeCalibration, calibrate_row_time, calibrate_row_time_by_exposure
from rsvib_torch.detection import (
    ClockAlignment,
    DetectionResult,
    MotionCheck,
    MotionDetection,
    SweptTone,
    VibrationDetector,
    VibrationStd,
    align_motion,
    check_motion,
    detect_motion,
    detect_swept_tone,
    detect_vibration,
)
from rsvib_torch.evaluation import (
    MtfCurve,
    SlantedEdge,
    find_slanted_edges,
    offset_endpoint_error,
    psnr,
    slanted_edge_mtf,
    ssim,
)
from rsvib_torch.imaging import Optics, RowVaryingBlur, SensorNoise, row_psf, simulate_frames
from rsvib_torch.io import (
    StackInfo,
    TimingWarning,
    open_stack,
    read_stack,
    read_stack_info,
    timing_from_first_frame,
    write_stack,
)
from rsvib_torch.motion.recorded import read_motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, blind_frequencies
from rsvib_torch.registration import OffsetCurve, register_bands
from rsvib_torch.restoration import (
    RestorationVerdict,
    RestorationWarning,
    VibrationRestorer,
    judge_restoration,
    predict_noise_gain,
    restore,
    trusted_vibration,
    visible_pixels,
)
from rsvib_torch.stacks import StackReport, iterate_stack, process_stack, restore_block

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
    "TimingWarning",
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
    "timing_from_first_frame",
    "trusted_vibration",
    "visible_pixels",
    "write_stack",
]
__version__ = "0.1.0"
