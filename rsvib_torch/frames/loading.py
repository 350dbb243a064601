"""The argument ``frames`` of a function, which may be files: these are read by ``io``, a package above this one."""

import os
from collections.abc import Callable
from typing import NamedTuple, cast

from rsvib_torch.checks.arrays import FramesLike, FramesOrFiles
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.results.higher_packages import IMPORTERS


class LoadedFrames(NamedTuple):
    """Frames in memory, from the argument ``frames`` of a function."""

    frames: FramesLike  # tensor, array or list of these; integers as stored, unless the file has a nodata value
    full_scale: float | None  # count that corresponds to 1.0; None if it is unknown, and for floats of a file
    # the timing of the sensor with the frame times of the file; None if the frames were not given by one path
    timed: Callable[[SensorTiming], SensorTiming] | None


def load_frames(frames: FramesOrFiles, full_scale: float | None) -> LoadedFrames:
    """Read frames that are given by the paths of their files; other frames are returned unchanged."""
    paths = list(frames) if isinstance(frames, (list, tuple)) else [frames]
    if not paths or not all(isinstance(path, (str, os.PathLike)) for path in paths):
        return LoadedFrames(cast(FramesLike, frames), full_scale, None)
    loaded: LoadedFrames = IMPORTERS["files"]().load_files(paths, full_scale)
    return loaded if isinstance(frames, (str, os.PathLike)) else loaded._replace(timed=None)  # no common time
