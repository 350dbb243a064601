"""The page of a stack of frames: what was wrong, what was done, what was gained."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

import rsvib_torch.report.html.words as in_words
from rsvib_torch.detection import DetectionResult
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.report.html import figures
from rsvib_torch.report.html.inline import Drawing, before_after, drawing, grey
from rsvib_torch.report.html.sharpness import Box, measure_edges, mtf_figure
from rsvib_torch.report.html.template import write_page
from rsvib_torch.report.plots import axis_offset_figure, detailed_places
from rsvib_torch.restoration import RestorationVerdict, trusted_vibration

__all__ = ["Report", "write_report_page"]

_CROP, _CROPS, _RIM = 96, 6, 16  # px
_OVERVIEW = 1180  # px, longest side
_MTF_HEAD = ("edge", "sharpness", "angle", "MTF50 as taken (cycles/px)", "MTF50 restored")


@dataclass(frozen=True, eq=False)
class Report:
    """What a page tells of.

    Attributes:
        title: Heading.
        subtitle: Line below.
        frames: (T, H, W) or (T, C, H, W) as taken, full scale 1.
        restored: Frames after restoration, or one restored jointly from all.
        was_restored: Whether they were restored, or left as taken.
        timing: The sensor.
        detection: The vibration (not a batch).
        verdict: What pairs of frames say; None where they could not be compared.
        left_alone: A sentence for each axis that was left alone.
        options: Options of ``restore``.
        version: Of the program.
    """

    title: str
    subtitle: str
    frames: Tensor
    restored: Tensor
    was_restored: bool
    timing: SensorTiming
    detection: DetectionResult
    verdict: RestorationVerdict | None
    left_alone: tuple[str, ...]
    options: dict[str, Any]
    version: str

    @property
    def shown(self) -> tuple[Tensor, Tensor, int]:
        """The frame that is shown as taken and restored, and its index."""
        index = len(self.frames) // 2 if len(self.restored) < len(self.frames) else 0
        return self.frames[index], self.restored[min(index, len(self.restored) - 1)], index

    @property
    def num_rows(self) -> int:
        """Rows of a frame, along the scan axis."""
        return self.frames.shape[int(self.timing.scan_axis)]

    @property
    def undone(self) -> Vibration:
        """The part of the vibration that is known well enough to be undone, on the CPU."""
        vibration, _ = trusted_vibration(self.detection, self.timing, len(self.frames), self.num_rows)
        return vibration.to("cpu")

    @property
    def names(self) -> tuple[str, str]:
        """What before and after are called."""
        return "as taken", "restored" if self.was_restored else "left as taken"


def _details(report: Report) -> list[Any]:
    before, after, _ = report.shown
    picture = grey(after).float()
    size = min(_CROP, *picture.shape)
    rim = min(_RIM, (min(picture.shape) - size) // 2)
    inner = picture[rim : picture.shape[0] - rim, rim : picture.shape[1] - rim]
    pairs = []
    for row, column in detailed_places(inner, size, _CROPS):
        place = (..., slice(row + rim, row + rim + size), slice(column + rim, column + rim + size))
        where = f"rows {row + rim} … {row + rim + size - 1}, columns {column + rim} … {column + rim + size - 1}"
        pairs.append(before_after(before[place], after[place], names=report.names, caption=where, exact=True))
    return pairs


def _drawings(report: Report) -> dict[str, list[Drawing]]:
    result, timing = report.detection, report.timing
    undone, num_rows = report.undone, report.num_rows
    offsets = [
        drawing(
            axis_offset_figure(result, axis),
            f"offsets_{name}",
            f"Offsets along {name}",
            f"Above, every band of rows and the curve of the detected vibration; below, what it leaves: "
            f"{float(result.residual[axis]):.4f} px on average.",
        )
        for axis, name in enumerate("xy")
    ]
    vibration = [
        drawing(
            figures.gain_figure(result, timing),
            "gain",
            "What a pair of frames can see",
            "Above, px of offset for every px of vibration; dashed: blind frequencies, at which every frame is "
            "displaced alike or the exposure averages the tone out. Below, the tones with error "
            "bars of two standard deviations.",
        ),
    ]
    if not bool(undone.moving_axes().any()):
        return {"offsets": offsets, "tone_figures": vibration}
    rows = [
        drawing(
            figures.rows_figure(undone, timing, num_rows),
            "rows",
            "Displacement and smear",
            "Mean displacement of each row of frame 0, and how far the image moves while the row is exposed.",
        ),
        drawing(
            figures.psf_film(undone, timing, num_rows),
            "psf_film",
            "Point spread functions down the frame",
            "Kernels of rows of frame 0, from the first to the last, a square a px, each around its own mean "
            "displacement; the line is the path of the image during the exposure.",
        ),
    ]
    return {"offsets": offsets, "tone_figures": vibration + rows}


def write_report_page(folder: Path, report: Report, edges: Sequence[Box] | None = None) -> list[str]:
    """Write ``report.html`` and its figures as PNG files into a folder.

    Args:
        folder: An existing folder.
        report: What to tell.
        edges: (top, left, height, width) of slanted edges in the frame shown; by default they are looked for.

    Returns:
        Names of the files.

    Raises:
        OSError: If a file cannot be written.
        ValueError: If an edge does not lie in the frame.
    """
    before, after, index = report.shown
    names = report.names
    pairs, notes = measure_edges(grey(before), grey(after), edges)
    content: dict[str, Any] = _drawings(report)
    content["mtf_figures"] = [
        drawing(
            mtf_figure(pairs, axis, names),
            f"mtf_{axis}",
            f"{axis.capitalize()} sharpness",
            "Thin: single edges; bold: their mean. The bends of an edge do not count as blur here.",
        )
        for axis in ("horizontal", "vertical")
        if any(pair.axis == axis for pair in pairs)
    ]
    options = ", ".join(f"{name} = {value}" for name, value in report.options.items() if report.was_restored)
    content |= {
        "title": report.title,
        "subtitle": report.subtitle,
        "mood": in_words.mood_of(report.detection, report.verdict, report.was_restored),
        "verdict": in_words.verdict_words(
            report.detection,
            report.undone,
            report.timing,
            report.num_rows,
            restored=report.was_restored,
            left_alone=report.left_alone,
            verdict=report.verdict,
        ),
        "overview": before_after(before, after, names=names, caption=f"Frame {index}.", longest=_OVERVIEW),
        "details": _details(report),
        "tones_head": in_words.TONE_HEAD,
        "tones": in_words.tone_rows(report.detection),
        "mtf_head": _MTF_HEAD,
        "mtf_rows": [pair.row() for pair in pairs],
        "mtf_notes": notes,
        "camera": in_words.camera_rows(report.timing, report.frames.shape),
        "footer": f"rsvib_torch {report.version}" + (f"; restored with {options}" if options else ""),
    }
    drawings = [drawn for value in content.values() if isinstance(value, list) for drawn in value]
    pictures = [drawn for drawn in drawings if isinstance(drawn, Drawing)]
    for drawn in pictures:
        (folder / f"{drawn.name}.png").write_bytes(drawn.png)
    write_page(folder / "report.html", "report.html", content)
    return ["report.html", *(f"{drawn.name}.png" for drawn in pictures)]
