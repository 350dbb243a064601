"""``manifest.json``: what a run read, how, and what became of every window."""

import hashlib
import json
import os
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from rsvib_torch.core.validation import Section, read_json, validate
from rsvib_torch.io.schema import DetectedVibration, TimingRecord, detection_to_json
from rsvib_torch.stacks.job import StackJob
from rsvib_torch.stacks.records import WindowRecord

__all__ = ["StackManifest", "manifest_header", "read_manifest", "write_manifest"]

_FORMAT = "rsvib stack"
_UNITS = {
    "start_time": "s, of the first row of the first frame of a window, where its time begins",
    "amplitude": "px",
    "frequency": "Hz",
    "period": "s",
    "phase": "rad at start_time",
    "image_motion": "px/s",
    "image_acceleration": "px/s^2",
    "residual": "px",
}


class StackManifest(Section):
    """What ``manifest.json`` says.

    Attributes:
        format: ``"rsvib stack"``.
        version: Of the format.
        input: Name, size and hash of the stack.
        settings: Sensor and options.
        versions: Of the packages that computed it.
        output: Name of what was written; None where nothing was.
        units: Of the numbers.
        bad_frames: Frames that could not be used, with the reason.
        windows: What became of every window.
    """

    format: Literal["rsvib stack"]
    version: Literal[1]
    input: dict[str, Any]
    settings: dict[str, Any]
    versions: dict[str, Any]
    output: dict[str, Any] | None
    units: dict[str, str]
    bad_frames: dict[str, str]
    windows: list[WindowRecord]

    def header(self) -> dict[str, Any]:
        """All that was known before the first window."""
        return {"input": self.input, "settings": self.settings, "versions": self.versions, "output": self.output}

    def detections(self) -> list[DetectedVibration | None]:
        """What was detected in every window; None where nothing could be."""
        return [None if record.detection is None else record.detection.to_detection() for record in self.windows]


def _given_keys(given: Iterable[DetectedVibration | None]) -> str:
    records = [detection_to_json(detected) for detected in given]
    return hashlib.sha256(json.dumps(records).encode()).hexdigest()


def manifest_header(
    job: StackJob, window: int, output: str | None, compression: str | None, source: dict[str, Any]
) -> dict[str, Any]:
    """Everything that the result depends on: a run goes on only where it is the same."""
    shape = {"shape": list(job.info.shape), "dtype": job.info.dtype}
    settings = {
        "sensor": TimingRecord.from_timing(job.timing).model_dump(),
        "full_scale": job.full_scale,
        "window": window,
        "detection": dict(job.detection),
        "restoration": None if job.restoration is None else dict(job.restoration),
        "given": None if job.given is None else _given_keys(job.given.values()),
        "bad_frames": job.bad_frames,
        "force": job.force,
        "device": job.device.partition(":")[0],
    }
    header = {
        "input": {**source, **shape},
        "settings": settings,
        "versions": {name: version(name) for name in ("rsvib_torch", "torch", "numpy")},
        "output": None if output is None else {"name": output, "compression": compression},
    }
    copy: dict[str, Any] = json.loads(json.dumps(header))
    return copy


def write_manifest(path: Path, header: dict[str, Any], records: Iterable[dict[str, Any]]) -> None:
    """Write a manifest, one line a key and one a window; the records are gone through once.

    Args:
        path: The file to write; a temporary name, for it is not written at once.
        header: What ``manifest_header`` made.
        records: Contents of ``WindowRecord``.
    """
    bad: dict[str, str] = {}
    with path.open("w", encoding="utf-8") as file:
        file.write("{\n")
        for key, value in {"format": _FORMAT, "version": 1, **header, "units": _UNITS}.items():
            file.write(f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)},\n")
        file.write('  "windows": [')
        for number, record in enumerate(records):
            bad.update(record["bad_frames"])
            file.write(",\n    " if number else "\n    ")
            file.write(json.dumps(record, allow_nan=False))
        file.write(f'\n  ],\n  "bad_frames": {json.dumps(bad)}\n}}\n')
        file.flush()
        os.fsync(file.fileno())


def read_manifest(path: str | os.PathLike[str]) -> StackManifest:
    """Read what a run wrote down.

    Args:
        path: The ``manifest.json``.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not a complete manifest.
    """
    path = Path(path)
    manifest = validate(StackManifest, read_json(path, "manifest.json"), str(path))
    for number, record in enumerate(manifest.windows):
        if record.window != number:
            raise ValueError(f"{path}: windows[{number}].window: expected {number}, got {record.window}")
    return manifest
