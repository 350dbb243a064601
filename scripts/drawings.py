#!/usr/bin/env python
"""Draw the figures of the pages "Concepts" and "Architecture" as SVG files.

The curves are computed with the package. Row time and vibration are those of Liu et al. 2023 (20.52 us, 3.1 px at
50 Hz along x); the exposure is longer, so that it is visible in the drawing.
"""

import argparse
import math
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import torch
from architecture import LAYERS
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Polygon

import rsvib_torch as rsv

ROOT = Path(__file__).resolve().parents[1]
TIMING = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=200, frame_rows=2400)
VIBRATION = rsv.Vibration(amplitude=[3.1, 0.0], frequency=[50.0, 0.0], phase=[0.4, 0.0])
NUM_ROWS = 2048
BLUE, ORANGE, GREY = "#1f5fa8", "#d9822b", "#8a8f98"


def draw_rolling_shutter() -> Figure:
    """Exposures of the rows of two frames over time, above the displacement of the image."""
    figure = Figure(figsize=(8.4, 4.4), layout="constrained")
    rows, motion = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    starts = TIMING.frame_starts(2).tolist()
    readout = NUM_ROWS * TIMING.row_time
    for number, start in enumerate(starts):
        corners = [
            (start, 0),
            (start + TIMING.exposure_time, 0),
            (start + TIMING.exposure_time + readout, NUM_ROWS),
            (start + readout, NUM_ROWS),
        ]
        rows.add_patch(Polygon([(1e3 * t, r) for t, r in corners], facecolor=BLUE, alpha=0.25, edgecolor=BLUE))
        rows.text(1e3 * (start + 0.5 * readout) + 4, 850, f"frame {number}", color=BLUE)
    row = 1400
    times = [start + row * TIMING.row_time for start in starts]
    for time in times:
        rows.plot([1e3 * time, 1e3 * (time + TIMING.exposure_time)], [row, row], color=ORANGE, linewidth=3)
    rows.annotate(
        "", (1e3 * times[0], row + 90), (1e3 * times[1], row + 90), arrowprops={"arrowstyle": "<->", "color": GREY}
    )
    rows.text(1e3 * (times[0] + 0.32 * TIMING.frame_period), row + 260, "frame period $m\\,T_{row}$", color=GREY)
    rows.set(ylabel="row", ylim=(NUM_ROWS, 0), title="Each row is exposed at its own time")
    axis = torch.linspace(-0.002, starts[1] + readout + 0.006, 800, dtype=torch.float64)
    motion.plot(1e3 * axis, VIBRATION.displacement(axis)[:, 0], color=GREY)
    middle = torch.tensor(times, dtype=torch.float64)
    values = VIBRATION.mean_displacement(middle, TIMING.exposure_time)[:, 0]
    motion.plot(1e3 * (middle + 0.5 * TIMING.exposure_time), values, "o", color=ORANGE)
    motion.annotate(
        f"offset of row {row}: {float(values[1] - values[0]):.2f} px",
        (1e3 * float(middle[1]) + 2, float(values[1])),
        (1e3 * float(middle[1]) - 44, 3.9),
        color=ORANGE,
        arrowprops={"arrowstyle": "->", "color": ORANGE},
    )
    motion.set(xlabel="time (ms)", ylabel="displacement x (px)", ylim=(-3.6, 5.2))
    return figure


