"""TOML configuration files: the camera, and the options of simulation, detection and restoration.

A file is checked without torch, whose import takes seconds, except for ``[simulation]``.
"""

import functools
import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, create_model, model_validator

from rsvib_torch.core.checks import check_number
from rsvib_torch.core.reading import read_text
from rsvib_torch.core.validation import Count, Section, checked, validate
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import RestorationOptions, ToneOptions, WindowOptions

_MAX_BYTES = 10**7  # start times of 500,000 frames
_MAX_DEPTH = 100  # parts of a key; the deepest key of the format has 3
_AGREEMENT = 1e-3  # relative; keys that state the same time twice are rounded by whoever wrote them


@dataclass(frozen=True)
class Config:
    """Content of a configuration file.

    Attributes:
        source: Name of the file, for messages.
        timing: The sensor.
        full_scale: Count that corresponds to 1.0 in integer frames; None if it is not in the file.
        detection: Options of ``detect_vibration`` that are in the file.
        restoration: Options of ``restore`` that are in the file.
        simulation: ``[simulation]``, of the class ``simulation_section``; None if it is not in the file.
        stack: Options ``window`` and ``bad_frames`` of ``process_stack`` that are in the file.
        arguments: Options of the program that describe the camera, for the commands that it suggests.
        path: The file; None if the camera is described by options only.
    """

    source: str
    timing: SensorTiming
    full_scale: float | None
    detection: dict[str, Any]
    restoration: dict[str, Any]
    simulation: Any
    stack: dict[str, Any]
    arguments: tuple[str, ...] = ()
    path: Path | None = None


class SensorSection(Section):
    """``[sensor]``: the timing, and the full scale of integer frames.

    Exposure and frame period are in seconds (``exposure_time``, ``frame_rate``) or in row times (``exposure_rows``,
    ``frame_rows``).
    """

    row_time: float = Field(
        description="Time between the exposure starts of adjacent rows, in s. Data sheets call it line time or row "
        "period; 'rsvib calibrate' measures it with a flickering light. It is not 1 / (frame rate x rows), because "
        "sensors have blanking rows."
    )
    exposure_time: float | None = Field(
        default=None,
        description="Exposure time in s: the setting of the camera (shutter, integration time), not the frame period.",
    )
    exposure_rows: float | None = Field(default=None, description="Exposure time divided by row_time.")
    frame_rate: float | None = Field(
        default=None,
        description="Frames per second of the sensor. A slow-motion or time-lapse video is played at another rate.",
    )
    frame_rows: float | None = Field(
        default=None,
        description="Frame period divided by row_time, blanking rows included: 1 / (frame rate x row_time).",
    )
    scan_axis: Literal["y", "x"] = Field(
        default="y",
        description="'y' if image rows are exposed one after another, 'x' for image columns (a camera on its side).",
    )
    readout_direction: Literal["forward", "reverse"] = Field(
        default="forward",
        description="'forward' if the top row (or left column) is read first, 'reverse' if the last one is.",
    )
    frame_start_times: list[float] | None = Field(
        default=None,
        description="Exposure start of the first row of each frame in seconds, for frames that are not evenly spaced "
        "(dropped frames, irregular clocks); strictly increasing.",
    )
    full_scale: float | None = Field(
        default=None, description="Count of a saturated pixel: 4095 for 12 bits, also in a 16-bit file."
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        checked(self.to_timing)
        if self.full_scale is not None:
            check_number("full_scale", self.full_scale, above=0.0)
        return self

    def to_timing(self) -> SensorTiming:
        """The timing, with exposure and frame period in row times."""
        row_time = check_number("row_time", self.row_time, above=0.0)
        rate = self.frame_rate
        if rate is not None and check_number("frame_rate", rate, above=0.0) < 0.1:
            raise ValueError(f"frame_rate={rate:g} is less than 0.1; it is in frames per second, 1 / (frame period)")
        exposure = None if self.exposure_time is None else self.exposure_time / row_time
        period = None if rate is None else 1.0 / (rate * row_time)
        return SensorTiming(
            row_time,
            _in_rows("exposure_time", self.exposure_time, exposure, "exposure_rows", self.exposure_rows),
            _in_rows("frame_rate", rate, period, "frame_rows", self.frame_rows),
            self.scan_axis,
            self.readout_direction,
            self.frame_start_times,
        )


def _in_rows(name: str, value: float | None, converted: float | None, rows_name: str, rows: float | None) -> float:
    """A time in row times that is stated by one of two keys, or by both if they agree."""
    if rows is None:
        if converted is None:
            raise ValueError(f"{name} or {rows_name} is missing")
        return converted
    if converted is not None and not math.isclose(converted, rows, rel_tol=_AGREEMENT):
        raise ValueError(
            f"{name}={value:g} contradicts {rows_name}={rows:g}: with this row_time it is {rows_name}={converted:.6g}; "
            "remove one of the two keys"
        )
    return rows


@functools.cache
def simulation_section() -> Any:
    """Class of ``[simulation]``; it needs torch, which takes seconds to import."""
    from rsvib_torch.imaging.sensor_model import SensorNoise  # noqa: PLC0415
    from rsvib_torch.motion.camera import Camera  # noqa: PLC0415
    from rsvib_torch.motion.vibration import Vibration  # noqa: PLC0415

    tones = list[float] | list[list[float]]
    axes = Field(default_factory=lambda: [0.0, 0.0])

    class CameraSection(Section):
        focal_length: float
        principal_point: list[float] = Field(default_factory=lambda: [0.0] * 2, min_length=2, max_length=2)
        distortion: list[float] = Field(default_factory=lambda: [0.0] * 5, min_length=5, max_length=5)

    class VibrationSection(Section):
        """Fields of ``Vibration``, which checks their values; an axis is one number (one tone) or a list of tones."""

        amplitude: tones
        frequency: tones
        phase: tones = axes
        image_motion: list[float] = axes
        image_acceleration: list[float] = axes
        image_shift: list[float] = axes
        camera: CameraSection | None = None

        @model_validator(mode="after")
        def _check(self) -> Self:
            checked(self.to_vibration)
            return self

        def to_vibration(self) -> Vibration:
            camera = None if self.camera is None else Camera(**dict(self.camera))
            return Vibration(**{**dict(self), "camera": camera})

    class SimulationSection(Section):
        vibration: VibrationSection
        num_frames: Count = Field(default=2, description="Number of frames.")
        frame_size: tuple[Count, Count] | None = Field(
            default=None,
            strict=False,
            description="(height, width) of the frames in px; None for the largest size that the scene allows.",
        )
        noise: SensorNoise | None = None
        seed: int = Field(default=0, ge=0, le=2**63 - 1, description="Seed of the noise.")

    return SimulationSection


class ConfigFile(Section):
    """All tables of a file; the keys of ``[simulation]`` are those of ``simulation_section``."""

    sensor: SensorSection
    detection: ToneOptions | None = None
    restoration: RestorationOptions | None = None
    simulation: Any = None
    stack: WindowOptions | None = None


def presets() -> dict[str, str]:
    """Text of the configuration files that are part of the package, by name."""
    folder = files("rsvib_torch") / "presets"
    return {
        entry.name.removesuffix(".toml"): entry.read_text(encoding="utf-8")
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.name)
    }


