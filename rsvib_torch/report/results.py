"""What a run leaves on disk: ``vibration.json``, ``offsets.csv`` and ``restoration.json``."""

import csv
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from rsvib_torch.config import TimingSection, VibrationSection
from rsvib_torch.core.validation import Section, validate
from rsvib_torch.detection import DetectionResult
from rsvib_torch.io import whole_file
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.restoration import RestorationVerdict

__all__ = ["DetectedVibration", "read_vibration", "write_offsets", "write_restoration", "write_vibration"]

_FORMAT = "rsvib vibration"
_UNITS = {
    "amplitude": "px",
    "frequency": "Hz",
    "period": "s",
    "phase": "rad at the first row of frame 0",
    "image_motion": "px/s",
    "image_acceleration": "px/s^2",
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


def _unknown() -> _Numbers:
    return [None, None]


class _StdSection(Section):
    amplitude: list[_Numbers]
    frequency: list[_Numbers]
    period: list[_Numbers]
    phase: list[_Numbers]
    image_motion: _Numbers
    image_acceleration: _Numbers = Field(default_factory=_unknown)

    def std(self) -> VibrationStd:
        """The standard deviations, infinite where not known."""
        return VibrationStd(**{name: _known(getattr(self, name)) for name in VibrationStd.__dataclass_fields__})


def _known(values: list[_Numbers] | _Numbers) -> Tensor:
    return torch.tensor(
        [
            [math.inf if n is None else n for n in row] if isinstance(row, list) else math.inf if row is None else row
            for row in values
        ],
        dtype=torch.float64,
    )


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
        std: Standard deviations of its parameters, infinite where not known.
        timing: The sensor it was detected with.
        reliable: Verdict for each axis (x, y).
        reasons: Why not, for each axis.
    """

    vibration: Vibration
    std: VibrationStd
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
    _write_json(path, content)


def _write_json(path: str | os.PathLike[str], content: dict[str, Any]) -> None:
    """Write a table with one line a key."""
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
        content.vibration.vibration(),
        content.std.std(),
        content.timing.timing(),
        (content.reliable[0], content.reliable[1]),
        (x, y),
    )


def _same(theirs: Any, ours: Any) -> bool:
    if isinstance(theirs, list) and isinstance(ours, list):
        return len(theirs) == len(ours) and all(map(_same, theirs, ours))
    if isinstance(theirs, float) and isinstance(ours, float):
        return math.isclose(theirs, ours, rel_tol=1e-9)
    return bool(theirs == ours)


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


def write_restoration(
    path: str | os.PathLike[str],
    verdict: RestorationVerdict | None,
    *,
    restored: bool,
    options: dict[str, Any],
    left_alone: Sequence[str],
) -> None:
    """Write what was restored, how, and whether it helped, as JSON.

    Args:
        path: The file to write.
        verdict: What pairs of frames say; None where they could not be compared.
        restored: Whether restored frames were written, or the raw ones as they are.
        options: Options of ``restore``.
        left_alone: A sentence for each axis whose vibration was not undone.

    Raises:
        OSError: If the file cannot be written.
    """
    content: dict[str, Any] = {
        "format": "rsvib restoration",
        "version": 1,
        "frames": "restored" if restored else "as taken",
        "options": options,
        "left_alone": list(left_alone),
        "outcome": None if verdict is None else verdict.overall,
        "summary": None if verdict is None else verdict.summary,
    }
    if verdict is not None:
        content["pairs"] = {
            name: _plain(value) for name, value in vars(verdict).items() if isinstance(value, Tensor)
        } | {"outcome": list(verdict.outcome), "reasons": list(verdict.reasons)}
        content["units"] = {"misfit_before": "px", "misfit_after": "px", "resolution": "px", "predicted_gain": "dB"}
    _write_json(path, content)
