"""Figures of a page: gain and tones, displacement and smear of rows, a film of their point spread functions."""

import math

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.imaging import row_psf
from rsvib_torch.imaging.trajectory import exposure_nodes
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import blind_frequencies
from rsvib_torch.report.plots import plain_axes

__all__ = ["gain_figure", "psf_film", "rows_figure", "smear"]

COLOURS = {"x": "#14487a", "y": "#c8102e"}
_BLIND = "#b8bcc0"
_POINTS = 2000  # of a curve
_CELLS = (3, 8)  # of the film, down and across
_LEAST_REACH = 2  # px around the centre of a cell of the film
_WEAKEST = 0.1  # gain below which a frame pair is refused


def _reach(result: DetectionResult, timing: SensorTiming) -> float:
    """Highest frequency worth showing, in Hz."""
    moving = result.vibration.amplitude > 0
    tones = result.vibration.frequency[moving]
    highest = float(tones.max()) if len(tones) else 0.0
    return max(1.35 * highest, 4.2 / timing.frame_period)


def gain_figure(result: DetectionResult, timing: SensorTiming) -> Figure:
    """Draw what a pair of frames sees of each frequency, and the tones with their standard deviations (times 2).

    The gain is ``|2 sin(pi f m T_row) sinc(f T_e)|``, px of offset for a px of displacement (Eqs. 2 and 7).

    Args:
        result: A detection (not a batch).
        timing: The sensor.
    """
    highest = _reach(result, timing)
    frequency = np.linspace(0.0, highest, _POINTS)
    gain = np.abs(2 * np.sin(np.pi * frequency * timing.frame_period) * np.sinc(frequency * timing.exposure_time))
    figure = Figure(figsize=(5.6, 4.6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.2, 1))
    upper.plot(frequency, gain, color="#555555", linewidth=1.2)
    upper.axhline(_WEAKEST, color=_BLIND, linewidth=0.8, linestyle=":")
    for panel in (upper, lower):
        for blind in blind_frequencies(timing, highest).tolist():
            panel.axvline(blind, color=_BLIND, linewidth=0.8, linestyle="--", zorder=0)
    vibration, std = result.vibration, result.std
    for axis, name in enumerate("xy"):
        label = name
        for tone in range(vibration.amplitude.shape[-1]):
            at, size = float(vibration.frequency[axis, tone]), float(vibration.amplitude[axis, tone])
            if size <= 0:
                continue
            trusted = bool(result.reliable[axis])
            style = {"color": COLOURS[name], "marker": "o", "markersize": 6, "linestyle": "none"}
            style |= {} if trusted else {"markerfacecolor": "white"}
            seen = abs(float(result.gain[axis, tone])) * float(np.abs(np.sinc(at * timing.exposure_time)))
            upper.plot(at, seen, **style, label=label if trusted else f"{name} (not reliable)")
            error = [2 * float(value) for value in (std.amplitude[axis, tone], std.frequency[axis, tone])]
            bars = [value if math.isfinite(value) else 0.0 for value in error]
            lower.errorbar(at, size, bars[0], bars[1], capsize=3, elinewidth=1.4, **style)
            label = ""
    handles, labels = upper.get_legend_handles_labels()
    kept = {text: handle for handle, text in zip(handles, labels, strict=True) if text}
    if kept:
        upper.legend(list(kept.values()), list(kept), fontsize=9, frameon=False, loc="upper right", ncols=2)
    upper.set_ylim(0, 2.4)
    lower.set_ylim(0, 1.15 * lower.get_ylim()[1])
    upper.set_xlim(0, highest)
    upper.set_ylabel("gain (px per px)")
    lower.set_ylabel("amplitude (px)")
    lower.set_xlabel("frequency (Hz)")
    plain_axes(upper)
    plain_axes(lower)
    return figure


