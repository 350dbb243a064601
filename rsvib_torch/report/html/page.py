"""The report page of a stack of frames: verdict, comparison, measured offsets, vibration and sharpness."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from rsvib_torch.core.text import measured_text
from rsvib_torch.detection import DetectionResult
from rsvib_torch.evaluation import MtfCurve, find_slanted_edges, slanted_edge_mtf
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.report import plots
from rsvib_torch.report.html import words
from rsvib_torch.report.html.template import BeforeAfter, Drawing, before_after, drawing, write_page
from rsvib_torch.restoration import RestorationVerdict, trusted_vibration

__all__ = ["Box", "Edge", "Report", "measure_edges", "write_report_page"]

Box = tuple[int, int, int, int]  # top, left, height, width in px


@dataclass(frozen=True, eq=False)
class Report:
    """Content of a report page.

    Attributes:
        title: Heading.
        subtitle: Line below.
        frames: (T, H, W) or (T, C, H, W) input frames, full scale 1.
        restored: Frames after restoration, or one frame restored jointly from all.
        was_restored: Whether ``restored`` is restored, or the unchanged input.
        timing: The sensor.
        detection: The detection (not a batch).
        verdict: Comparison of pairs of frames; None if they could not be compared.
        left_alone: A sentence for each axis that was not restored.
        options: Options of ``restore``.
        version: Version of the package.
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


@dataclass(frozen=True)
class Edge:
    """A slanted edge, measured in the input and in the restored frame.

    Attributes:
        box: Its position.
        before: Measurement in the input; None if it failed.
        after: Measurement in the restored frame.
    """

    box: Box
    before: MtfCurve | None
    after: MtfCurve

    @property
    def direction(self) -> str:
        """Direction in which the edge measures sharpness: across it."""
        return "horizontal" if self.after.near_vertical else "vertical"


def _grey(frame: Tensor) -> Tensor:
    """Frame (H, W) or (C, H, W) as grey (H, W), float64 on the CPU."""
    frame = frame.detach().cpu().double()
    return frame if frame.ndim == 2 else frame.mean(0)


def _region(top: int, left: int, height: int, width: int) -> str:
    return f"rows {top} … {top + height - 1}, columns {left} … {left + width - 1}"


