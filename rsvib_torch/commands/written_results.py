"""Results that commands write into a folder: files of detections and windows, and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import rsvib_torch
from rsvib_torch import io, stacks
from rsvib_torch import report as reports
from rsvib_torch.commands.shared_options import check_new
from rsvib_torch.commands.terminal import note, warn, working
from rsvib_torch.files.atomic import check_writable, write_json
from rsvib_torch.text import number_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


OF_DETECTION = ("vibration.json", "tones.csv", "offsets.csv", "offsets.png", "spectrum.csv", "spectrum.png")
OF_WINDOWS = ("manifest.json", "tones.csv", "windows.json", "windows.png")


def check_folder(
    folder: Path, names: Iterable[str], overwrite: bool, inputs: Iterable[Path], output: Path | None = None
) -> None:
    """Raise an error if results, among them a stack ``output``, exist in a folder or would replace an input."""
    stack = [] if output is None else io.stack_files(output)
    check_new([*(folder / name for name in dict.fromkeys(names)), *stack], overwrite, inputs, folder=folder)
    check_writable(folder, folder=True)


def remove_old(folder: Path, results: Iterable[str], names: Iterable[str]) -> None:
    """Remove results of an earlier run from a folder that this run did not replace."""
    for name in set(results) - set(names):
        (folder / name).unlink(missing_ok=True)


def draw_safely(path: Path, draw: Callable[[], Figure]) -> list[str]:
    """Draw a figure and return its name; a warning if that fails, because the results do not depend on figures."""
    try:
        reports.save_figure(draw(), path)
    except Exception as error:
        warn(f"{path.name} is not drawn: {' '.join(str(error).split()) or type(error).__name__}")
        return []
    return [path.name]


def write_detection(
    folder: Path, result: rsvib_torch.DetectionResult, timing: rsvib_torch.SensorTiming, pixel_size: float | None = None
) -> list[str]:
    """Write a detection as JSON, tables and figures, and return the names of the files."""
    with working("drawing the offset curve"):
        reports.write_vibration(folder / "vibration.json", result, timing)
        reports.write_table(folder / "tones.csv", result, pixel_size=pixel_size)
        reports.write_offsets(folder / "offsets.csv", result)
        drawn = draw_safely(folder / "offsets.png", lambda: reports.offset_figure(result))
    with working("computing the spectrum"):
        spectrum = result.spectrum()
        reports.write_table(folder / "spectrum.csv", spectrum, pixel_size=pixel_size)
        drawn += draw_safely(folder / "spectrum.png", spectrum.plot)
    return [*drawn, "vibration.json", "tones.csv", "offsets.csv", "spectrum.csv"]


def write_windows(folder: Path, manifest: stacks.StackManifest, pixel_size: float | None = None) -> list[str]:
    """Write summary, table and figure of windows, warn of failures, and return the names of the files."""
    warn_of_failures(manifest)
    with working("drawing the windows"):
        write_json(folder / "windows.json", {"format": "rsvib windows", "version": 1, **manifest.totals()})
        reports.write_table(folder / "tones.csv", manifest, pixel_size=pixel_size)

        def draw() -> Figure:
            return reports.windows_figure(manifest.times(), manifest.detections())

        # otherwise, no tones are searched for
        drawn = draw_safely(folder / "windows.png", draw) if manifest.gyroscope is None else []
    return [*drawn, "windows.json", "tones.csv"]


def note_lost(path: Path, names: Sequence[str]) -> None:
    """Print which metadata of the input a file does not contain."""
    if names:
        note(f"{path}: not kept from the input: {', '.join(names)}")


def warn_of_failures(manifest: stacks.StackManifest) -> None:
    """Print a warning if detection or restoration failed in windows."""
    failed = sum(record.error is not None for record in manifest.windows)
    if failed:
        warn(f"detection failed in {number_of(failed, 'window')}: see manifest.json")
