from .atomic import check_writable, whole_file, whole_folder
from .files import check_stack_target, open_stack, read_stack, read_stack_info, register_format, write_stack
from .formats import FrameReader, FrameWriter, StackFormat
from .stack_info import FrameError, StackInfo, exposure_times, timing_from_first_frame

__all__ = [
    "FrameError",
    "FrameReader",
    "FrameWriter",
    "StackFormat",
    "StackInfo",
    "check_stack_target",
    "check_writable",
    "exposure_times",
    "open_stack",
    "read_stack",
    "read_stack_info",
    "register_format",
    "timing_from_first_frame",
    "whole_file",
    "whole_folder",
    "write_stack",
]
