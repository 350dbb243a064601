"""What a detection leaves on disk: ``vibration.json`` and ``offsets.csv``."""

import csv
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from rsvib_torch.config import TimingSection, VibrationSection
from rsvib_torch.detection import DetectionResult
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.stacks import whole_file
from rsvib_torch.validation import Section, validate
from rsvib_torch.vibration import Vibration

__all__ = ["DetectedVibration", "read_vibration", "reliable_part", "write_offsets", "write_vibration"]

_FORMAT = "rsvib vibration"
_UNITS = {
    "amplitude": "px",
    "frequency": "Hz",
    "period": "s",
    "phase": "rad at the first row of frame 0",
    "image_motion": "px/s",
    "residual": "px",
    "gain": "px of offset per px of displacement",
}
_Numbers = list[float | None]


class _WholeTiming(TimingSection):
    """Timing with every key: a file of the program's own leaves none to defaults."""

    scan_axis: Literal["y", "x"]
    readout_direction: Literal["forward", "reverse"]
    frame_start_times: list[float] | None


class _WholeVibration(VibrationSection):
    """Vibration with every key."""

    phase: list[list[float]]
    image_motion: list[float]


class _StdSection(Section):
    amplitude: list[_Numbers]
    frequency: list[_Numbers]
    period: list[_Numbers]
    phase: list[_Numbers]
    image_motion: _Numbers


class _VibrationFile(Section):
    """Keys of ``vibration.json``; lists are ordered (x, y), null stands for what is not known or not finite."""

    format: Literal["rsvib vibration"]
    version: Literal[1]
    timing: _WholeTiming
    vibration: _WholeVibration
    period: list[_Numbers]
    std: _StdSection
    gain: list[_Numbers]
    residual: _Numbers
    reliable: list[bool]
    reasons: list[list[str]]
    units: dict[str, str]


@dataclass(frozen=True, eq=False)
class DetectedVibration:
    """A vibration read from a file.

    Attributes:
        vibration: The vibration in image axes.
        timing: The sensor it was detected with.
        reliable: Verdict for each axis (x, y).
        reasons: Why not, for each axis.
    """

    vibration: Vibration
    timing: SensorTiming
    reliable: tuple[bool, bool]
    reasons: tuple[tuple[str, ...], tuple[str, ...]]


def _plain(value: Tensor) -> Any:
    """Nested lists of numbers, None where not finite."""

    def known(number: Any) -> Any:
        if isinstance(number, list):
            return [known(n) for n in number]
        return number if math.isfinite(number) else None

    return known(value.detach().cpu().tolist())


def write_vibration(path: str | os.PathLike[str], result: DetectionResult, timing: SensorTiming) -> None:
    """Write the vibration, its standard deviations and verdict as JSON, with the timing it was detected with.

    Args:
        path: The file to write.
        result: A detection (not a batch).
        timing: The sensor.

    Raises:
        OSError: If the file cannot be written.
    """
    vibration = result.vibration
    content = {
        "format": _FORMAT,
        "version": 1,
        "timing": _timing_keys(timing),
        "vibration": {name: _plain(getattr(vibration, name)) for name in VibrationSection.model_fields},
        "period": _plain(vibration.period),
        "std": {name: _plain(getattr(result.std, name)) for name in _StdSection.model_fields},
        "gain": _plain(result.gain),
        "residual": _plain(result.residual),
        "reliable": result.reliable.tolist(),
        "reasons": [list(axis) for axis in result.reasons],
        "units": _UNITS,
    }
    with whole_file(path) as part:
        lines = (f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in content.items())
        part.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def _timing_keys(timing: SensorTiming) -> dict[str, Any]:
    keys = {name: getattr(timing, name) for name in TimingSection.model_fields}
    keys["scan_axis"] = {-2: "y", -1: "x"}[keys["scan_axis"]]
    keys["frame_start_times"] = None if keys["frame_start_times"] is None else list(keys["frame_start_times"])
    return keys


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def read_vibration(path: str | os.PathLike[str], timing: SensorTiming) -> DetectedVibration:
    """Read what ``write_vibration`` wrote.

    Args:
        path: The file.
        timing: The sensor of the frames to be restored.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not a complete ``vibration.json``, or was detected with another timing.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a vibration.json: {error}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path}: not a vibration.json: expected a table, got {type(data).__name__}")
    content = validate(_VibrationFile, data, str(path))
    if len(content.reliable) != 2 or len(content.reasons) != 2:
        raise ValueError(f"{path}: reliable and reasons must have two entries (x, y)")
    theirs, ours = _timing_keys(content.timing.timing()), _timing_keys(timing)
    different = [name for name in ours if not _same(theirs[name], ours[name])]
    if different:
        names = ", ".join(f"{name}={theirs[name]!r} (here {ours[name]!r})" for name in different)
        raise ValueError(f"{path}: the vibration of another camera: detected with {names}")
    x, y = (tuple(axis) for axis in content.reasons)
    return DetectedVibration(
        content.vibration.vibration(), content.timing.timing(), (content.reliable[0], content.reliable[1]), (x, y)
    )


def _same(theirs: Any, ours: Any) -> bool:
    if isinstance(theirs, list) and isinstance(ours, list):
        return len(theirs) == len(ours) and all(map(_same, theirs, ours))
    if isinstance(theirs, float) and isinstance(ours, float):
        return math.isclose(theirs, ours, rel_tol=1e-9)
    return bool(theirs == ours)


def reliable_part(vibration: Vibration, reliable: Tensor | tuple[bool, bool]) -> Vibration:
    """The vibration with an axis that is not reliable taken as standing still.

    Args:
        vibration: One vibration (not a batch).
        reliable: Verdict for each axis (x, y).

    Example:
        >>> reliable_part(Vibration([3.0, 2.0], [50.0, 30.0]), (True, False)).amplitude.flatten().tolist()
        [3.0, 0.0]
    """
    keep = torch.as_tensor(reliable, dtype=torch.float64, device=vibration.device)
    return Vibration(
        vibration.amplitude * keep[:, None], vibration.frequency, vibration.phase, vibration.image_motion * keep
    )


def write_offsets(path: str | os.PathLike[str], result: DetectionResult) -> None:
    """Write the measured and the fitted offset curve as CSV, one line a band; a failed band has empty offsets.

    Args:
        path: The file to write.
        result: A detection (not a batch).

    Raises:
        OSError: If the file cannot be written.
    """
    curve = result.offsets
    count = curve.times.shape[-1]
    columns = {
        "earlier_frame": curve.pairs[:, :1].expand(-1, count),
        "later_frame": curve.pairs[:, 1:].expand(-1, count),
        "row": curve.rows.expand_as(curve.times),
        "time_s": curve.times,
        "offset_x_px": curve.offsets[..., 0],
        "offset_y_px": curve.offsets[..., 1],
        "fitted_x_px": result.fitted[..., 0],
        "fitted_y_px": result.fitted[..., 1],
        "quality": curve.quality,
    }
    values = [_plain(column.flatten()) for column in columns.values()]
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*values, strict=True))  # None is written as an empty cell