def _find_edges(image: Tensor, per_direction: int = 3, searched: int = 2048) -> list[Box]:
    """The strongest edges of each direction in the central ``searched`` px of a frame."""
    top, left = (max(0, (size - searched) // 2) for size in image.shape)
    edges = find_slanted_edges(image[top : top + searched, left : left + searched])
    vertical = [edge for edge in edges if edge.near_vertical][:per_direction]
    horizontal = [edge for edge in edges if not edge.near_vertical][:per_direction]
    return [(edge.top + top, edge.left + left, edge.height, edge.width) for edge in vertical + horizontal]


def measure_edges(before: Tensor, after: Tensor, boxes: Sequence[Box] | None = None) -> tuple[list[Edge], list[str]]:
    """Measure slanted edges in an input frame and in the restored frame.

    Args:
        before: (H, W) grey.
        after: Same shape.
        boxes: Positions of the edges; None searches for edges in the restored frame.

    Returns:
        The edges that were measured in the restored frame, and a sentence for each failed measurement.

    Raises:
        ValueError: If a given box is not inside the frame.
    """
    rows, columns = after.shape
    for top, left, height, width in boxes or ():
        if min(top, left) < 0 or min(height, width) < 1 or top + height > rows or left + width > columns:
            raise ValueError(
                f"edge {top},{left},{height},{width} (top, left, height, width) must be inside the frame of {rows} x "
                f"{columns} px"
            )
    edges, notes = [], []
    for box in _find_edges(after) if boxes is None else boxes:
        top, left, height, width = box
        crop = (slice(top, top + height), slice(left, left + width))
        try:
            restored = slanted_edge_mtf(after[crop])
        except ValueError as error:
            if boxes is not None:
                notes.append(f"The edge at {_region(*box)} was not measured: {error}.")
            continue
        raw = None
        try:
            raw = slanted_edge_mtf(before[crop])
        except ValueError as error:
            notes.append(f"The edge at {_region(*box)} was not measured in the input: {error}.")
        edges.append(Edge(box, raw, restored))
    return edges, notes


def _edge_row(edge: Edge) -> list[str]:
    """Line of the table of edges."""
    before = "not measured" if edge.before is None else measured_text(edge.before.mtf50, edge.before.mtf50_std)
    after = measured_text(edge.after.mtf50, edge.after.mtf50_std)
    return [_region(*edge.box), edge.direction, f"{edge.after.angle:.1f}°", before, after]


def _mtf_drawings(edges: list[Edge], names: tuple[str, str]) -> list[Drawing]:
    drawings = []
    for direction in ("horizontal", "vertical"):
        chosen = [edge for edge in edges if edge.direction == direction]
        if chosen:
            before = [edge.before for edge in chosen if edge.before is not None]
            drawings.append(
                drawing(
                    plots.mtf_figure(dict(zip(names, (before, [edge.after for edge in chosen]), strict=True))),
                    f"mtf_{direction}",
                    f"{direction.capitalize()} sharpness",
                    "Thin lines: single edges; bold lines: their mean. The displacement of rows does not count as "
                    "blur, because the measurement follows the edge.",
                )
            )
    return drawings


def _details(before: Tensor, after: Tensor, names: tuple[str, str]) -> list[BeforeAfter]:
    """Crops at full resolution where the restored frame has the strongest detail."""
    grey = _grey(after).float()
    size = min(96, *grey.shape)
    pairs = []
    for row, column in plots.detailed_places(grey, size, count=6, rim=16):
        crop = (..., slice(row, row + size), slice(column, column + size))
        caption = _region(row, column, size, size)
        pairs.append(before_after(before[crop], after[crop], names=names, caption=caption, exact=True))
    return pairs


def write_report_page(folder: Path, report: Report, edges: Sequence[Box] | None = None) -> list[str]:
    """Write ``report.html`` and its figures as PNG files into a folder.

    Args:
        folder: An existing folder.
        report: The content.
        edges: Positions of slanted edges in the frame on the page; None searches for them.

    Returns:
        Names of the files.

    Raises:
        OSError: If a file cannot be written.
        ValueError: If an edge is not inside the frame.
    """
    result, timing = report.detection, report.timing
    num_rows = report.frames.shape[int(timing.scan_axis)]
    removed = trusted_vibration(result, timing, len(report.frames), num_rows)[0].to("cpu")
    index = len(report.frames) // 2 if len(report.restored) < len(report.frames) else 0
    before, after = report.frames[index], report.restored[min(index, len(report.restored) - 1)]
    names = ("input", "restored" if report.was_restored else "unchanged")
    offsets = [
        drawing(
            plots.axis_offset_figure(result, axis),
            f"offsets_{name}",
            f"Offsets along {name}",
            "Top: measured offset of the rows, and the offset curve of the detected vibration. Bottom: residual, "
            f"{float(result.residual[axis]):.4f} px on average.",
        )
        for axis, name in enumerate("xy")
    ]
    tone_figures = [
        drawing(
            plots.gain_figure(result, timing),
            "gain",
            "Gain of a pair of frames",
            "Top: offset in px per px of displacement. Dashed: blind frequencies, at which all frames are displaced "
            "alike or the exposure averages the vibration to zero. Bottom: detected tones, with error bars of two "
            "standard deviations.",
        )
    ]
    if bool(removed.moving_axes().any()):
        tone_figures += [
            drawing(
                plots.rows_figure(removed, timing, num_rows),
                "rows",
                "Displacement and motion blur",
                "Top: mean displacement of each row of frame 0. Bottom: range of the displacement during the exposure "
                "of the row.",
            ),
            drawing(
                plots.psf_figure(removed, timing, num_rows),
                "psf",
                "Point spread functions",
                "Kernels of rows of frame 0 from first to last, one square per px, each centred on the mean "
                "displacement of its row. Line: path of the image during the exposure.",
            ),
        ]
    measured, notes = measure_edges(_grey(before), _grey(after), edges)
    mtf_figures = _mtf_drawings(measured, names)
    options = ", ".join(f"{name} = {value}" for name, value in report.options.items())
    sentences = words.verdict_sentences(
        result,
        removed,
        timing,
        num_rows,
        restored=report.was_restored,
        left_alone=report.left_alone,
        verdict=report.verdict,
    )
    content = {
        "title": report.title,
        "subtitle": report.subtitle,
        "mark": words.mark_of(result, report.verdict, report.was_restored),
        "verdict": sentences,
        "overview": before_after(before, after, names=names, caption=f"Frame {index}.", longest=1180),
        "details": _details(before, after, names),
        "offsets": offsets,
        "tones_head": words.TONE_HEAD,
        "tones": words.detected_tones(result),
        "tone_figures": tone_figures,
        "mtf_head": ("edge", "direction", "angle", "MTF50 of the input (cycles/px)", f"MTF50 {names[1]} (cycles/px)"),
        "mtf_rows": [_edge_row(edge) for edge in measured],
        "mtf_notes": notes,
        "mtf_figures": mtf_figures,
        "camera": words.camera_rows(timing, report.frames.shape),
        "footer": f"rsvib_torch {report.version}" + (f"; restored with {options}" * report.was_restored),
    }
    write_page(folder / "report.html", "report.html", content)
    figures = [*offsets, *tone_figures, *mtf_figures]
    for figure in figures:
        (folder / f"{figure.name}.png").write_bytes(figure.png)
    return ["report.html", *(f"{figure.name}.png" for figure in figures)]
