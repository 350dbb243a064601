"""Figures of detections and restorations, and values with their standard deviations as text."""

import math
import os
import textwrap
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from rsvib_torch import detection, gyroscope
from rsvib_torch.checks.arguments import check_shapes, checks_arguments
from rsvib_torch.checks.values import Count, check_single
from rsvib_torch.detection import DetectionResult
from rsvib_torch.detection.spectrum import SMALLEST_SHOWN
from rsvib_torch.evaluation import MtfCurve
from rsvib_torch.files.atomic import whole
from rsvib_torch.files.reading import Table
from rsvib_torch.imaging import row_psf
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.interpolation import gauss_legendre
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.restoration import RestorationVerdict
from rsvib_torch.results.presentation import AXIS_NAMES, AXIS_UNITS, FIGURES, figure_png
from rsvib_torch.stacks import StackManifest
from rsvib_torch.text import measured_text

_INK, _GREY, _GRID = "#222222", "#8a8a8a", "#d9d9d9"
_X_COLOUR, _Y_COLOUR = "#14487a", "#c8102e"
_AXIS_COLOURS = {"x": _X_COLOUR, "y": _Y_COLOUR}
_FIT_COLOUR = _Y_COLOUR
_LEGEND: Table = {"fontsize": 9, "frameon": False}
_LEGEND_ABOVE: Table = {**_LEGEND, "loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
_TITLE: Table = {"loc": "left", "fontsize": 9.5, "color": _INK}
_HEADING: Table = {"loc": "left", "fontsize": 12, "fontweight": "bold", "color": _INK}
_OFFSET_TIME = "exposure start of the rows in the earlier frame (ms)"
_QUALITY_COLOURS = LinearSegmentedColormap.from_list("quality", ["#f0a030", "#9cc3e0", _X_COLOUR])  # poor ... good


class _Drawing(Figure):
    """A figure that notebooks show without pyplot."""

    def _repr_png_(self) -> bytes:
        return figure_png(self, dpi=90)


@checks_arguments
def save_figure(
    figure: Figure, path: str | os.PathLike[str], *, dpi: Annotated[int, Field(ge=10, le=10_000)] = 150
) -> None:
    """Write a figure as an image file, atomically.

    Args:
        figure: The figure.
        path: The file to write; its ending selects the format (``.png``, ``.svg``, ``.pdf``).
        dpi: Pixels per inch.
    """
    with whole(path) as part:
        figure.savefig(part, dpi=dpi, facecolor="white")


def plain_axes(panel: Axes, x: str = "", y: str = "", *, title: str = "", heading: str = "") -> None:
    """Apply the style of the package: a light grid, no upper and right border, labels, and a title or a heading."""
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color(_INK)
    panel.tick_params(colors=_INK, labelsize=9)
    panel.grid(color=_GRID, linewidth=0.6)
    panel.set_axisbelow(True)
    panel.set_xlabel(x, color=_INK)
    panel.set_ylabel(y, color=_INK)
    panel.set_title(heading or title, **(_HEADING if heading else _TITLE))


def _panels(width: float, height: float, rows: int = 1, columns: int = 1, **grid: Any) -> tuple[Figure, Array]:
    """A figure of a size in inches, and its ``Axes`` (rows, columns)."""
    figure = _Drawing(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **grid)


def _plot_axes(
    panel: Axes, x: Array | Tensor, values: Tensor, std: Tensor | None = None, *, legend: bool = True
) -> None:
    """Draw values (N, 2) of x and y in their colours, with bands of two standard deviations."""
    for axis, (name, colour) in enumerate(_AXIS_COLOURS.items()):
        of_axis = values[:, axis].detach().cpu()
        panel.plot(x, of_axis, color=colour, linewidth=1.3, label=name)
        if std is not None:
            reach = 2 * std[:, axis].cpu()
            panel.fill_between(x, of_axis - reach, of_axis + reach, color=colour, alpha=0.2, linewidth=0)
    if legend:
        panel.legend(**_LEGEND, ncols=2)


def _symbol(label: str, **style: Any) -> Line2D:
    """An entry of a legend: a point, or a line if its style is given."""
    return Line2D([], [], label=label, **{"marker": "o", "linewidth": 0, **style})


def _legend_below(figure: Figure, *symbols: Line2D) -> None:
    figure.legend(handles=symbols, loc="outside lower center", ncols=len(symbols), fontsize=9.5, frameon=False)


_MOST_PAIRS = 12  # pairs of frames whose curves can be distinguished on 6 inches
_SHOWN_PAIRS = 8


def _shown_pairs(result: DetectionResult) -> slice:
    """Pairs of frames whose offsets are drawn: all, or of many frames the neighbouring ones that fit worst."""
    count = len(result.offsets.pairs)
    if count <= _MOST_PAIRS:
        return slice(0, count)
    residual = (result.offsets.offsets - result.fitted).square().nan_to_num(0.0)
    of_pairs = (residual / residual.mean((0, 1)).clamp(min=1e-30)).mean((1, 2))  # axes count alike
    first = int(of_pairs.unfold(0, _SHOWN_PAIRS, 1).mean(-1).argmax())
    return slice(first, first + _SHOWN_PAIRS)


def _draw_offsets(upper: Axes, lower: Axes, result: DetectionResult, axis: int) -> PathCollection:
    """Draw the offsets of an axis with their fit, and below the residuals; returns the coloured points."""
    curve, shown = result.offsets, _shown_pairs(result)
    times = curve.times.cpu().numpy() * 1e3
    offsets, fitted, quality = (t.detach().cpu().numpy() for t in (curve.offsets, result.fitted, curve.quality))
    measured, expected = offsets[..., axis], fitted[..., axis]
    good = np.isfinite(measured)
    residual = (measured - expected)[good]
    style = {"c": quality[good], "cmap": _QUALITY_COLOURS, "vmin": 0.0, "vmax": 1.0, "linewidths": 0, "zorder": 2}
    size, size_of_all = (max(4.0, min(22.0, 4000.0 / max(1, part.size))) for part in (measured[shown], measured))
    points = lower.scatter(times[good], residual, s=0.6 * size_of_all, **style)
    of_shown = good[shown]
    style["c"] = quality[shown][of_shown]
    upper.scatter(times[shown][of_shown], measured[shown][of_shown], s=size, **style)
    for pair in range(len(times))[shown]:
        upper.plot(times[pair], expected[pair], color=_FIT_COLOUR, linewidth=1.3, zorder=3)
    failed = times[shown][~of_shown]
    edge = upper.get_xaxis_transform()
    upper.scatter(failed, np.full_like(failed, 0.02), s=18, marker="x", color=_GREY, transform=edge, zorder=4)
    if curve.std is not None:
        std = curve.std.detach().cpu().numpy()[..., axis][good]
        lower.errorbar(times[good], residual, std, fmt="none", ecolor=_GRID, elinewidth=0.8, zorder=1)
    lower.axhline(0.0, color=_FIT_COLOUR, linewidth=1.0, zorder=3)
    spread = 1.15 * float(np.quantile(np.abs(residual), 0.99)) if residual.size else 1.0
    smallest = 1e-3 if axis < 2 else 1e-6
    lower.set_ylim(-max(spread, smallest), max(spread, smallest))
    unit, mean = AXIS_UNITS[axis], float(result.residual[axis])
    some = len(of_shown) < len(times)
    text = f"frames {shown.start} … {shown.stop} of {len(times) + 1}, in which the residual is largest (ms)"
    plain_axes(upper, text if some else "", f"offset ({unit})")
    plain_axes(lower, _OFFSET_TIME, f"residual ({unit})", title=f"mean |residual| {mean:.3g} {unit}")
    return points


@checks_arguments
def offset_figure(result: DetectionResult) -> Figure:
    """Draw the offset curve of each axis with its fit, and the residuals (as Figure 6 of Liu et al. 2023).

    Points are the measurements that the vibration was fitted to: rows of the images in the direct method, with error
    bars of one standard deviation in the lower panels, row bands otherwise. Their colour is their quality; crosses on
    the lower edge are rows that were not measured; the line is the offset curve of the detected vibration. Of more than
    13 frames, the upper panels have the 9 neighbouring frames with the largest residual, and the lower ones all.

    Example:
        >>> import rsvib_torch as rsv
        >>> frames, timing, _ = rsv.datasets.example_frames()
        >>> [panel.get_ylabel() for panel in offset_figure(rsv.detect_vibration(frames, timing, method="bands")).axes]
        ['offset (px)', 'offset (px)', 'residual (px)', 'residual (px)', 'quality (0: outlier)']
    """
    check_single("result", result.batch_shape)
    vibration, std, axes = result.vibration, result.std, result.vibration.num_axes
    sharex = len(result.offsets.pairs) <= _MOST_PAIRS or "row"  # all pairs are shown, or only below
    figure, panels = _panels(6.5 * axes, 6.4, 2, axes, sharex=sharex, height_ratios=(3, 1))
    for axis, (name, upper, lower) in enumerate(zip(AXIS_NAMES, *panels, strict=False)):
        points = _draw_offsets(upper, lower, result, axis)
        upper.set_title(f"Offset along {name}" if axis < 2 else f"Offset of {name}", **_HEADING, pad=36)
        text = ",  ".join(
            f"{measured_text(vibration.amplitude[axis, tone], std.amplitude[axis, tone])} {AXIS_UNITS[axis]} at "
            f"{measured_text(vibration.frequency[axis, tone], std.frequency[axis, tone])} Hz"
            for tone in vibration.amplitude[axis].nonzero()[:, 0].tolist()
        )
        if not bool(result.reliable[axis]):
            text = "not reliable: " + "; ".join(str(reason) for reason in result.reasons[axis])
        text = "\n".join(textwrap.wrap(text, 76, max_lines=2, placeholder=" …"))
        note = upper.annotate(text, (0, 1), (0, 32), "axes fraction", "offset points", va="top", fontsize=9.5)
        note.set_in_layout(False)  # a long text would reduce the size of the panels
    _legend_below(
        figure,
        _symbol("measured rows", color=_QUALITY_COLOURS(1.0), markersize=5),
        _symbol("detected vibration", color=_FIT_COLOUR, marker="", linewidth=1.3),
        _symbol("not measured", color=_GREY, marker="x", markersize=5),
    )
    bar = figure.colorbar(points, ax=panels, fraction=0.025, pad=0.01)
    bar.set_label("quality (0: outlier)", color=_INK)
    bar.outline.set_visible(False)
    return figure


@checks_arguments
def windows_figure(
    times: Sequence[float], detections: Sequence[DetectedVibration | None], *, time_label: str = "time (s)"
) -> Figure:
    """Draw amplitude and frequency of the detected tones over windows or stacks, with error bars of two stds.

    Points of axes that are not reliable are hollow and do not determine the range of the axis.

    Args:
        times: Position of each window on the horizontal axis.
        detections: The detection of each window (not a batch); None where it failed.
        time_label: Label of the horizontal axis.

    Example:
        >>> from rsvib_torch.datasets import example_frames
        >>> from rsvib_torch.detection import detect_vibration
        >>> frames, timing, _ = example_frames(num_frames=4)
        >>> parts = [detect_vibration(part, timing, tones=1) for part in (frames[:2], frames[2:])]
        >>> len(windows_figure([0.0, 2 * timing.frame_period], parts).axes)
        4
    """
    figure, panels = _panels(11, 5.6, 2, 2, sharex=True)
    for axis, name in enumerate("xy"):
        for panel, (quantity, unit) in zip(panels[:, axis], (("amplitude", "px"), ("frequency", "Hz")), strict=True):
            reliable_values: list[float] = []
            for time, result in zip(times, detections, strict=True):
                if result is None:
                    panel.axvline(time, color=_GREY, linewidth=0.8, linestyle=":", zorder=0)
                    continue
                reliable = bool(result.reliable[axis])
                for tone in result.vibration.amplitude[axis].nonzero()[:, 0].tolist():
                    value = float(getattr(result.vibration, quantity)[axis, tone])
                    std, colour = getattr(result.std, quantity)[axis, tone], _AXIS_COLOURS[name] if tone == 0 else _GREY
                    error = 2 * float(std) if reliable and math.isfinite(float(std)) else 0.0
                    style = {"color": colour, "marker": "o", "markerfacecolor": colour if reliable else "white"}
                    panel.errorbar(time, value, error, linestyle="none", markersize=5, capsize=2, **style)
                    reliable_values += [value - error, value + error] if reliable else []
            if reliable_values:
                low, high = min(reliable_values), max(reliable_values)
                margin = max(0.15 * (high - low), 0.002 * abs(high))
                panel.set_ylim(low - margin, high + margin)
            panel.ticklabel_format(axis="y", useOffset=False)
            label, heading = ("", f"Tones along {name}") if quantity == "amplitude" else (time_label, "")
            plain_axes(panel, label, f"{quantity} ({unit})", heading=heading)
    _legend_below(
        figure,
        _symbol("strongest tone, reliable", color=_INK),
        _symbol("not reliable", color=_INK, markerfacecolor="white"),
        _symbol("weaker tone", color=_GREY),
        _symbol("detection failed", color=_GREY, marker="", linewidth=None, linestyle=":"),
    )
    return figure


@checks_arguments
def motion_figure(motion: Motion, first: float = 0.0, last: float | None = None) -> Figure:
    """Draw the displacement of a motion along both axes over time.

    Args:
        motion: The motion (not a batch).
        first: Start of the drawing in seconds.
        last: End of the drawing; by default that of a free motion, or four periods of the tone of lower frequency.

    Example:
        >>> motion_figure(Vibration([3.1, 5.2], [50.0, 30.0])).axes[0].get_xlabel()
        'time (ms)'
    """
    check_single("motion", motion.batch_shape)
    if isinstance(motion, FreeMotion):
        first, last = motion.start, motion.end if last is None else last
    if last is None:
        periods = motion.periods_within(1.0)
        slowest = float(periods[periods > 0].min()) if bool((periods > 0).any()) else 10.0  # Hz
        last = first + 4.0 / slowest
    times = torch.linspace(first, last, 2000, dtype=torch.float64, device=motion.device)
    displacement = motion.displacement(times).detach().cpu()
    further = motion.num_axes - 2
    figure, panels = _panels(8, 3.6 + 2.0 * further, 1 + further, sharex=True)
    _plot_axes(panels[0, 0], 1e3 * times.cpu(), displacement[:, :2])
    plain_axes(panels[0, 0], "time (ms)", "displacement (px)")
    for axis, panel in enumerate(panels[1:, 0], start=2):
        panel.plot(1e3 * times.cpu(), displacement[:, axis], color=_INK, linewidth=1.3)
        plain_axes(panel, "time (ms)", f"{AXIS_NAMES[axis]} ({AXIS_UNITS[axis]})")
    return figure


def _detected_motion_figure(result: detection.MotionDetection) -> Figure:
    """Draw a free motion at the rows of the frames with a band of two standard deviations."""
    figure, ((panel,),) = _panels(8, 3.6)
    for frame, (times, *values) in enumerate(zip(result.times, result.displacement, result.std, strict=True)):
        _plot_axes(panel, 1e3 * times, *values, legend=frame == 0)
    plain_axes(panel, "time (ms)", "displacement (px)")
    lines = [  # which axes are not reliable, with the first reason
        textwrap.shorten(f"{name}: not reliable: {reasons[0]}", 100, placeholder=" …")
        for name, good, reasons in zip("xy", result.reliable, result.reasons, strict=True)
        if not bool(good)
    ]
    panel.set_title("\n".join(lines), **_TITLE)
    return figure


def _verdict_figure(verdict: RestorationVerdict) -> Figure:
    """Draw the displacement between the frames of each pair before and after restoration, and the improvement."""
    figure, (panels,) = _panels(10, 3.4, 1, 3)
    curves = (
        (verdict.misfit_before, "o-", _X_COLOUR, "frames as taken"),
        (verdict.misfit_after, "s-", _Y_COLOUR, "after restoration"),
        (verdict.resolution, ":", _GREY, "smallest visible"),
    )
    titles = ("displacement along x (px rms)", "displacement along y (px rms)", "estimated improvement (dB)")
    for axis, (panel, title) in enumerate(zip(panels, titles, strict=True)):
        for values, style, colour, label in curves if axis < 2 else ():
            panel.plot(values[:, axis], style, color=colour, markersize=4, label=label)
        panel.xaxis.get_major_locator().set_params(integer=True)
        plain_axes(panel, "pair of frames", title=title)
        panel.set_ylim(bottom=0 if axis < 2 else None)
    panels[0].legend(**_LEGEND)
    panels[2].plot(verdict.predicted_gain, "o-", color=_X_COLOUR, markersize=4)
    panels[2].axhline(0.0, color=_GREY, linewidth=0.8)
    return figure


@checks_arguments
def psf_figure(vibration: Motion, timing: SensorTiming, num_rows: Count) -> Figure:
    """Draw point spread functions of 24 rows of frame 0 with the path of the image during their exposure.

    Each kernel is centred on the mean displacement of its row, rounded to whole px; all have the same grey scale.

    Example:
        >>> timing = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
        >>> len(psf_figure(Vibration([3.1, 5.2], [50.0, 30.0]), timing, num_rows=2048).axes)
        24
    """
    check_single("vibration", vibration.batch_shape)
    vibration = vibration.detached()
    down, across = 3, 8
    rows = torch.linspace(0, num_rows - 1, down * across, dtype=torch.float32, device="cpu").round()
    starts = timing.row_starts(1, num_rows)[0][rows.long()]
    psf = row_psf(vibration, starts, timing)
    centre = psf.centroid().round()
    nodes, _ = gauss_legendre(32)
    path = (vibration.displacement(starts[:, None] + nodes * timing.exposure_time) - centre[:, None]).numpy()
    first = psf.first_tap - centre
    height, width = psf.weights.shape[-2:]
    last = first + torch.tensor([width - 1, height - 1], device="cpu")
    reach = max(2, int(torch.maximum(first.abs(), last.abs()).max()))  # px around the centre
    figure, panels = _panels(11.4, 4.9, down, across)
    grey: Table = {"cmap": "Greys", "vmin": 0, "vmax": psf.weights.max(), "interpolation": "nearest"}
    for index, (panel, (left, top)) in enumerate(zip(panels.flat, first.tolist(), strict=True)):
        extent = (left - 0.5, left + width - 0.5, top + height - 0.5, top - 0.5)
        panel.imshow(psf.weights[index].numpy(), **grey, extent=extent)
        panel.plot(*path[index].T, color=_Y_COLOUR, linewidth=1.6)
        panel.set_title(f"row {int(rows[index])}", fontsize=9, loc="left", pad=3)
        panel.set(xticks=[], yticks=[], xlim=(-reach - 0.5, reach + 0.5), ylim=(reach + 0.5, -reach - 0.5))
        panel.spines[:].set_color(_GRID)
    panels[-1, 0].set_xlabel(f"{2 * reach + 1} px", fontsize=9)
    return figure


def _mtf_figure(curve: MtfCurve) -> Figure:
    """Draw the modulation transfer function of a slanted edge with a band of two standard deviations."""
    figure, ((panel,),) = _panels(5.6, 3.9)
    shown = curve.frequency <= 0.5
    frequency, mtf, reach = curve.frequency[shown], curve.mtf[shown], 2 * curve.std[shown]
    panel.plot(frequency, mtf, color=_X_COLOUR, linewidth=1.6)
    panel.fill_between(frequency, mtf - reach, mtf + reach, color=_X_COLOUR, alpha=0.2, linewidth=0)
    panel.axhline(0.5, color=_GREY, linewidth=0.8, linestyle="--", zorder=0)
    title = f"MTF50 {measured_text(curve.mtf50, curve.mtf50_std)} cycles/px"
    plain_axes(panel, "spatial frequency (cycles/px)", "MTF", title=title)
    panel.set(xlim=(0, 0.5), ylim=(0, None))
    return figure


def detailed_places(image: Tensor, size: int, count: int, rim: int = 0) -> list[tuple[int, int]]:
    """Corners (row, column) of ``count`` windows with the strongest detail that do not overlap, ``rim`` px inside."""
    rim = min(rim, (min(image.shape) - size) // 2)
    image = image[rim : image.shape[0] - rim, rim : image.shape[1] - rim]
    down, right = (functional.pad(image.diff(dim=d), pad) for d, pad in ((0, (0, 0, 0, 1)), (1, (0, 1))))
    # The square root reduces the weight of a single hard edge relative to rich texture.
    sums = functional.pad((down.square() + right.square()).sqrt().double().cumsum(0).cumsum(1), (1, 0, 1, 0))
    detail = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size]
    places: list[tuple[int, int]] = []
    while len(places) < count:
        row, column = divmod(int(detail.argmax()), detail.shape[-1])
        if not math.isfinite(float(detail[row, column])):
            break
        places.append((row + rim, column + rim))
        detail[max(0, row - size + 1) : row + size, max(0, column - size + 1) : column + size] = -math.inf
    return places


@checks_arguments
def comparison_figure(
    raw: Tensor,
    restored: Tensor,
    *,
    count: Count = 3,
    size: Count = 160,
    names: tuple[str, str] = ("input", "restored"),
) -> Figure:
    """Draw crops of an input frame and a restored frame below each other, where detail is strongest.

    Args:
        raw: (H, W) or (C, H, W), full scale 1.
        restored: The same shape.
        count: Number of crops.
        size: Side of the crops in px.
        names: Titles of the two rows of panels.

    Example:
        >>> frame = torch.rand(96, 128, generator=torch.Generator().manual_seed(0))
        >>> len(comparison_figure(frame, frame, count=2, size=32).axes)
        4
    """
    raw, restored = (frame[None] if frame.ndim == 2 else frame for frame in (raw, restored))
    check_shapes({"raw": raw, "restored": restored}, {"raw": "C H W", "restored": "C H W"})
    raw, restored = (picture(frame) for frame in (raw, restored))
    size = min(size, *raw.shape[:2])
    places = detailed_places(restored.mean(-1), size, count, rim=16)  # boundary extension changes the border
    figure, panels = _panels(4.0 * len(places) + 0.4, 8.6, 2, len(places))
    for index, (row, column) in enumerate(places):
        crops = [frame[row : row + size, column : column + size] for frame in (raw, restored)]
        low, high = (float(torch.stack(crops).quantile(q)) for q in (0.002, 0.998))
        extent = (column - 0.5, column + size - 0.5, row + size - 0.5, row - 0.5)
        for crop, panel, name in zip(crops, panels[:, index], names, strict=True):
            grey_levels = ((crop - low) / max(high - low, 1e-6)).clamp(0, 1).expand(-1, -1, 3).numpy()
            panel.imshow(grey_levels, interpolation="nearest", extent=extent)
            panel.tick_params(colors=_INK, labelsize=8)
            panel.spines[:].set_visible(False)
            panel.locator_params(nbins=4)
            if index == 0:
                panel.set_ylabel("row (px)", color=_INK)
                panel.set_title(name, **_HEADING)
        panels[1, index].set_xlabel("column (px)", color=_INK)
    return figure


def picture(frame: Tensor) -> Tensor:
    """Frame (H, W) or (C, H, W) as (H, W, 1) or, from three channels on, as (H, W, 3), float32 on the CPU."""
    frame = frame.detach().float().cpu()
    frame = frame[None] if frame.ndim == 2 else frame
    frame = frame[:3] if frame.shape[0] >= 3 else frame.mean(0, keepdim=True)
    return frame.movedim(0, -1)


def _measured_offsets_figure(curve: OffsetCurve) -> Figure:
    """Draw the measured offsets of each axis, with error bars of one standard deviation if they are known."""
    times, offsets = 1e3 * curve.times[curve.good], curve.offsets[curve.good]
    figure, (panels,) = _panels(13, 4.2, 1, 2, sharex=True)
    for axis, (panel, (name, colour)) in enumerate(zip(panels, _AXIS_COLOURS.items(), strict=True)):
        std = None if curve.std is None else curve.std[curve.good][:, axis]
        panel.errorbar(times, offsets[:, axis], std, fmt=".", color=colour, ecolor=_GRID, label="measured")
        panel.legend(**_LEGEND_ABOVE)
        plain_axes(panel, _OFFSET_TIME, "offset (px)", heading=f"Offset along {name}")
    return figure


_BLIND_COLOUR = "#ececec"
_LABELLED_LINES = 6  # per axis; more labels would cover each other


def _spectrum_figure(result: detection.DisplacementSpectrum) -> Figure:
    """Draw amplitude spectrum and power spectral density of each axis, their noise, and the blind bands in grey."""
    axes = len(result.amplitude)
    figure, panels = _panels(6.5 * axes, 6.4, 2, axes, sharex=True)
    frequency, half = result.frequency.numpy(), 0.25 * result.resolution  # half of a step
    # first and last of each run of blind neighbours
    runs = np.flatnonzero(np.diff(result.blind.numpy(), prepend=False, append=False)).reshape(-1, 2) - [0, 1]
    for axis, name in enumerate(AXIS_NAMES[:axes]):
        unit, colour = AXIS_UNITS[axis], _AXIS_COLOURS.get(name, _INK)
        curves = ((result.amplitude, result.noise, unit), (result.psd, result.noise_psd, f"{unit}²/Hz"))
        for panel, (of_axes, of_noise, unit_of_panel) in zip(panels[:, axis], curves, strict=True):
            values, noise = of_axes[axis].numpy(), of_noise[axis].numpy()
            for first, last in frequency[runs]:
                panel.axvspan(first - half, last + half, color=_BLIND_COLOUR, linewidth=0)
            panel.plot(frequency, values, color=colour, linewidth=0.8)
            panel.plot(frequency, noise, color=_INK, linewidth=0.9, linestyle="--")
            panel.set(xscale="log", yscale="log", xlim=(frequency[0], frequency[-1]))
            if np.isfinite(noise).any():
                bottom = 0.1 * float(np.nanmin(noise))
                panel.set_ylim(bottom, 5 * max(float(np.nanmax(values)), 10 * bottom))
            quantity = "amplitude" if panel is panels[0, axis] else "PSD"
            plain_axes(panel, "" if quantity == "amplitude" else "frequency (Hz)", f"{quantity} ({unit_of_panel})")
        panels[0, axis].set_title(f"Displacement along {name}" if axis < 2 else name.capitalize(), **_HEADING)
        labelled: list[float] = []
        label_width = 0.09 * math.log(frequency[-1] / frequency[0])  # 9 % of the panel
        lines = result.lines.amplitude[axis].tolist(), result.lines.frequency[axis].tolist()
        for amplitude, at in zip(*lines, strict=True):  # the strongest first
            is_clear = all(abs(math.log(at / other)) > label_width for other in labelled if at > 0)
            if amplitude > SMALLEST_SHOWN * lines[0][0] and is_clear and len(labelled) < _LABELLED_LINES:
                text = f"{measured_text(at)} Hz\n{measured_text(amplitude, digits=3)} {unit}"
                place = {"textcoords": "offset points", "fontsize": 8, "ha": "center"}
                panels[0, axis].annotate(text, (at, amplitude), (0, 4), **place)
                labelled.append(at)
    _legend_below(
        figure,
        _symbol("displacement", color=_X_COLOUR, marker="", linewidth=0.8),
        _symbol("noise (rms)", color=_INK, marker="", linewidth=0.9, linestyle="--"),
        _symbol("blind: the frames cannot show this frequency", color=_BLIND_COLOUR, marker="s", markersize=9),
    )
    return figure


def _rotation_figure(result: gyroscope.RotationAlignment) -> Figure:
    """Draw X, Y and roll from frame to frame, measured in the images and by the gyroscope, and their differences."""
    figure, panels = _panels(8, 7.2, 3, sharex=True)
    for axis, (name, unit, factor) in enumerate((("x", "px", 1.0), ("y", "px", 1.0), ("roll", "mrad", 1e3))):
        measured, predicted = factor * result.measured[:, axis], factor * result.predicted[:, axis]
        difference = measured - predicted
        rms = float(difference.square().mean().sqrt())
        panel = panels[axis, 0]
        panel.plot(result.times, predicted, color=_FIT_COLOUR, linewidth=1.3, label="gyroscope")
        panel.plot(result.times, measured, "o", color=_X_COLOUR, markersize=3.5, label="frames")
        panel.plot(result.times, difference, color=_GREY, linewidth=1.0, label=f"difference, {rms:.3g} {unit} rms")
        panel.legend(**_LEGEND_ABOVE, ncols=3)
        heading = "Between consecutive frames" if axis == 0 else ""
        plain_axes(panel, "" if axis < 2 else "time (s)", f"{name} ({unit})", heading=heading)
    return figure


# of results on the CPU, without gradients
FIGURES.update(
    {
        DetectionResult: offset_figure,
        detection.DisplacementSpectrum: _spectrum_figure,
        detection.MotionDetection: _detected_motion_figure,
        gyroscope.RotationAlignment: _rotation_figure,
        Vibration: motion_figure,
        FreeMotion: motion_figure,
        MtfCurve: _mtf_figure,
        OffsetCurve: _measured_offsets_figure,
        RestorationVerdict: _verdict_figure,
        StackManifest: lambda manifest: windows_figure(
            [record.start_time for record in manifest.windows], [record.detection for record in manifest.windows]
        ),
    }
)
