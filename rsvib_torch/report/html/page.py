"""The report page of a stack of frames: verdict, comparison, measured offsets, vibration and sharpness."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import torch
from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.evaluation import MtfCurve, find_slanted_edges, slanted_edge_mtf
from rsvib_torch.files.reading import Table
from rsvib_torch.frames.pixels import enlarged
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.report import plots
from rsvib_torch.report.html import words
from rsvib_torch.report.html.template import (
    PERCENTILES,
    BeforeAfter,
    Blink,
    Drawing,
    before_after,
    blink,
    drawing,
    write_page,
)
from rsvib_torch.report.html.words import Report
from rsvib_torch.restoration import trusted_vibration
from rsvib_torch.results.presentation import AXIS_NAMES, AXIS_UNITS
from rsvib_torch.text import measured_text

Box = tuple[int, int, int, int]  # top, left, height, width in px


@dataclass(frozen=True)
class Edge:
    """A slanted edge, measured in the input and in the restored frame."""

    box: Box  # its position
    before: MtfCurve | None  # measurement in the input; None if it failed
    after: MtfCurve  # measurement in the restored frame; its frequencies are in cycles per point
    points: int = 1  # points of the restored frame per px

    @property
    def direction(self) -> str:
        """Direction in which the edge measures sharpness: across it."""
        return "horizontal" if self.after.near_vertical else "vertical"

    def row(self, restored: bool) -> list[str]:
        """Line of the table of edges."""
        before = "not measured" if self.before is None else measured_text(self.before.mtf50, self.before.mtf50_std)
        after = measured_text(self.points * self.after.mtf50, self.points * self.after.mtf50_std)
        return [_region(*self.box), self.direction, f"{self.after.angle:.1f}°", before, *([after] if restored else [])]


def _grey(frame: Tensor) -> Tensor:
    """Frame (H, W) or (C, H, W) as grey (H, W), float64 on the CPU."""
    frame = frame.detach().cpu().double()
    return frame if frame.ndim == 2 else frame.mean(0)


def _region(top: int, left: int, height: int, width: int) -> str:
    return f"rows {top} … {top + height - 1}, columns {left} … {left + width - 1}"


def _find_edges(image: Tensor) -> list[Box]:
    """The three strongest edges of each direction in the central part of a frame."""
    searched = 2048  # px
    top, left = (max(0, (size - searched) // 2) for size in image.shape)
    edges = find_slanted_edges(image[top : top + searched, left : left + searched])
    chosen = [[edge for edge in edges if edge.near_vertical == vertical][:3] for vertical in (True, False)]
    return [(edge.top + top, edge.left + left, edge.height, edge.width) for edge in chain(*chosen)]


def measure_edges(before: Tensor, after: Tensor, boxes: Sequence[Box] | None = None) -> tuple[list[Edge], list[str]]:
    """Measure slanted edges in an input frame (H, W) and in the restored frame, which may have several points per px.

    Without ``boxes``, edges are searched for in the restored frame. Returns the edges that were measured there, and a
    sentence for each failed measurement.
    """
    rows, columns = before.shape
    points = after.shape[-1] // columns
    for top, left, height, width in boxes or ():
        if min(top, left) < 0 or min(height, width) < 1 or top + height > rows or left + width > columns:
            place = f"{top},{left},{height},{width} (top, left, height, width)"
            raise ValueError(f"edge {place} must be inside the frame of {rows} x {columns} px")
    edges, notes = [], []

    def measured(frame: Tensor, box: Box, scale: int, where: str) -> MtfCurve | None:
        top, left, height, width = (scale * side for side in box)
        try:
            return slanted_edge_mtf(frame[top : top + height, left : left + width])
        except ValueError as error:
            notes.append(f"The edge at {_region(*box)} was not measured{where}: {error}.")
            return None

    for box in _find_edges(after[::points, ::points]) if boxes is None else boxes:
        restored = measured(after, box, points, "")
        if restored is not None:
            edges.append(Edge(box, measured(before, box, 1, " in the input"), restored, points))
        elif boxes is None:  # nobody asked for this edge
            notes.pop()
    return edges, notes


def _details(before: Tensor, after: Tensor, names: tuple[str, ...]) -> list[BeforeAfter]:
    """Crops at full resolution where the restored frame has the strongest detail.

    If it is on a finer grid, the input is interpolated.
    """
    points = after.shape[-1] // before.shape[-1]
    before = enlarged(before, points)
    grey = _grey(after).float()
    size = min(96 * points, *grey.shape)
    pairs = []
    for row, column in plots.detailed_places(grey, size, count=6, rim=16 * points):
        crop = (..., slice(row, row + size), slice(column, column + size))
        caption = _region(row // points, column // points, size // points, size // points)
        caption += f"; {points} x {points} points per px, the input is interpolated" if points > 1 else ""
        pairs.append(before_after(before[crop], after[crop], names=names, caption=caption, exact=True))
    return pairs


def whole_frame(report: Report, index: int, frames: tuple[Tensor, ...], names: tuple[str, ...]) -> BeforeAfter:
    """One frame of the input, and the restored one beside it if there is one, with a part at full resolution."""
    grey = _grey(frames[-1]).float()
    place = plots.detailed_places(grey, min(96, *grey.shape), count=1, rim=16)[0]
    pair = before_after(*frames, names=names, caption="", full_at=(place[0] + 48, place[1] + 48))
    caption = f"Frame {report.first + index}"
    if report.was_restored and len(report.restored) == 1:
        caption += ", and one image restored jointly from all frames"
    if pair.scale < 1:
        caption += f", reduced to {100 * pair.scale:.2g} %"
    if pair.full is not None:
        part = _region(pair.full.top, pair.full.left, pair.full.height, pair.full.width)
        caption += f". The magnifier shows {part}"
    (black, white), (low, high) = pair.levels, PERCENTILES
    levels = f"black is {black:.3f} and white {white:.3f} of full scale, the percentiles {low:g} and {high:g}"
    both = " of both images" if len(frames) > 1 else ""
    return replace(pair, caption=f"{caption}. Grey levels are stretched: {levels}{both}.")


def frames_in_turn(report: Report, index: int, image_motion: Tensor) -> Blink | None:
    """Two consecutive frames before and after restoration, at full resolution where detail is strongest.

    Uniform motion along the image is compensated by whole px, the same for input and restored frames, so that the
    displacement by the vibration remains.
    """
    count = len(report.frames)
    if count < 2:
        return None
    first = min(index, count - 2)
    frames, names = [report.frames], ["input"]
    if report.was_restored and len(report.restored) == count:
        frames, names = [report.frames, report.restored], ["input", "restored"]
    starts = report.timing.frame_starts(count)
    moved = (image_motion * float(starts[first + 1] - starts[first])).round().int().tolist()
    height, width = report.frames.shape[-2:]
    rows, columns = (max(0, length - abs(step)) for length, step in ((height, moved[1]), (width, moved[0])))
    if min(rows, columns) < 32:  # px; the two frames have too little in common
        return None
    top, left = max(0, -moved[1]), max(0, -moved[0])  # of the part of the first frame that both contain
    size = min(480, rows, columns)  # px
    common = _grey(frames[-1][first])[top : top + rows, left : left + columns]
    row, column = plots.detailed_places(common.float(), size, count=1, rim=16)[0]
    row, column = row + top, column + left

    def part(frame: Tensor, down: int, right: int) -> Tensor:
        return frame[..., row + down : row + down + size, column + right : column + right + size]

    pairs = [(part(stack[first], 0, 0), part(stack[first + 1], moved[1], moved[0])) for stack in frames]
    number = report.first + first
    caption = f"Frames {number} and {number + 1}, {_region(row, column, size, size)}."
    if any(moved):
        shift = f"{-moved[0]} px along x and {-moved[1]} px along y"
        caption += f" Frame {number + 1} is moved by {shift}, the uniform motion."
    if len(frames) > 1:
        caption += " The motion between the input frames is the vibration"
        caption += "; it is absent from the restored frames where restoration is right."
    return blink(pairs, names=names, frames=(number, number + 1), caption=caption)


def _figures_of(report: Report, result: DetectionResult, removed: Vibration) -> dict[str, Drawing]:
    """Figures of a detection, and of the part ``removed`` of its vibration, by the name of their file."""
    figures = {
        f"offsets_{name}": drawing(plots.offset_panels(result, [axis], 5.6, 4.4)[0])
        for axis, name in enumerate(AXIS_NAMES[: result.vibration.num_axes])
    }
    figures["offset_gain"] = drawing(plots.gain_figure(result, report.timing))
    centre = removed.translation()
    if bool(centre.moving_axes().any()):
        figures["rows"] = drawing(plots.rows_figure(centre, report.timing, report.num_rows))
        figures["psf"] = drawing(plots.psf_figure(centre, report.timing, report.num_rows))
    return figures


def write_report_page(folder: Path, report: Report, edges: Sequence[Box] | None = None) -> list[str]:
    """Write ``report.html`` and its figures as PNG files into an existing folder; returns the names of the files.

    ``edges`` are positions of slanted edges in the frame on the page; None searches for them.
    """
    result, timing = report.detection, report.timing
    points, finer = report.restored.shape[-1] // report.frames.shape[-1], report.restored
    report = replace(report, restored=finer[..., ::points, ::points])
    index = len(report.frames) // 2 if len(report.restored) < len(report.frames) else 0
    before = report.frames[index]
    last = min(index, len(report.restored) - 1)
    after = report.restored[last] if report.was_restored else None
    detail = finer[last] if report.was_restored else before
    shown = (before,) if after is None else (before, after)
    names = ("input", "restored")[: len(shown)]
    measured, notes = measure_edges(_grey(before), _grey(detail), edges)
    figures: dict[str, Drawing] = {}
    detected: Table = {"tried": [], "residuals": []}
    for direction in sorted({edge.direction for edge in measured}):
        chosen = [edge for edge in measured if edge.direction == direction]
        curves = [[one.before for one in chosen if one.before is not None], [one.after for one in chosen]]
        of_names = dict(zip(names, curves, strict=False))
        figures[f"mtf_{direction}"] = drawing(plots.mtf_figure(of_names, points={names[-1]: points}))
    restored = report.was_restored
    shape = report.frames.shape
    if result is None:
        assert report.windows is not None
        totals, followed = report.windows.totals(), report.windows.followed()
        mark = "good" if totals["outcomes"].get("helps") == totals["windows"] else "doubt"
        sentences, shape = [words.FOLLOWED], report.windows.input["shape"]
        motion = torch.zeros(2) if followed is None else followed.vibration.image_motion[report.first]
    else:
        removed = trusted_vibration(result, timing, len(report.frames), report.num_rows)[0].to("cpu")
        motion = removed.image_motion
        sentences = words.verdict_sentences(report, result, removed)
        if not restored and report.windows is not None and report.windows.totals()["restored"]:
            sentences[0] = words.WINDOWS_RESTORED
        mark = words.overall_result(report, result)[0]
        if not restored:
            detected["tried"] = words.tried_sentences(report, result, sentences[1:])
        figures |= _figures_of(report, result, removed)
        detected["residuals"] = [
            (name, f"{float(result.residual[axis]):.3g} {AXIS_UNITS[axis]}")
            for axis, name in enumerate(AXIS_NAMES[: result.vibration.num_axes])
        ]
        detected["tones"] = words.detected_tones(result)
        detected["at_centre"] = " at the centre of the frame" if removed.num_axes > 2 else ""
    windows = None
    if report.windows is not None:
        vibration, restoration = report.windows.lines()
        lines = [*vibration[1:], *(restoration if report.windows.output is not None else [])]
        windows = {"lines": lines, "table": report.windows.tone_table()}
        if report.windows.gyroscope is None:  # no tones are searched for otherwise
            figures["windows"] = drawing(report.windows.plot())
    content = {
        "report": report,
        "mark": mark,
        "verdict": sentences if restored else sentences[:1],
        **detected,
        "frames_title": "Input and restored frame" if restored else "Input frame",
        "overview": whole_frame(report, index, shown, names),
        "blink": frames_in_turn(report, index, motion),
        "details": [] if after is None else _details(before, detail, names),
        "figures": figures,
        "windows": windows,
        "mtf_head": ["edge", "direction", "angle", *(f"MTF50 of the {name} frame (cycles/px)" for name in names)],
        "mtf_rows": [edge.row(restored) for edge in measured],
        "mtf_notes": notes,
        "camera": words.camera_rows(timing, shape),
        "about": words.about_rows(report),
        "terms": words.TERMS,
    }
    write_page(folder / "report.html", content)
    for name, figure in figures.items():
        (folder / f"{name}.png").write_bytes(figure.png)
    return ["report.html", *(f"{name}.png" for name in figures)]
