from .formats import StackFormat, register_format
from .frame_times import TimingWarning, describe_stack, exposure_times, timing_from_first_frame
from .stack_info import FrameError, FrameReader, StackInfo, is_video
from .stack_reading import open_stack, read_stack, read_stack_info
from .stack_writing import check_stack_target, metadata_not_kept, stack_files, write_stack

__all__ = [
    "FrameError",
    "FrameReader",
    "StackFormat",
    "StackInfo",
    "TimingWarning",
    "check_stack_target",
    "describe_stack",
    "exposure_times",
    "is_video",
    "metadata_not_kept",
    "open_stack",
    "read_stack",
    "read_stack_info",
    "register_format",
    "stack_files",
    "timing_from_first_frame",
    "write_stack",
]
