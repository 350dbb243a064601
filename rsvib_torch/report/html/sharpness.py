"""Slanted edges of a frame, before and after: curves and a table."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from matplotlib.figure import Figure
from torch import Tensor

from rsvib_torch.evaluation import MtfCurve, SlantedEdge, find_slanted_edges, slanted_edge_mtf
from rsvib_torch.report.plots import measured_text, plain_axes

__all__ = ["Box", "EdgePair", "measure_edges", "mtf_figure"]

Box = tuple[int, int, int, int]  # top, left, height, width in px
_MOST = 3  # edges for each axis
_SEARCHED = 2048  # px, sides of the part of a frame in which edges are looked for
_AXES = {True: "horizontal", False: "vertical"}


@dataclass(frozen=True)
class EdgePair:
    """One edge, as taken and restored.

    Attributes:
        box: Where it lies.
        before: As taken; None where it could not be measured, for the reason in ``why_not``.
        after: Restored.
        why_not: Why there is no ``before``.
    """

    box: Box
    before: MtfCurve | None
    after: MtfCurve
    why_not: str

    @property
    def axis(self) -> str:
        """Which sharpness it tells of."""
        return _AXES[self.after.near_vertical]

    @property
    def place(self) -> str:
        """Rows and columns."""
        top, left, height, width = self.box
        return f"rows {top} … {top + height - 1}, columns {left} … {left + width - 1}"

    def row(self) -> list[str]:
        """Cells of a table: place, axis, angle, MTF50 before and after."""
        return [
            self.place,
            self.axis,
            f"{self.after.angle:.1f}°",
            measured_text(self.before.mtf50, self.before.mtf50_std, 3) if self.before else "not measured",
            measured_text(self.after.mtf50, self.after.mtf50_std, 3),
        ]


def _found(image: Tensor) -> list[Box]:
    """The strongest edges for each axis in the middle of a frame."""
    begin = [max(0, (size - _SEARCHED) // 2) for size in image.shape]
    part = image[begin[0] : begin[0] + _SEARCHED, begin[1] : begin[1] + _SEARCHED]
    edges: list[SlantedEdge] = find_slanted_edges(part)
    chosen = [edge for upright in (True, False) for edge in [e for e in edges if e.near_vertical == upright][:_MOST]]
    return [(e.top + begin[0], e.left + begin[1], e.height, e.width) for e in chosen]


def _inside(box: Box, image: Tensor) -> Box:
    top, left, height, width = box
    rows, columns = image.shape
    if min(top, left) < 0 or min(height, width) < 1 or top + height > rows or left + width > columns:
        raise ValueError(
            f"edge {top},{left},{height},{width} (top, left, height, width) does not lie in a frame of "
            f"{rows} x {columns} px"
        )
    return box


def measure_edges(
    before: Tensor, after: Tensor, given: Sequence[Box] | None = None
) -> tuple[list[EdgePair], list[str]]:
    """Measure slanted edges in a frame as taken and restored.

    Args:
        before: (H, W) grey.
        after: Same shape.
        given: Where edges are; by default they are looked for in the restored frame.

    Returns:
        The edges that could be measured in the restored frame, and notes on what could not be measured.

    Raises:
        ValueError: If a given box does not lie in the frame.
    """
    boxes = _found(after) if given is None else [_inside(box, after) for box in given]
    pairs, notes = [], []
    for top, left, height, width in boxes:
        crops = [image[top : top + height, left : left + width] for image in (before, after)]
        try:
            restored = slanted_edge_mtf(crops[1])
        except ValueError as error:
            if given is not None:
                notes.append(f"Edge {top},{left},{height},{width} was not measured: {error}.")
            continue
        raw, why_not = None, ""
        try:
            raw = slanted_edge_mtf(crops[0])
        except ValueError as error:
            why_not = str(error)
        pairs.append(EdgePair((top, left, height, width), raw, restored, why_not))
        if why_not:
            notes.append(f"The edge at {pairs[-1].place} could not be measured as taken: {why_not}.")
    return pairs, notes


def mtf_figure(pairs: Sequence[EdgePair], axis: str, names: tuple[str, str]) -> Figure:
    """Draw the MTF of the edges that tell of one axis: each edge thin, means bold.

    Args:
        pairs: Edges, at least one of them of this axis.
        axis: ``"horizontal"`` or ``"vertical"``.
        names: What before and after are called.
    """
    figure = Figure(figsize=(5.6, 3.9), layout="constrained")
    panel = figure.subplots()
    frequency = torch.linspace(0, 0.5, 51, dtype=torch.float64)
    chosen = [pair for pair in pairs if pair.axis == axis]
    for name, colour, curves in (
        (names[0], "#8a8a8a", [pair.before for pair in chosen if pair.before is not None]),
        (names[1], "#14487a", [pair.after for pair in chosen]),
    ):
        values = [curve.at(frequency.to(curve.lsf.device)).cpu() for curve in curves]
        for value in values:
            panel.plot(frequency, value, color=colour, linewidth=0.7, alpha=0.5)
        if values:
            panel.plot(frequency, torch.stack(values).mean(0), color=colour, linewidth=2.0, label=name)
    panel.axhline(0.5, color="#b8bcc0", linewidth=0.8, linestyle="--", zorder=0)
    panel.set_xlim(0, 0.5)
    panel.set_ylim(0, max(1.05, panel.get_ylim()[1]))
    panel.set_xlabel("frequency (cycles/px)")
    panel.set_ylabel("MTF")
    panel.legend(fontsize=9, frameon=False)
    plain_axes(panel)
    return figure
