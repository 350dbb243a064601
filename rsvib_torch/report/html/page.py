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
from rsvib_torch.report.html.template import PERCENTILES, Drawing, Pictures, drawing, pictures, write_page
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


def measure_edges(before: Tensor, after: Tensor) -> list[Edge]:
    """Measure the slanted edges of a restored frame, which may have several points per px, and of the input (H, W)."""
    points = after.shape[-1] // before.shape[-1]

    def measured(frame: Tensor, box: Box, scale: int) -> MtfCurve | None:
        top, left, height, width = (scale * side for side in box)
        try:
            return slanted_edge_mtf(frame[top : top + height, left : left + width])
        except ValueError:
            return None

    edges = []
    for box in _find_edges(after[::points, ::points]):
        restored = measured(after, box, points)
        if restored is not None:
            edges.append(Edge(box, measured(before, box, 1), restored, points))
    return edges


def whole_frame(report: Report, index: int, frames: dict[str, Tensor]) -> Pictures:
    """One frame of the input, and the restored one beside it if there is one, by name."""
    shown = pictures({name: [frame] for name, frame in frames.items()})
    grey = _grey(list(frames.values())[-1]).float()
    ((row, column),) = plots.detailed_places(grey, min(96, *grey.shape), count=1, rim=16)
    caption = f"Frame {report.first + index}"
    if report.was_restored and len(report.restored) == 1:
        caption += ", and one image restored jointly from all frames"
    if shown.scale < 1:
        caption += f", reduced to {100 * shown.scale:.2g} %"
    (black, white), (low, high) = shown.levels, PERCENTILES
    levels = f"black is {black:.3f} and white {white:.3f} of full scale, the percentiles {low:g} and {high:g}"
    both = " of both images" if len(frames) > 1 else ""
    caption += f". Grey levels are stretched: {levels}{both}."
    return replace(shown, caption=caption, place=(row + 48, column + 48))


def frames_in_turn(report: Report, index: int, image_motion: Tensor) -> Pictures | None:
    """Two consecutive frames before and after restoration, at full resolution where detail is strongest.

    Uniform motion along the image is compensated by whole px, the same for input and restored frames, so that the
    displacement by the vibration remains.
    """
    count = len(report.frames)
    if count < 2:
        return None
    first = min(index, count - 2)
    frames = {"input": report.frames}
    if report.was_restored and len(report.restored) == count:
        frames["restored"] = report.restored
    starts = report.timing.frame_starts(count)
    right, down = (image_motion[:2] * float(starts[first + 1] - starts[first])).round().int().tolist()
    height, width = report.frames.shape[-2:]
    if min(height - abs(down), width - abs(right)) < 32:  # px; the two frames have too little in common
        return None
    top, left = max(0, -down), max(0, -right)  # of the part of the first frame that both contain
    inner = (..., slice(top, height - max(0, down)), slice(left, width - max(0, right)))
    pairs = {
        name: (stack[first][inner], stack[first + 1].roll((-down, -right), (-2, -1))[inner])
        for name, stack in frames.items()
    }
    grey = _grey(list(pairs.values())[-1][0]).float()
    size = min(480, *grey.shape)  # px
    row, column = plots.detailed_places(grey, size, count=1, rim=16)[0]
    part = (..., slice(row, row + size), slice(column, column + size))
    parts = {name: [image[part] for image in pair] for name, pair in pairs.items()}
    number = report.first + first
    caption = f"Frames {number} and {number + 1}, {_region(row + top, column + left, size, size)}."
    if right or down:
        shift = f"{-right} px along x and {-down} px along y"
        caption += f" Frame {number + 1} is moved by {shift}, the uniform motion."
    if len(frames) > 1:
        caption += " The motion between the input frames is the vibration"
        caption += "; it is absent from the restored frames where restoration is right."
    return replace(pictures(parts), caption=caption, frames=(number, number + 1))


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


def write_report_page(folder: Path, report: Report) -> list[str]:
    """Write ``report.html`` and its figures as PNG files into an existing folder; returns the names of the files."""
    result, timing, windows, restored = report.detection, report.timing, report.windows, report.was_restored
    points, finer = report.restored.shape[-1] // report.frames.shape[-1], report.restored
    report = replace(report, restored=finer[..., ::points, ::points])
    index = len(report.frames) // 2 if len(report.restored) < len(report.frames) else 0
    last = min(index, len(report.restored) - 1)
    frames = {"input": report.frames[index]}
    detail = report.frames[index]
    figures: dict[str, Drawing] = {}
    if restored:
        frames["restored"], detail = report.restored[last], finer[last]
        compared = (frame.nan_to_num(0.0) for frame in (enlarged(frames["input"], points), detail))
        figures["details"] = drawing(plots.comparison_figure(*compared, size=96 * points))
    measured = measure_edges(_grey(frames["input"]), _grey(detail))
    for direction in sorted({edge.direction for edge in measured}):
        chosen = [edge for edge in measured if edge.direction == direction]
        curves = [[one.before for one in chosen if one.before is not None], [one.after for one in chosen]]
        of_names = dict(zip(frames, curves, strict=False))
        figures[f"mtf_{direction}"] = drawing(plots.mtf_figure(of_names, points={list(frames)[-1]: points}))
    shape: Sequence[int] = report.frames.shape
    detected: Table = {"residuals": []}
    if result is None:
        assert windows is not None
        totals, followed = windows.totals(), windows.followed()
        mark = "good" if totals["outcomes"].get("helps") == totals["windows"] else "doubt"
        sentences, shape = [words.FOLLOWED], windows.input["shape"]
        motion = torch.zeros(2) if followed is None else followed.vibration.image_motion[report.first]
    else:
        removed = trusted_vibration(result, timing, len(report.frames), report.num_rows)[0].to("cpu")
        motion = removed.image_motion
        sentences = words.verdict_sentences(report, result, removed)
        if not restored and windows is not None and windows.totals()["restored"]:
            sentences[0] = words.WINDOWS_RESTORED
        mark = words.overall_result(report, result)[0]
        figures |= _figures_of(report, result, removed)
        detected["residuals"] = [
            (name, f"{float(result.residual[axis]):.3g} {AXIS_UNITS[axis]}")
            for axis, name in enumerate(AXIS_NAMES[: result.vibration.num_axes])
        ]
        detected["tones"] = words.detected_tones(result)
        detected["at_centre"] = " at the centre of the frame" if removed.num_axes > 2 else ""
    lines: list[str] = []
    if windows is not None:
        vibration, restoration = windows.lines()
        lines = [*vibration[1:], *(restoration if windows.output is not None else [])]
        if windows.gyroscope is None:  # no tones are searched for otherwise
            figures["windows"] = drawing(windows.plot())
    content = {
        "report": report,
        "mark": mark,
        "verdict": sentences,
        **detected,
        "frames_title": "Input and restored frame" if restored else "Input frame",
        "overview": whole_frame(report, index, frames),
        "blink": frames_in_turn(report, index, motion),
        "finer": f", which have {points} x {points} points per px" if points > 1 else "",
        "figures": figures,
        "windows": lines,
        "window_tones": None if windows is None else windows.tone_table(),
        "mtf_head": ["edge", "direction", "angle", *(f"MTF50 of the {name} frame (cycles/px)" for name in frames)],
        "mtf_rows": [edge.row(restored) for edge in measured],
        "camera": words.camera_rows(timing, shape),
        "about": words.about_rows(report),
    }
    write_page(folder / "report.html", content)
    for name, figure in figures.items():
        (folder / f"{name}.png").write_bytes(figure.png)
    return ["report.html", *(f"{name}.png" for name in figures)]
