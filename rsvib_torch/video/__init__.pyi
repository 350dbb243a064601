from .frame_outputs import FrameOutput, PipeOutput, VideoOutput
from .process_video import process_video
from .session import LiveReport, run_live
from .sources import CameraSource, FileSource, FrameSource, PipeSource, TimedFrame
from .steadying import Margins

__all__ = [
    "CameraSource",
    "FileSource",
    "FrameOutput",
    "FrameSource",
    "LiveReport",
    "Margins",
    "PipeOutput",
    "PipeSource",
    "TimedFrame",
    "VideoOutput",
    "process_video",
    "run_live",
]
