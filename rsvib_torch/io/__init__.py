"""Stacks of frames in files: the registry of formats, one module per format, and atomic writes."""

from rsvib_torch.core.atomic import check_writable, whole_file, whole_folder
from rsvib_torch.io.files import (
    check_stack_target,
    metadata_not_kept,
    open_stack,
    read_stack,
    read_stack_info,
    write_stack,
)
from rsvib_torch.io.formats import FrameReader, FrameWriter, StackFormat, register_format
from rsvib_torch.io.frame_times import TimingWarning, describe_stack, exposure_times, timing_from_first_frame
from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = [
    "FrameError",
    "FrameReader",
    "FrameWriter",
    "StackFormat",
    "StackInfo",
    "TimingWarning",
    "check_stack_target",
    "check_writable",
    "describe_stack",
    "exposure_times",
    "metadata_not_kept",
    "open_stack",
    "read_stack",
    "read_stack_info",
    "register_format",
    "timing_from_first_frame",
    "whole_file",
    "whole_folder",
    "write_stack",
]
