"""Stacks of any length, processed window by window: jobs, engines, journal, resume, memory planning."""

from rsvib_torch.stacks.blocks import restore_block
from rsvib_torch.stacks.detect_windows import detect_stack
from rsvib_torch.stacks.iterate import iterate_stack
from rsvib_torch.stacks.job import BadFrames, WindowResult
from rsvib_torch.stacks.job_setup import DEFAULT_WINDOW
from rsvib_torch.stacks.manifest import StackManifest, read_manifest
from rsvib_torch.stacks.process import process_stack
from rsvib_torch.stacks.run import StackReport
from rsvib_torch.stacks.window_restoration import RestoredFrames, restore_trusted
from rsvib_torch.stacks.windows import Window, cut_windows

__all__ = [
    "DEFAULT_WINDOW",
    "BadFrames",
    "RestoredFrames",
    "StackManifest",
    "StackReport",
    "Window",
    "WindowResult",
    "cut_windows",
    "detect_stack",
    "iterate_stack",
    "process_stack",
    "read_manifest",
    "restore_block",
    "restore_trusted",
]
