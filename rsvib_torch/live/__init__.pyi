from .frame_outputs import FrameOutput, PipeOutput, PreviewOutput, VideoOutput
from .live_page import PageOutput
from .session import LiveReport, run_live
from .sources import CameraSource, FileSource, FrameSource, PipeSource, TimedFrame
from .spectrogram import Spectrogram, save_spectrogram

__all__ = [
    "CameraSource",
    "FileSource",
    "FrameOutput",
    "FrameSource",
    "LiveReport",
    "PageOutput",
    "PipeOutput",
    "PipeSource",
    "PreviewOutput",
    "Spectrogram",
    "TimedFrame",
    "VideoOutput",
    "run_live",
    "save_spectrogram",
]
