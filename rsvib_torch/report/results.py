"""Result files: ``vibration.json``, ``offsets.csv``, ``restoration.json`` and ``windows.csv``."""

import csv
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from rsvib_torch.core.validation import read_json, validate
from rsvib_torch.detection import DetectionResult
from rsvib_torch.io import whole_file
from rsvib_torch.io.schema import DetectedVibration, DetectionRecord, TimingRecord, check_same_timing, to_json
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks import RestoredFrames, StackManifest

__all__ = ["VibrationFile", "read_vibration", "write_offsets", "write_restoration", "write_vibration", "write_windows"]

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


class VibrationFile(DetectionRecord):
    """Content of ``vibration.json``."""

    format: Literal["rsvib vibration"]
    version: Literal[1]
    timing: TimingRecord
    period: list[list[float | None]]
    units: dict[str, str]


def write_vibration(path: str | os.PathLike[str], result: DetectionResult, timing: SensorTiming) -> None:
    """Write a vibration, its standard deviations and verdict as JSON, with the timing it was detected with.

    Args:
        path: The file to write.
        result: A detection (not a batch).
        timing: The sensor.

    Raises:
        OSError: If the file cannot be written.
    """
    record = VibrationFile.from_detection(
        result,
        format="rsvib vibration",
        version=1,
        timing=TimingRecord.from_timing(timing),
        period=to_json(result.vibration.period),
        units=_UNITS,
    ).model_dump()
    names = ("format", "version", "timing", "vibration", "period")
    _write_json(path, {**{name: record[name] for name in names}, **record})


def _write_json(path: str | os.PathLike[str], content: dict[str, Any]) -> None:
    """Write a table with one key per line."""
    with whole_file(path) as part:
        lines = (f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in content.items())
        part.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def read_vibration(path: str | os.PathLike[str], timing: SensorTiming) -> DetectedVibration:
    """Read a file that ``write_vibration`` wrote.

    Args:
        path: The file.
        timing: The sensor of the frames to be restored.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not a complete ``vibration.json``, or was detected with another timing.
    """
    path = Path(path)
    record = validate(VibrationFile, read_json(path, "vibration.json"), str(path))
    check_same_timing(str(path), record.timing, timing)
    try:
        return record.to_detection()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write_offsets(path: str | os.PathLike[str], result: DetectionResult) -> None:
    """Write the measured and the fitted offset curve as CSV, one line per band; a failed band has empty offsets.

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
    values = [to_json(column.flatten()) for column in columns.values()]
    _write_csv(path, columns, zip(*values, strict=True))


def _write_csv(path: str | os.PathLike[str], head: Iterable[str], lines: Iterable[Iterable[Any]]) -> None:
    """Write a table; None becomes an empty cell."""
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(head)
        writer.writerows(lines)


def write_windows(path: str | os.PathLike[str], manifest: StackManifest) -> None:
    """Write a table of the windows of a stack as CSV: the strongest tone of each axis, and the verdict.

    Args:
        path: The file to write.
        manifest: The manifest of the stack.

    Raises:
        OSError: If the file cannot be written.
    """
    quantities = ("amplitude", "frequency", "phase")
    head = ["window", "first_frame", "last_frame", "start_s"]
    for letter in "xy":
        head += [f"{name}_{letter}{end}" for name in quantities for end in ("", "_std")]
        head += [f"image_motion_{letter}", f"reliable_{letter}"]
    lines = []
    for record in manifest.windows:
        line: list[Any] = [record.window, record.first, record.last, record.start_time]
        detection = record.detection
        for axis in (0, 1):
            if detection is None:
                line += [None] * (2 * len(quantities) + 2)
                continue
            vibration, std = detection.vibration, detection.std
            for name in quantities:
                line += [getattr(vibration, name)[axis][0], getattr(std, name)[axis][0]]
            line += [vibration.image_motion[axis], detection.reliable[axis]]
        note = record.error or "; ".join(record.left_alone)
        lines.append([*line, record.frames, record.outcome, len(record.bad_frames), note])
    _write_csv(path, [*head, "frames", "outcome", "bad_frames", "note"], lines)


def write_restoration(
    path: str | os.PathLike[str], result: RestoredFrames, options: dict[str, Any], not_kept: Sequence[str] = ()
) -> None:
    """Write whether frames were restored, with which options, and whether that helped, as JSON.

    Args:
        path: The file to write.
        result: Restored frames with their verdict.
        options: Options of ``restore``.
        not_kept: Metadata of the input that the output does not contain.

    Raises:
        OSError: If the file cannot be written.
    """
    verdict = result.verdict
    content: dict[str, Any] = {
        "format": "rsvib restoration",
        "version": 1,
        "frames": "restored" if result.restored else "as taken",
        "options": options,
        "left_alone": list(result.left_alone),
        "outcome": None if verdict is None else verdict.overall,
        "summary": None if verdict is None else verdict.summary,
        "not_kept": list(not_kept),
    }
    if verdict is not None:
        pairs = {name: to_json(value) for name, value in vars(verdict).items() if isinstance(value, Tensor)}
        content["pairs"] = {**pairs, "outcome": list(verdict.outcome), "reasons": list(verdict.reasons)}
        content["units"] = {"misfit_before": "px", "misfit_after": "px", "resolution": "px", "predicted_gain": "dB"}
    _write_json(path, content)
