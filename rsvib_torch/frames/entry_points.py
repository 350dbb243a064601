"""Public functions of frames: what they have in common, and types with which editors complete their options.

The argument ``frames`` may be the paths of files; ``io``, a package above this one, reads them.

The options of a function are a group (``options.py``). Its callers pass them as keyword arguments, and the function
receives ``options``. A decorator has the type of the arguments that precede the options.
"""

import os
from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, NamedTuple, ParamSpec, Protocol, TypeVar, cast

import numpy as np
import torch
from torch import nn

from rsvib_torch.checks.arguments import FramesLike, FramesOrFiles, PathLike, checks_arguments
from rsvib_torch.checks.values import fields_of, flat_options
from rsvib_torch.execution.parallel import outside_graphs
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming, check_timing
from rsvib_torch.results import IMPORTERS


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


P = ParamSpec("P")
Module = TypeVar("Module")
Options = TypeVar("Options")
Result = TypeVar("Result")
Result_co = TypeVar("Result_co", covariant=True)


class FramesFunction(Protocol[P, Result_co]):
    """A function of frames and their timing."""

    def __call__(self, frames: FramesOrFiles, timing: SensorTiming, *args: P.args, **kwargs: P.kwargs) -> Result_co:
        """Call the function."""


class FileFunction(Protocol[P, Result_co]):
    """A function of the file of a stack, of the file to write, and of the timing."""

    def __call__(
        self, source: PathLike, sink: PathLike, timing: SensorTiming, *args: P.args, **kwargs: P.kwargs
    ) -> Result_co:
        """Call the function."""


class VibrationFunction(Protocol[P, Result_co]):
    """A function of frames, their timing and their vibration."""

    def __call__(
        self,
        frames: FramesOrFiles,
        timing: SensorTiming,
        vibration: Motion | DetectedVibration,
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Result_co:
        """Call the function."""


def frames_options(
    options: Callable[P, Options],
) -> Callable[[Callable[[FramesOrFiles, SensorTiming, Options], Result]], FramesFunction[P, Result]]:
    """Decorator of a function ``(frames, timing, options)``."""
    return lambda function: entry_point(options, function)


def vibration_options(
    options: Callable[P, Options],
) -> Callable[
    [Callable[[FramesOrFiles, SensorTiming, Motion | DetectedVibration, Options], Result]], VibrationFunction[P, Result]
]:
    """Decorator of a function ``(frames, timing, vibration, options)``."""
    return lambda function: entry_point(options, function)


def file_options(
    options: Callable[P, Options],
) -> Callable[[Callable[[PathLike, PathLike, SensorTiming, Options], Result]], FileFunction[P, Result]]:
    """Decorator of a function ``(source, sink, timing, options)``."""
    return lambda function: flat_options(options, checks_arguments(function))


def module_options(
    options: Callable[P, Options],
) -> Callable[[Callable[[Module, SensorTiming, Options], None]], Callable[Concatenate[Module, SensorTiming, P], None]]:
    """Decorator of ``__init__(self, timing, options)`` of a module."""
    return lambda function: flat_options(options, function)


class TimedModule(nn.Module):
    """A module with a fixed timing and fixed options of its function, which its representation states."""

    def __init__(self, timing: SensorTiming, options: object) -> None:
        super().__init__()
        check_timing(timing)
        self.timing, self.options = timing, options

    def extra_repr(self) -> str:
        """The timing, and the options that differ from their defaults."""
        fields = fields_of(type(self.options)).items()
        options = ((name, repr(getattr(self.options, name)), repr(field.default)) for name, field in fields)
        stated = [f"{name}={value}" for name, value, default in options if value != default]
        return ", ".join([f"timing={self.timing}", *stated])


def entry_point(options: Callable[..., object], function: Callable[..., object]) -> Callable[..., Any]:
    """A function with flat options, outside of compiled graphs; arguments as of ``flat_options``."""

    @wraps(function)
    def solved(*args: object, **kwargs: object) -> object:
        try:
            return function(*args, **kwargs)
        except (np.linalg.LinAlgError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
            raise ValueError(
                f"{function.__name__}: the frames do not determine the motion: they show too little detail, objects "
                "that move by themselves, or are far apart in time; use other frames, or for a motion with constant "
                "acceleration detect_vibration(..., image_acceleration=True)"
            ) from error

    return outside_graphs(flat_options(options, solved))
