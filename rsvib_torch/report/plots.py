"""Pictures of a detection and a restoration."""

import math
import os
import textwrap
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection import DetectionResult
from rsvib_torch.io import whole_file

__all__ = [
    "axis_offset_figure",
    "comparison_figure",
    "detailed_places",
    "measured_text",
    "offset_figure",
    "plain_axes",
    "save_figure",
]

_INK, _FAINT, _LINE, _FAILED = "#222222", "#d9d9d9", "#c8102e", "#8a8a8a"
_COLOURS = LinearSegmentedColormap.from_list("quality", ["#f0a030", "#9cc3e0", "#14487a"])  # poor ... good


def save_figure(figure: Figure, path: str | os.PathLike[str], *, dpi: int = 150) -> None:
    """Write a figure as an image file; it appears whole or not at all."""
    with whole_file(path) as part:
        FigureCanvasAgg(figure).print_figure(str(part), dpi=dpi, facecolor="white")


def plain_axes(axes: Axes) -> None:
    """Take away what an axes does not need."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_INK)
    axes.tick_params(colors=_INK, labelsize=9)
    axes.grid(color=_FAINT, linewidth=0.6)
    axes.set_axisbelow(True)


def measured_text(value: Tensor, std: Tensor, digits: int) -> str:
    """A value with its standard deviation, to as many digits as the latter needs to show."""
    deviation = float(std)
    if math.isfinite(deviation) and deviation > 0:
        digits = min(6, max(digits, -math.floor(math.log10(deviation))))
    return f"{float(value):.{digits}f} ± {deviation:.{digits}f}"


def _tone_text(result: DetectionResult, axis: int) -> str:
    """The tones of an axis in words, or why there are none to trust."""
    vibration, std = result.vibration, result.std
    if not bool(result.reliable[axis]):
        return "not reliable: " + "; ".join(str(reason) for reason in result.reasons[axis])
    parts = [
        f"{measured_text(vibration.amplitude[axis, k], std.amplitude[axis, k], 3)} px at "
        f"{measured_text(vibration.frequency[axis, k], std.frequency[axis, k], 2)} Hz"
        for k in range(vibration.amplitude.shape[-1])
        if float(vibration.amplitude[axis, k]) > 0
    ]
    return ",  ".join(parts)


def _draw_offsets(upper: Axes, lower: Axes, result: DetectionResult, axis: int) -> Any:
    """Draw the offsets along an axis with their fit, and the residuals beneath; returns the coloured points."""
    curve = result.offsets
    times = curve.times.cpu().numpy() * 1e3
    offsets, fitted, quality = (t.detach().cpu().numpy() for t in (curve.offsets, result.fitted, curve.quality))
    measured, expected = offsets[..., axis], fitted[..., axis]
    good = np.isfinite(measured)
    residual = (measured - expected)[good]
    style = {"c": quality[good], "cmap": _COLOURS, "vmin": 0.0, "vmax": 1.0, "linewidths": 0, "zorder": 2}
    size = max(4.0, min(22.0, 4000.0 / max(1, measured.size)))
    points = upper.scatter(times[good], measured[good], s=size, **style)
    for pair in range(len(times)):
        upper.plot(times[pair], expected[pair], color=_LINE, linewidth=1.3, zorder=3)
    failed = times[~good]
    edge = upper.get_xaxis_transform()
    upper.scatter(failed, np.full_like(failed, 0.02), s=18, marker="x", color=_FAILED, transform=edge, zorder=4)
    lower.scatter(times[good], residual, s=0.6 * size, **style)
    lower.axhline(0.0, color=_LINE, linewidth=1.0, zorder=3)
    spread = 1.15 * float(np.quantile(np.abs(residual), 0.99)) if residual.size else 1.0
    lower.set_ylim(-max(spread, 1e-3), max(spread, 1e-3))
    lower.set_title(f"mean |residual| {float(result.residual[axis]):.4f} px", loc="left", fontsize=9.5, color=_INK)
    lower.set_xlabel("exposure start of the band in the earlier frame (ms)", color=_INK)
    upper.set_ylabel("offset (px)", color=_INK)
    lower.set_ylabel("residual (px)", color=_INK)
    plain_axes(upper)
    plain_axes(lower)
    return points


def _finish_offsets(figure: Figure, panels: Any, points: Any, *, columns: int) -> None:
    """Add the legend and the colour bar."""
    keys = [
        Line2D([], [], color=_COLOURS(1.0), marker="o", markersize=5, linewidth=0, label="measured band"),
        Line2D([], [], color=_LINE, linewidth=1.3, label="detected vibration"),
        Line2D([], [], color=_FAILED, marker="x", markersize=5, linewidth=0, label="band that failed"),
    ]
    figure.legend(handles=keys, loc="outside lower center", ncols=columns, fontsize=9.5, frameon=False)
    bar = figure.colorbar(points, ax=panels, fraction=0.025, pad=0.01)
    bar.set_label("quality of the band (correlation)", color=_INK)
    bar.outline.set_visible(False)


def offset_figure(result: DetectionResult) -> Figure:
    """Draw the offset curve of each axis with its fit, and the residuals beneath (as Figure 6 of Liu et al. 2023).

    Points are the measured bands, coloured by their quality; crosses on the lower edge are failed bands; the line is
    the curve that the detected vibration gives.

    Args:
        result: A detection (not a batch).
    """
    figure = Figure(figsize=(13, 6.4), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, height_ratios=(3, 1), squeeze=False)
    points: Any = None
    for axis, name in enumerate("xy"):
        upper, lower = panels[0, axis], panels[1, axis]
        points = _draw_offsets(upper, lower, result, axis)
        upper.set_title(f"Offset along {name}", loc="left", fontsize=12, fontweight="bold", color=_INK, pad=36)
        words = "\n".join(textwrap.wrap(_tone_text(result, axis), 76, max_lines=2, placeholder=" …"))
        note = upper.annotate(words, (0, 1), (0, 32), "axes fraction", "offset points", va="top", fontsize=9.5)
        note.set_in_layout(False)  # a long text must not squeeze the panels
    _finish_offsets(figure, panels, points, columns=3)
    return figure


def axis_offset_figure(result: DetectionResult, axis: int) -> Figure:
    """Draw the offset curve of one axis, small enough for a narrow page.

    Args:
        result: A detection (not a batch).
        axis: 0 for x, 1 for y.
    """
    figure = Figure(figsize=(5.6, 4.4), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    _finish_offsets(figure, panels, _draw_offsets(panels[0], panels[1], result, axis), columns=3)
    return figure


def detailed_places(image: Tensor, size: int, count: int) -> list[tuple[int, int]]:
    """Corners (row, column) of the square windows with the strongest detail that do not overlap.

    Args:
        image: (H, W), finite.
        size: Side of the windows in px; at most the image's sides.
        count: Windows wanted; there may be room for fewer.
    """
    down, right = (functional.pad(image.diff(dim=d), pad) for d, pad in ((0, (0, 0, 0, 1)), (1, (0, 1))))
    # The root keeps a single hard edge from outweighing rich texture.
    sums = functional.pad((down.square() + right.square()).sqrt().double().cumsum(0).cumsum(1), (1, 0, 1, 0))
    detail = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size]
    places: list[tuple[int, int]] = []
    while len(places) < count:
        best = int(detail.argmax())
        row, column = divmod(best, detail.shape[-1])
        if not math.isfinite(float(detail[row, column])):
            break
        places.append((row, column))
        detail[max(0, row - size + 1) : row + size, max(0, column - size + 1) : column + size] = -math.inf
    return places


def comparison_figure(
    raw: Tensor, restored: Tensor, *, count: int = 3, size: int = 160, names: tuple[str, str] = ("as taken", "restored")
) -> Figure:
    """Draw crops of a raw and a restored frame beneath each other, where detail is strongest.

    Args:
        raw: (H, W) or (C, H, W), full scale 1.
        restored: The same shape.
        count: Crops.
        size: Side of the crops in px.
        names: What the two are called.
    """
    raw, restored = (_picture(frame) for frame in (raw, restored))
    size = min(size, *raw.shape[:2])
    margin = min(16, (min(raw.shape[:2]) - size) // 2)  # the rim of a restored frame is made up
    grey = restored.mean(-1)
    inner = grey[margin : grey.shape[0] - margin, margin : grey.shape[1] - margin]
    places = [(row + margin, column + margin) for row, column in detailed_places(inner, size, count)]
    figure = Figure(figsize=(4.0 * len(places) + 0.4, 8.6), layout="constrained")
    panels = figure.subplots(2, len(places), squeeze=False)
    for index, (row, column) in enumerate(places):
        crops = [frame[row : row + size, column : column + size] for frame in (raw, restored)]
        low, high = (float(torch.stack(crops).quantile(q)) for q in (0.002, 0.998))
        for crop, panel, name in zip(crops, panels[:, index], names, strict=True):
            shown = ((crop - low) / max(high - low, 1e-6)).clamp(0, 1)
            panel.imshow(
                shown.expand(-1, -1, 3).numpy(),
                interpolation="nearest",
                extent=(column - 0.5, column + size - 0.5, row + size - 0.5, row - 0.5),
            )
            panel.tick_params(colors=_INK, labelsize=8)
            panel.spines[:].set_visible(False)
            panel.locator_params(nbins=4)
            if index == 0:
                panel.set_ylabel("row (px)", color=_INK)
                panel.set_title(name, loc="left", fontsize=12, fontweight="bold", color=_INK)
        panels[1, index].set_xlabel("column (px)", color=_INK)
    return figure


def _picture(frame: Tensor) -> Tensor:
    """Frame (H, W, 1) or (H, W, 3) on the CPU, for drawing."""
    frame = frame.detach().float().cpu()
    frame = frame[None] if frame.ndim == 2 else frame
    frame = frame[:3] if frame.shape[0] >= 3 else frame.mean(0, keepdim=True)
    return frame.movedim(0, -1)
