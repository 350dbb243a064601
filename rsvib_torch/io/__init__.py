"""Files of frames: one module per format, the registry of formats, and atomic writes."""

from rsvib_torch.io.atomic import check_writable, whole_file, whole_folder
from rsvib_torch.io.files import check_stack_target, open_stack, read_stack, read_stack_info, write_stack
from rsvib_torch.io.formats import FrameReader, FrameWriter, StackFormat, register_format
from rsvib_torch.io.frame_times import exposure_times, timing_from_first_frame
from rsvib_torch.io.stack_info import FrameError, StackInfo

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
