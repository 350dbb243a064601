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
from rsvib_torch.io import StackInfo, open_stack, read_stack, read_stack_info, write_stack
from rsvib_torch.motion.recorded import read_motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, blind_frequencies
from rsvib_torch.registration import OffsetCurve, register_bands
from rsvib_torch.report.plots import (
    comparison_figure,
    gain_figure,
    motion_figure,
    mtf_figure,
    offset_figure,
    psf_figure,
    rows_figure,
    save_figure,
    windows_figure,
)
from rsvib_torch.report.results import read_vibration, write_offsets, write_vibration, write_windows
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
from rsvib_torch.stacks import StackReport, iterate_stack, process_stack, read_manifest, restore_block

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
    "comparison_figure",
    "detect_motion",
    "detect_swept_tone",
    "detect_vibration",
    "find_slanted_edges",
    "gain_figure",
    "iterate_stack",
    "judge_restoration",
    "motion_figure",
    "mtf_figure",
    "offset_endpoint_error",
    "offset_figure",
    "open_stack",
    "predict_noise_gain",
    "process_stack",
    "psf_figure",
    "psnr",
    "read_manifest",
    "read_motion",
    "read_stack",
    "read_stack_info",
    "read_vibration",
    "register_bands",
    "restore",
    "restore_block",
    "row_psf",
    "rows_figure",
    "save_figure",
    "simulate_frames",
    "slanted_edge_mtf",
    "ssim",
    "trusted_vibration",
    "visible_pixels",
    "windows_figure",
    "write_offsets",
    "write_stack",
    "write_vibration",
    "write_windows",
]
__version__ = "0.1.0"
