"""Stacks of frames in files: TIFF, PNG, NumPy, Zarr, HDF5, raw and video."""

from rsvib_torch.stacks.atomic import check_writable, whole_file, whole_folder
from rsvib_torch.stacks.files import check_stack_target, open_stack, read_stack, read_stack_info, write_stack
from rsvib_torch.stacks.formats import FrameReader, FrameWriter, StackFormat, register_format
from rsvib_torch.stacks.info import FrameError, StackInfo

__all__ = [
    "FrameError",
    "FrameReader",
    "FrameWriter",
    "StackFormat",
    "StackInfo",
    "check_stack_target",
    "check_writable",
    "open_stack",
    "read_stack",
    "read_stack_info",
    "register_format",
    "whole_file",
    "whole_folder",
    "write_stack",
]