def smear(vibration: Motion, starts: Tensor, timing: SensorTiming) -> Tensor:
    """How far the image moves on the sensor while each row is exposed, (..., 2) in px: its largest excursion.

    Args:
        vibration: The motion.
        starts: Exposure starts of the rows in seconds.
        timing: The sensor.
    """
    times, _ = exposure_nodes(timing, "gauss", 16)
    ends = torch.tensor([0.0, timing.exposure_time], dtype=torch.float64)
    moments = torch.cat([ends, times.cpu()]).to(starts.device)
    path = vibration.displacement(starts[..., None] + moments)
    return path.amax(-2) - path.amin(-2)


def rows_figure(vibration: Motion, timing: SensorTiming, num_rows: int) -> Figure:
    """Draw displacement and smear of every row of frame 0.

    Args:
        vibration: The motion.
        timing: The sensor.
        num_rows: Rows of a frame.
    """
    starts = timing.row_starts(1, num_rows)[0]
    rows = np.arange(num_rows)
    place = vibration.mean_displacement(starts, timing.exposure_time).numpy()
    moved = smear(vibration, starts, timing).numpy()
    figure = Figure(figsize=(5.6, 4.6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axis, name in enumerate("xy"):
        upper.plot(rows, place[:, axis], color=COLOURS[name], linewidth=1.3, label=name)
        lower.plot(rows, moved[:, axis], color=COLOURS[name], linewidth=1.3, label=name)
    upper.set_ylabel("displacement (px)")
    lower.set_ylabel("smear (px)")
    lower.set_ylim(bottom=0)
    lower.set_xlabel("row, in the order of exposure")
    upper.legend(fontsize=9, frameon=False, ncols=2)
    plain_axes(upper)
    plain_axes(lower)
    return figure


def psf_film(vibration: Motion, timing: SensorTiming, num_rows: int) -> Figure:
    """Draw the point spread functions of rows down frame 0, with the path that the image takes while they are exposed.

    Each kernel is centred on the mean displacement of its row, to whole px; the grey scale is common to all.

    Args:
        vibration: The motion.
        timing: The sensor.
        num_rows: Rows of a frame.
    """
    count = _CELLS[0] * _CELLS[1]
    rows = torch.linspace(0, num_rows - 1, count).round()
    starts = timing.row_starts(1, num_rows)[0][rows.long()]
    psf = row_psf(vibration, starts, timing)
    centre = psf.centroid().round()
    times, _ = exposure_nodes(timing, "gauss", 32)
    path = vibration.displacement(starts[:, None] + times) - centre[:, None]
    first = psf.first_tap - centre
    size = torch.tensor(psf.weights.shape[:-3:-1])
    reach = max(_LEAST_REACH, int(torch.maximum(first.abs(), (first + size - 1).abs()).max()))
    cells = np.zeros((count, 2 * reach + 1, 2 * reach + 1))
    for index in range(count):
        left, top = (int(value) + reach for value in first[index].tolist())
        height, width = psf.weights.shape[-2:]
        cells[index, top : top + height, left : left + width] = psf.weights[index].numpy()
    figure = Figure(figsize=(11.4, 4.9), layout="constrained")
    panels = figure.subplots(*_CELLS).flatten()
    for index, panel in enumerate(panels):
        panel.imshow(
            cells[index],
            cmap="Greys",
            vmin=0,
            vmax=cells.max(),
            interpolation="nearest",
            extent=(-reach - 0.5, reach + 0.5, reach + 0.5, -reach - 0.5),
        )
        panel.plot(path[index, :, 0].numpy(), path[index, :, 1].numpy(), color=COLOURS["y"], linewidth=1.6)
        panel.set_title(f"row {int(rows[index])}", fontsize=9, loc="left", pad=3)
        panel.set_xticks([])
        panel.set_yticks([])
        panel.spines[:].set_color("#d9d9d9")
    panels[-_CELLS[1]].set_xlabel(f"{2 * reach + 1} px", fontsize=9)
    return figure