def read_config(path: str | os.PathLike[str] | None, *, sensor: Mapping[str, Any] | None = None) -> Config:
    """Read a configuration file.

    Only ``[sensor]`` is required.

    * ``[sensor]``: fields of ``SensorTiming``, with ``exposure_time`` and ``frame_rate`` in place of ``exposure_rows``
      and ``frame_rows`` if they are known in seconds, and ``full_scale``.
    * ``[detection]``: options of ``detect_vibration``.
    * ``[restoration]``: options of ``restore``, with ``saturation`` in the unit of the frames' file.
    * ``[simulation]``: ``num_frames``, ``frame_size``, ``seed``, ``[simulation.vibration]`` (fields of ``Vibration``)
      and ``[simulation.noise]`` (fields of ``SensorNoise``).
    * ``[stack]``: ``window`` and ``bad_frames`` of ``process_stack``.

    Args:
        path: The TOML file; None if ``sensor`` describes the camera.
        sensor: Keys of ``[sensor]`` that replace those of the file. ``exposure_time`` also replaces ``exposure_rows``,
            ``frame_rate`` also ``frame_rows``, and vice versa.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not TOML, or a key is missing, unknown or has a wrong type or value: one line per key,
            with its path, its value and what was expected.

    Example:
        >>> camera = {"row_time": 20e-6, "exposure_time": 1e-3, "frame_rate": 25}
        >>> read_config(None, sensor=camera).timing.frame_rows
        2000.0
    """
    data = {} if path is None else _read_toml(Path(path))
    source = "the command line" if path is None else str(path)
    if sensor:
        stated = data.get("sensor", {})
        if isinstance(stated, dict):
            same = ({"exposure_time", "exposure_rows"}, {"frame_rate", "frame_rows"})
            replaced = set(sensor).union(*(pair for pair in same if pair & set(sensor)))
            stated = {name: value for name, value in stated.items() if name not in replaced}
            data["sensor"] = {**stated, **sensor}
    content = validate(ConfigFile, data, source)
    simulation = None
    if content.simulation is not None:
        part: Any = create_model("_Part", __base__=Section, simulation=(simulation_section(), ...))
        simulation = validate(part, {"simulation": content.simulation}, source).simulation
    return Config(
        source=source,
        timing=content.sensor.to_timing(),
        full_scale=content.sensor.full_scale,
        detection=data.get("detection", {}),
        restoration=data.get("restoration", {}),
        simulation=simulation,
        stack=data.get("stack", {}),
        path=None if path is None else Path(path),
    )


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        text = read_text(path, at_most=_MAX_BYTES)
        # the parser takes quadratic time for nested keys; lists of numbers have as many commas as points
        if any(line.count(".") > line.count(",") + _MAX_DEPTH for line in text.splitlines() if line[:1] != "#"):
            raise ValueError(f"a key has more than {_MAX_DEPTH} parts")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a TOML file: {error}") from error
