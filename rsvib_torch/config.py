"""TOML configuration files: the camera, and the options of detection and restoration.

A file is checked without torch, whose import takes seconds.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rsvib_torch.checks.values import options, validate
from rsvib_torch.files.reading import Table, read_toml
from rsvib_torch.motion.timing import SensorSection, SensorTiming
from rsvib_torch.options import RestorationOptions, ToneOptions, WindowOptions


@dataclass(frozen=True)
class Config:
    """Content of a configuration file."""

    source: str  # name of the file, for messages
    timing: SensorTiming  # the sensor
    full_scale: float | None  # count that corresponds to 1.0 in integer frames; None if it is not in the file
    detection: Table  # options of ``detect_vibration`` that are in the file
    restoration: Table  # options of ``restore`` that are in the file
    stack: Table  # the option ``window`` of ``process_stack`` if it is in the file
    # options of the program that describe the camera, for the commands that it suggests
    arguments: tuple[str, ...] = ()
    path: Path | None = None  # the file; None if the camera is described by options only


@options
class ConfigFile:
    """All tables of a file."""

    sensor: SensorSection
    detection: ToneOptions | None = None
    restoration: RestorationOptions | None = None
    stack: WindowOptions | None = None


def read_config(path: str | os.PathLike[str] | None, *, sensor: Mapping[str, object] | None = None) -> Config:
    """Read a configuration file, of which only ``[sensor]`` is required (docs/configuration.md).

    Args:
        path: The TOML file; None if ``sensor`` describes the camera.
        sensor: Keys of ``[sensor]`` that replace those of the file. ``exposure_time`` also replaces ``exposure_rows``,
            ``frame_rate`` also ``frame_rows``, ``row_time`` also ``row_time_std``, and vice versa.

    Raises:
        ValueError: If it is not TOML, or keys are missing, unknown or have a wrong type or value: one line for each.

    Example:
        >>> camera = {"row_time": 20e-6, "exposure_time": 1e-3, "frame_rate": 25}
        >>> read_config(None, sensor=camera).timing.frame_rows
        2000.0
    """
    data = {} if path is None else read_toml(Path(path))
    source = "the command line" if path is None else str(path)
    stated_in = f"{source} and the command line" if sensor and path is not None else source
    if sensor:
        stated = data.get("sensor", {})
        if isinstance(stated, dict):
            same = ({"exposure_time", "exposure_rows"}, {"frame_rate", "frame_rows"}, {"row_time", "row_time_std"})
            replaced = set(sensor).union(*(pair for pair in same if pair & set(sensor)))
            stated = {name: value for name, value in stated.items() if name not in replaced}
            data["sensor"] = {**stated, **sensor}
    content = validate(ConfigFile, data, stated_in)
    return Config(
        source=source,
        timing=content.sensor.to_timing(),
        full_scale=content.sensor.full_scale,
        detection=data.get("detection", {}),
        restoration=data.get("restoration", {}),
        stack=data.get("stack", {}),
        path=None if path is None else Path(path),
    )
