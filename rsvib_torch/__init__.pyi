from . import augmentation as augmentation
from . import datasets as datasets
from . import detection as detection
from . import evaluation as evaluation
from . import export as export
from . import gyroscope as gyroscope
from . import imaging as imaging
from . import io as io
from . import motion as motion
from . import registration as registration
from . import report as report
from . import restoration as restoration
from . import row_time as row_time
from . import stacks as stacks
from . import tracking as tracking
from . import video as video
from .augmentation import RollingShutterVibration
from .detection import (
    DetectionResult,
    DisplacementSpectrum,
    MotionDetection,
    SweptTone,
    TimingDiagnosis,
    VibrationDetector,
    detect_motion,
    detect_swept_tone,
    detect_vibration,
    diagnose_timing,
)
from .evaluation import MtfCurve, SlantedEdge, find_slanted_edges, psnr, slanted_edge_mtf, ssim
from .export import camera_isd, sampling_map, write_gcsv, write_isd, write_stmap
from .gyroscope import (
    AccelerometerComparison,
    AngularRates,
    ClockAlignment,
    MotionCheck,
    RotationAlignment,
    align_motion,
    check_motion,
    compare_accelerometer,
    read_gyroscope,
)
from .imaging import Optics, RowVaryingBlur, SensorNoise, row_psf, simulate_frames
from .io import StackInfo, TimingWarning, open_stack, read_stack, read_stack_info, timing_from_first_frame, write_stack
from .motion.camera import Camera
from .motion.cameras import CameraMode, camera_mode, find_cameras
from .motion.detected_vibration import FollowedVibration
from .motion.recorded import read_motion
from .motion.spline import FreeMotion
from .motion.timing import SensorTiming
from .motion.vibration import Vibration, VibrationStd, blind_frequencies
from .registration import OffsetCurve, register_bands
from .report import (
    comparison_figure,
    gain_figure,
    motion_figure,
    mtf_figure,
    offset_figure,
    psf_figure,
    read_vibration,
    rows_figure,
    save_figure,
    windows_figure,
    write_offsets,
    write_table,
    write_vibration,
)
from .restoration import (
    FixedDewarp,
    RestorationMtf,
    RestorationVerdict,
    RestorationWarning,
    VibrationRestorer,
    judge_restoration,
    restoration_mtf,
    restore,
    trusted_vibration,
    visible_pixels,
)
from .row_time import (
    RowTimeCalibration,
    calibrate_row_time,
    calibrate_row_time_by_exposure,
    calibrate_row_time_by_motion,
)
from .stacks import StackReport, VibrationCorrector, iterate_stack, process_stack, read_manifest, restore_block
from .tracking import TrackedFrame, VibrationTracker, follow_vibration
from .video import Margins, VideoBorder, process_video

__all__ = [
    "AccelerometerComparison",
    "AngularRates",
    "Camera",
    "CameraMode",
    "ClockAlignment",
    "DetectionResult",
    "DisplacementSpectrum",
    "FixedDewarp",
    "FollowedVibration",
    "FreeMotion",
    "Margins",
    "MotionCheck",
    "MotionDetection",
    "MtfCurve",
    "OffsetCurve",
    "Optics",
    "RestorationMtf",
    "RestorationVerdict",
    "RestorationWarning",
    "RollingShutterVibration",
    "RotationAlignment",
    "RowTimeCalibration",
    "RowVaryingBlur",
    "SensorNoise",
    "SensorTiming",
    "SlantedEdge",
    "StackInfo",
    "StackReport",
    "SweptTone",
    "TimingDiagnosis",
    "TimingWarning",
    "TrackedFrame",
    "Vibration",
    "VibrationCorrector",
    "VibrationDetector",
    "VibrationRestorer",
    "VibrationStd",
    "VibrationTracker",
    "VideoBorder",
    "align_motion",
    "blind_frequencies",
    "calibrate_row_time",
    "calibrate_row_time_by_exposure",
    "calibrate_row_time_by_motion",
    "camera_isd",
    "camera_mode",
    "check_motion",
    "compare_accelerometer",
    "comparison_figure",
    "detect_motion",
    "detect_swept_tone",
    "detect_vibration",
    "diagnose_timing",
    "find_cameras",
    "find_slanted_edges",
    "follow_vibration",
    "gain_figure",
    "iterate_stack",
    "judge_restoration",
    "motion_figure",
    "mtf_figure",
    "offset_figure",
    "open_stack",
    "process_stack",
    "process_video",
    "psf_figure",
    "psnr",
    "read_gyroscope",
    "read_manifest",
    "read_motion",
    "read_stack",
    "read_stack_info",
    "read_vibration",
    "register_bands",
    "restoration_mtf",
    "restore",
    "restore_block",
    "row_psf",
    "rows_figure",
    "sampling_map",
    "save_figure",
    "simulate_frames",
    "slanted_edge_mtf",
    "ssim",
    "timing_from_first_frame",
    "trusted_vibration",
    "visible_pixels",
    "windows_figure",
    "write_gcsv",
    "write_isd",
    "write_offsets",
    "write_stack",
    "write_stmap",
    "write_table",
    "write_vibration",
]
__version__: str