def draw_offset_curve() -> Figure:
    """Displacement of the rows of two frames, and their difference: the offset curve."""
    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    starts = TIMING.row_starts(2, NUM_ROWS)
    mean = VIBRATION.mean_displacement(starts, TIMING.exposure_time)[..., 0]
    row = torch.arange(NUM_ROWS)
    for number, colour in enumerate((BLUE, ORANGE)):
        left.plot(mean[number], row, color=colour, label=f"frame {number}")
    left.set(xlabel="mean displacement x (px)", ylabel="row", ylim=(NUM_ROWS, 0), title="Displacement of the rows")
    left.legend(loc="lower left")
    offset = mean[1] - mean[0]
    noise = 0.12 * torch.randn(NUM_ROWS // 24, generator=torch.Generator().manual_seed(1))
    right.plot(offset[::24][: len(noise)] + noise, row[::24][: len(noise)], ".", color=GREY, label="measured")
    right.plot(offset, row, color=BLUE, label="fitted model")
    right.set(xlabel="offset x (px)", title="Offset curve: frame 1 minus frame 0")
    right.legend(loc="lower left")
    return figure


def draw_blind_frequencies() -> Figure:
    """Gain from the displacement to the offset over the frequency."""
    figure = Figure(figsize=(8.4, 2.8), layout="constrained")
    axes = figure.subplots()
    highest = 300.0
    frequency = torch.linspace(0, highest, 3000, dtype=torch.float64)
    gain = 2 * torch.sin(math.pi * frequency * TIMING.frame_period) * torch.sinc(frequency * TIMING.exposure_time)
    axes.plot(frequency, gain.abs(), color=BLUE)
    blind = rsv.blind_frequencies(TIMING, highest)
    axes.plot(blind, torch.zeros_like(blind), "v", color=ORANGE, clip_on=False, label="blind frequencies")
    axes.set(xlabel="frequency (Hz)", ylabel="|offset| / |displacement|", xlim=(0, highest), ylim=(0, 2.1))
    axes.set_title("Sensitivity of a frame pair to a tone")
    axes.legend(loc="upper right")
    return figure


def draw_architecture() -> Figure:
    """Packages in layers; imports go downwards only."""
    figure = Figure(figsize=(11.0, 11.0))
    axes: Axes = figure.add_axes((0.02, 0.02, 0.96, 0.92))
    height = 1.0 / len(LAYERS)
    for number, packages in enumerate(LAYERS):
        bottom = 1.0 - (number + 1) * height
        width = 0.94 / len(packages)
        for place, (name, content) in enumerate(packages.items()):
            left = place * width
            box = FancyBboxPatch(
                (left + 0.006, bottom + 0.004),
                width - 0.012,
                height - 0.01,
                boxstyle="round,pad=0.002,rounding_size=0.008",
                facecolor="#eef3fa",
                edgecolor=BLUE,
            )
            axes.add_patch(box)
            centre = left + 0.5 * width
            text = "\n".join(textwrap.wrap(content, 150 // len(packages)))
            axes.text(centre, bottom + 0.78 * height, name, ha="center", va="center", weight="bold", color=BLUE)
            axes.text(centre, bottom + 0.36 * height, text, ha="center", va="center", fontsize=8)
    axes.annotate(
        "", (0.97, 0.03), (0.97, 0.97), arrowprops={"arrowstyle": "-|>", "color": GREY, "linewidth": 1.5}, va="center"
    )
    axes.text(0.985, 0.5, "imports", rotation=270, color=GREY, ha="center", va="center")
    axes.set(xlim=(0, 1), ylim=(0, 1), title="Packages of rsvib_torch")
    axes.axis("off")
    return figure


DRAWINGS: dict[str, Callable[[], Figure]] = {
    "rolling_shutter": draw_rolling_shutter,
    "offset_curve": draw_offset_curve,
    "blind_frequencies": draw_blind_frequencies,
    "architecture": draw_architecture,
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "drawings", help="folder (default: docs/drawings)")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    mpl.rcParams["svg.hashsalt"] = "rsvib_torch"  # identifiers that do not change from run to run
    mpl.rcParams["svg.fonttype"] = "none"  # text stays text: smaller files that can be searched
    for name, draw in DRAWINGS.items():
        draw().savefig(options.out / f"{name}.svg", metadata={"Date": None})
    print(f"{len(DRAWINGS)} drawings are in {options.out}")


if __name__ == "__main__":
    main()
