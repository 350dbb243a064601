from .process_video import process_video
from .session import (
    CameraSource,
    FileSource,
    FrameOutput,
    FrameSource,
    LiveReport,
    PipeOutput,
    TimedFrame,
    VideoOutput,
    run_live,
)
from .steadying import Margins

__all__ = [
    "CameraSource",
    "FileSource",
    "FrameOutput",
    "FrameSource",
    "LiveReport",
    "Margins",
    "PipeOutput",
    "TimedFrame",
    "VideoOutput",
    "process_video",
    "run_live",
]
