"""TOML configuration files: the camera, and the options of simulation, detection and restoration."""

import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, create_model, model_validator

from rsvib_torch.core.checks import check_number, check_whole_number
from rsvib_torch.core.validation import Section, checked, options_section, validate
from rsvib_torch.detection.detect import ToneOptions
from rsvib_torch.imaging import SensorNoise
from rsvib_torch.io.schema import TimingRecord, VibrationRecord
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.restoration.exact.priors import PRIORS
from rsvib_torch.restoration.restore import METHODS, CommonOptions
from rsvib_torch.stacks import DEFAULT_WINDOW, BadFrames

__all__ = ["Config", "Simulation", "read_config"]


@dataclass(frozen=True)
class Simulation:
    """Content of ``[simulation]``.

    Attributes:
        vibration: The motion to simulate.
        num_frames: Number of frames.
        frame_size: (height, width) of the frames in px; None for the largest size that the scene allows.
        noise: Noise of the sensor; None for none.
        seed: Seed of the noise.
    """

    vibration: Vibration
    num_frames: int
    frame_size: tuple[int, int] | None
    noise: SensorNoise | None
    seed: int


@dataclass(frozen=True)
class Config:
    """Content of a configuration file.

    Attributes:
        timing: The sensor.
        full_scale: Count that corresponds to 1.0 in integer frames; None if it is not in the file.
        detection: Options of ``detect_vibration`` that are in the file.
        restoration: Options of ``restore`` that are in the file.
        simulation: Vibration and noise to simulate; None if it is not in the file.
        stack: Options ``window`` and ``bad_frames`` of ``process_stack`` that are in the file.
    """

    timing: SensorTiming
    full_scale: float | None
    detection: dict[str, Any]
    restoration: dict[str, Any]
    simulation: Simulation | None
    stack: dict[str, Any]


class SensorSection(TimingRecord):
    """``[sensor]``: the timing, and the full scale of integer frames."""

    scan_axis: Literal["y", "x"] = "y"
    readout_direction: Literal["forward", "reverse"] = "forward"
    frame_start_times: list[float] | None = None
    full_scale: float | None = None

    @model_validator(mode="after")
    def _check_full_scale(self) -> Self:
        if self.full_scale is not None:
            check_number("full_scale", self.full_scale, above=0.0)
        return self


class VibrationSection(VibrationRecord):
    """``[simulation.vibration]``: phase and image motion are optional."""

    phase: list[float] | list[list[float]] = Field(default_factory=lambda: [0.0, 0.0])
    image_motion: list[float] = Field(default_factory=lambda: [0.0, 0.0])


_NoiseSection = options_section("_NoiseSection", SensorNoise)


class _SimulationSection(Section):
    """``[simulation]``."""

    vibration: VibrationSection
    num_frames: int = 2
    frame_size: list[int] | None = None
    noise: _NoiseSection | None = None  # type: ignore[valid-type]
    seed: int = 0

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_whole_number("num_frames", self.num_frames, at_least=1)
        check_whole_number("seed", self.seed, at_least=0)
        if self.frame_size is not None and (len(self.frame_size) != 2 or min(self.frame_size) < 1):
            raise ValueError(f"frame_size must be [height, width] in px, got {self.frame_size}")
        checked(self.simulation)
        return self

    def simulation(self) -> Simulation:
        """The values as a ``Simulation``."""
        size = None if self.frame_size is None else (self.frame_size[0], self.frame_size[1])
        noise = None if self.noise is None else SensorNoise(**_given(self.noise))
        return Simulation(self.vibration.to_vibration(), self.num_frames, size, noise, self.seed)


_DetectionSection = options_section(
    "_DetectionSection", ToneOptions, skip=("full_scale", "ignore", "channels", "window", "window_step")
)


class _StackSection(Section):
    """``[stack]``: processing of stacks in windows."""

    window: int = Field(default=DEFAULT_WINDOW, ge=2)
    bad_frames: BadFrames = "pass"


def _restoration_section(method: object) -> Any:
    """``[restoration]``: the keys depend on the method."""
    chosen = METHODS[method if isinstance(method, str) and method in METHODS else "exact"]
    common: dict[str, Any] = {"method": Literal[*METHODS], "saturation": float | None}
    if "prior" in chosen.options.__annotations__:
        common["prior"] = Literal[*PRIORS]
    return options_section(
        "_RestorationSection", chosen.options, skip=("method", *CommonOptions.__annotations__), **common
    )


def read_config(path: str | os.PathLike[str]) -> Config:
    """Read a configuration file.

    Only ``[sensor]`` is required.

    * ``[sensor]``: fields of ``SensorTiming``, and ``full_scale``.
    * ``[detection]``: options of ``detect_vibration``.
    * ``[restoration]``: options of ``restore``, with ``saturation`` in the unit of the frames' file.
    * ``[simulation]``: ``num_frames``, ``frame_size``, ``seed``, ``[simulation.vibration]`` (fields of ``Vibration``)
      and ``[simulation.noise]`` (fields of ``SensorNoise``).
    * ``[stack]``: ``window`` and ``bad_frames`` of ``process_stack``.

    Args:
        path: The TOML file.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not TOML, or a key is missing, unknown or has a wrong type or value: one line per key,
            with its path, its value and what was expected.
    """
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not a TOML file: {error}") from error
    restoration = data.get("restoration")
    method = restoration.get("method") if isinstance(restoration, dict) else None
    root: Any = create_model(
        "_Root",
        __base__=Section,
        sensor=(SensorSection, ...),
        detection=(_DetectionSection | None, None),
        restoration=(_restoration_section(method) | None, None),
        simulation=(_SimulationSection | None, None),
        stack=(_StackSection | None, None),
    )
    checked_data = validate(root, data, str(path))
    sensor, simulation = checked_data.sensor, checked_data.simulation
    return Config(
        timing=sensor.to_timing(),
        full_scale=sensor.full_scale,
        detection=_given(checked_data.detection),
        restoration=_given(checked_data.restoration),
        simulation=None if simulation is None else simulation.simulation(),
        stack=_given(checked_data.stack),
    )


def _given(section: Any) -> dict[str, Any]:
    """The keys that are in the file; the functions that take the options have the defaults."""
    return {} if section is None else section.model_dump(exclude_unset=True)
