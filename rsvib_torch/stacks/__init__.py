"""Stacks of any length, processed window by window: windows, engines, journal and resume, manifest, memory planning."""

from rsvib_torch.stacks.job import BadFrames, WindowResult
from rsvib_torch.stacks.manifest import StackManifest, read_manifest
from rsvib_torch.stacks.process import DEFAULT_WINDOW, StackReport, detect_stack, iterate_stack, process_stack
from rsvib_torch.stacks.window_restoration import RestoredFrames, restore_block, restore_trusted
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
