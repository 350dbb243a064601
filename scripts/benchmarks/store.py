"""Stored results of benchmarks: one JSON file per section, from which docs/benchmarks.md is generated.

Numbers that are not finite are stored as text ("nan", "inf"), because JSON has none.
"""

import argparse
import datetime
import json
import math
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measure import machine

import rsvib_torch as rsv

__all__ = ["RESULTS", "StoredResult", "read_result", "write_result"]

RESULTS = Path(__file__).parent / "results"
_NOT_FINITE = ("nan", "inf", "-inf")


@dataclass(frozen=True)
class StoredResult:
    """Result of one section of the benchmark.

    Attributes:
        section: Name of the section.
        version: Version of rsvib_torch.
        commit: Commit of the working tree, with "+" if it had changes; None outside a repository.
        date: Date of the run, YYYY-MM-DD.
        seconds: Duration of the run.
        machine: Processor, cores, threads and libraries, see ``measure.machine``.
        options: Options of the run.
        rows: Measured figures.
    """

    section: str
    version: str
    commit: str | None
    date: str
    seconds: float
    machine: dict[str, Any]
    options: argparse.Namespace
    rows: list[dict[str, Any]]


def _encode(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _encode(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_encode(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return str(value) if isinstance(value, Path) else value


def _decode(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _decode(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_decode(item) for item in value]
    return float(value) if value in _NOT_FINITE else value


def _commit() -> str | None:
    """Short hash of the commit of this working tree, with "+" if files of it have changed."""

    def git(*arguments: str) -> str:
        command = ["git", *arguments]
        return subprocess.run(command, cwd=RESULTS.parent, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short=10", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def write_result(
    section: str, rows: list[dict[str, Any]], options: argparse.Namespace, seconds: float, folder: Path = RESULTS
) -> Path:
    """Store the result of a section as ``section.json``.

    Args:
        section: Name of the section.
        rows: Measured figures: numbers, texts, lists and tables of them.
        options: Options of the run.
        seconds: Duration of the run.
        folder: Folder of the file.
    """
    content = {
        "section": section,
        "version": rsv.__version__,
        "commit": _commit(),
        "date": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "seconds": round(seconds, 1),
        "machine": machine(),
        "options": {name: value for name, value in vars(options).items() if name not in ("out", "only", "store")},
        "rows": rows,
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{section}.json"
    path.write_text(json.dumps(_encode(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path


def read_result(path: Path) -> StoredResult:
    """Read a file that ``write_result`` wrote."""
    content = json.loads(path.read_text(encoding="utf-8"))
    rows, options = _decode(content["rows"]), argparse.Namespace(**_decode(content["options"]))
    return StoredResult(**{**content, "rows": rows, "options": options})
