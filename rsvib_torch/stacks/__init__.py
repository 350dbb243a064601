"""Stacks of frames in files: TIFF, PNG, NumPy and video."""

from rsvib_torch.stacks.atomic import check_writable, whole_file, whole_folder
from rsvib_torch.stacks.files import check_stack_target, read_stack, read_stack_info, write_stack
from rsvib_torch.stacks.info import StackInfo

__all__ = [
    "StackInfo",
    "check_stack_target",
    "check_writable",
    "read_stack",
    "read_stack_info",
    "whole_file",
    "whole_folder",
    "write_stack",
]
