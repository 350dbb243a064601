"""Stacks of frames in files: TIFF, PNG, NumPy, Zarr, HDF5, raw and video."""

from rsvib_torch.stacks.atomic import check_writable, whole_file, whole_folder
from rsvib_torch.stacks.blocks import restore_block
from rsvib_torch.stacks.detect_windows import detect_stack
from rsvib_torch.stacks.files import check_stack_target, open_stack, read_stack, read_stack_info, write_stack
from rsvib_torch.stacks.formats import FrameReader, FrameWriter, StackFormat, register_format
from rsvib_torch.stacks.frame_times import exposure_times, timing_from_first_frame
from rsvib_torch.stacks.info import FrameError, StackInfo
from rsvib_torch.stacks.iterate import iterate_stack
from rsvib_torch.stacks.job import BadFrames, WindowResult
from rsvib_torch.stacks.job_setup import DEFAULT_WINDOW
from rsvib_torch.stacks.manifest import StackManifest, read_manifest, timing_keys
from rsvib_torch.stacks.process import process_stack
from rsvib_torch.stacks.run import StackReport
from rsvib_torch.stacks.window_restoration import RestoredFrames, restore_trusted
from rsvib_torch.stacks.windows import Window, cut_windows

__all__ = [
    "DEFAULT_WINDOW",
    "BadFrames",
    "FrameError",
    "FrameReader",
    "FrameWriter",
    "RestoredFrames",
    "StackFormat",
    "StackInfo",
    "StackManifest",
    "StackReport",
    "Window",
    "WindowResult",
    "check_stack_target",
    "check_writable",
    "cut_windows",
    "detect_stack",
    "exposure_times",
    "iterate_stack",
    "open_stack",
    "process_stack",
    "read_manifest",
    "read_stack",
    "read_stack_info",
    "register_format",
    "restore_block",
    "restore_trusted",
    "timing_from_first_frame",
    "timing_keys",
    "whole_file",
    "whole_folder",
    "write_stack",
]
