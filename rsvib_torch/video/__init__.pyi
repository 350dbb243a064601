from .process_video import process_video
from .session import (
    NOT_A_VIDEO,
    STANDARD_INPUT,
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
    "NOT_A_VIDEO",
    "STANDARD_INPUT",
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
