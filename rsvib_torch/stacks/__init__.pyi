from .corrector import CorrectedFrames, VibrationCorrector
from .job import WindowResult, restore_block
from .manifest import StackManifest, read_manifest
from .process import detect_stack, iterate_stack, process_stack
from .recorded_motion import align_stack, check_stack_motion
from .run_folder import StackReport
from .window_restoration import RestoredFrames, may_change, restore_followed, restore_trusted, without_data
from .windows import Window, cut_windows

__all__ = [
    "CorrectedFrames",
    "RestoredFrames",
    "StackManifest",
    "StackReport",
    "VibrationCorrector",
    "Window",
    "WindowResult",
    "align_stack",
    "check_stack_motion",
    "cut_windows",
    "detect_stack",
    "iterate_stack",
    "may_change",
    "process_stack",
    "read_manifest",
    "restore_block",
    "restore_followed",
    "restore_trusted",
    "without_data",
]
