#!/usr/bin/env python
"""Draw the figures of the documentation again.

Pictures (PNG) are each one case, of a scene, a camera and a seed given here; statistics are in docs/accuracy.md and
docs/benchmarks.md. Drawings (SVG) explain the method and the architecture; their curves are computed with the package.
"""

import argparse
import math
import textwrap
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from architecture import LAYERS
from benchmarks import finer, live, mosaic
from benchmarks.finer import EXPOSURE_ROWS, ROW_TIME
from benchmarks.finer import MARGIN as FINER_MARGIN
from benchmarks.independent_camera import POINTS_PER_PX, Array, decibel, still_image
from benchmarks.pipeline import camera
from benchmarks.resolution_chart import resolution_chart
from kornia.augmentation import AugmentationSequential
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Polygon, Rectangle
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.report.plots import offset_figure, psf_figure, save_figure

SEED = 3
FRAME_ROWS = 2048  # of the images
VIBRATION = rsv.Vibration([3.1, 5.2], [50.0, 30.0], [0.7, -1.9])  # amplitudes and frequencies of Liu et al. 2023
MARGIN = 32  # px of scene around the frame
COLOURS = ("#14487a", "#c8102e")
# of drawings: row time and vibration along x of Liu et al. 2023, and a longer exposure, so that it is visible
TIMING = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=200, frame_rows=2400)
ALONG_X = rsv.Vibration(amplitude=[3.1, 0.0], frequency=[50.0, 0.0], phase=[0.4, 0.0])
BLUE, ORANGE, GREY = "#1f5fa8", "#d9822b", "#8a8f98"


def taken(scene: Tensor, timing: rsv.SensorTiming, noise: float) -> Tensor:
    """Two frames of the scene."""
    return rsv.simulate_frames(
        scene,
        timing,
        VIBRATION,
        2,
        frame_size=(scene.shape[0] - 2 * MARGIN, scene.shape[1] - 2 * MARGIN),
        noise=rsv.SensorNoise(read_noise=noise),
        generator=torch.Generator().manual_seed(SEED),
    )


def offsets() -> Figure:
    """Measured offsets of rows between two frames, and the vibration fitted to them."""
    timing = camera(20)
    frames = taken(city_and_fields(FRAME_ROWS + 2 * MARGIN, 512 + 2 * MARGIN, SEED), timing, 0.005)
    return offset_figure(rsv.detect_vibration(frames, timing))


def kernels() -> Figure:
    """Point spread functions of rows that are exposed for 8.2 ms."""
    return psf_figure(VIBRATION, camera(400), FRAME_ROWS)


def ways_to_restore() -> Figure:
    """One crop of a long exposure: input, and restored by four methods."""
    timing, size = camera(400), 640
    scene = resolution_chart(size + 2 * MARGIN, size + 2 * MARGIN, seed=SEED)
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
    frames = taken(scene, timing, 0.01)
    shown = {"input": frames[0]}
    for name, options in {
        'method="dewarp"': {"method": "dewarp"},
        'method="exact"': {},
        "exact, two frames jointly": {"joint": True},
        'jointly, prior="edges"': {"joint": True, "prior": "edges"},
    }.items():
        shown[name] = rsv.restore(frames, timing, VIBRATION, check=False, **options)[0]
    shown["still camera, no noise"] = still
    figure = Figure(figsize=(11.4, 7.9), layout="constrained")
    crop = (slice(200, 360), slice(240, 400))
    for panel, (name, image) in zip(figure.subplots(2, 3).flatten(), shown.items(), strict=True):
        panel.imshow(image[crop].numpy(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        quality = rsv.psnr(image, still, 1.0, rim=MARGIN)
        panel.set_title(name + (f": {quality:.1f} dB" if image is not still else ""), fontsize=10, loc="left")
        panel.set_axis_off()
    return figure


def training_data() -> Figure:
    """One image with four random vibrations, with a box and keypoints that are displaced with it."""
    scene = resolution_chart(256, 256, seed=SEED).expand(4, 1, 256, 256)
    points = torch.tensor([[64.0, 64.0], [192.0, 64.0], [64.0, 192.0], [192.0, 192.0]]).expand(4, 4, 2)
    boxes = torch.tensor([[[96.0, 96.0, 160.0, 160.0]]]).expand(4, 1, 4)
    timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
    shake = rsv.RollingShutterVibration(timing, amplitude=(2.0, 8.0), frequency=((60, 300), (40, 200)), p=1.0)
    torch.manual_seed(SEED)
    chain = AugmentationSequential(shake, data_keys=["input", "keypoints", "bbox_xyxy"])
    images, moved, frames = chain(scene, points, boxes)
    figure = Figure(figsize=(11.4, 3.1), layout="constrained")
    for index, panel in enumerate(figure.subplots(1, 4)):
        panel.imshow(images[index, 0].numpy(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        panel.plot(*points[index].T.numpy(), "o", color="#14487a", markersize=4, fillstyle="none")
        panel.plot(*moved[index].T.numpy(), "x", color="#c8102e", markersize=5)
        left, top, right, bottom = frames[index].flatten().tolist()
        panel.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, color="#c8102e"))
        panel.set_axis_off()
    return figure


def side_by_side(images: dict[str, Array], height: float) -> Figure:
    """Images in a row, grey (H, W) or coloured (3, H, W), with their names."""
    figure = Figure(figsize=(12, height), layout="constrained")
    for panel, (name, image) in zip(figure.subplots(1, len(images)), images.items(), strict=True):
        grey = image.ndim == 2
        shown = image if grey else np.moveaxis(image.clip(0, 1) ** (1 / 2.2), 0, -1)
        panel.imshow(shown, cmap="gray", vmin=0.1, vmax=0.9, interpolation="nearest")
        panel.set_axis_off()
        panel.set_title(name, fontsize=9)
    return figure


def wedge_scene(size: int) -> Array:
    """A city with a wedge of lines that converge from 0.35 to 0.85 cycles per px."""
    side = POINTS_PER_PX * (size + 2 * FINER_MARGIN)
    scene = city_and_fields(side, side, seed=3).double().numpy()
    row, column = np.meshgrid(np.arange(side), np.arange(side) - side / 2, indexing="ij")
    progress = (row - side / 2 + 160) / 320
    cycles = 0.35 + 0.5 * progress.clip(0, 1)
    lines = 0.5 + 0.35 * np.cos(2 * np.pi * cycles / POINTS_PER_PX * column)
    inside = (progress >= 0) & (progress < 1) & (np.abs(column) < 220 * 0.35 / cycles)
    return np.where(inside, lines, scene)


def finer_grid() -> Figure:
    """A wedge beyond the Nyquist frequency of the pixels, from frames of a camera at rest and of a vibrating camera."""
    side, noise, count = 160, 0.002, 8
    recording = finer.record(wedge_scene(side), 0.3, side)
    frames = recording.noisy(noise)
    images = {
        "one still frame, interpolated": recording.still(noise, 1),
        f"mean of {count} still frames, interpolated": recording.still(noise, count),
        f"{count} vibrating frames, scale=2": finer.joint(
            frames, recording.timing, rsv.detect_vibration(frames, recording.timing), scale=2
        ),
    }
    images = {f"{name}\n{decibel(image, recording.half, finer.RIM):.1f} dB": image for name, image in images.items()}
    images["scene after optics and pixel"] = recording.half
    return side_by_side({name: image[60:-60, 90:-90] for name, image in images.items()}, 4.2)


def colour_mosaic() -> Figure:
    """A part of a colour scene, from raw frames that are demosaiced one by one and together."""
    side, noise, count = 128, 0.003, 8
    timing = rsv.SensorTiming(ROW_TIME, EXPOSURE_ROWS, 2 * side + 59)
    scene, clean = mosaic.raw_frames("astronaut", timing, count, side)
    raw = clean + noise * np.random.default_rng(1).standard_normal(clean.shape)
    frames = torch.from_numpy(raw).float()
    detection = rsv.detect_vibration(frames, timing)
    demosaiced = torch.from_numpy(mosaic.opencv(raw)).float()
    truth = np.stack([still_image(part, (side, side)) for part in scene])
    together = {
        f"{count} frames, OpenCV, then joint=True": rsv.restore(demosaiced, timing, detection, joint=True)[0],
        f"{count} frames, mosaic={mosaic.PATTERN!r}": rsv.restore(
            frames, timing, detection, joint=True, mosaic=mosaic.PATTERN
        )[0],
    }
    images = {
        "one frame, OpenCV": demosaiced[0].numpy(),
        **{f"{name}\n{decibel(i, truth, mosaic.RIM):.1f} dB": i.numpy() for name, i in together.items()},
        "scene after optics and pixel": truth,
    }
    return side_by_side({name: image[:, 24:-24, 24:-24] for name, image in images.items()}, 3.7)


def tracking() -> Figure:
    """Errors of a tone that sweeps and grows, as the tracker follows it."""
    size, count, motion = 256, 90, live.Changing(sweep=2.0, doublings=0.5)
    timing = live.timing_of(size)
    middle = 0.5 * (size - 1 + live.EXPOSURE_ROWS) * timing.row_time
    tracked = map(rsv.VibrationTracker(timing).update, live.frames_of(size, motion, count))
    found = [one for one in tracked if one.detection is not None]
    when = np.array([one.time for one in found]) + middle
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panels = figure.subplots(1, 2)
    quantities = (("frequency", "Hz", 0.25, motion.frequency(when)), ("amplitude", "px", 0.12, motion.amplitude(when)))
    for panel, (name, unit, limit, truth) in zip(panels, quantities, strict=True):
        values, stds = (
            np.stack([getattr(getattr(one.detection, kind), name)[:, 0] for one in found])
            for kind in ("vibration", "std")
        )
        for axis, colour in enumerate(COLOURS):
            panel.plot(when, (values - truth)[:, axis], color=colour, label="xy"[axis])
            reach = 2 * stds[:, axis]
            panel.fill_between(when, -reach, reach, color=colour, alpha=0.15, linewidth=0)
        panel.set(xlabel="time (s)", ylabel=f"error of the {name} ({unit})", ylim=(-limit, limit))
        panel.axvline(live.BEFORE, color="#d9d9d9", linewidth=1, zorder=0)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False)
    figure.suptitle(
        f"{live.FREQUENCY[0]:.0f} Hz along x, swept by {motion.sweep:g} Hz/s and grown by "
        f"{100 * (2**motion.doublings - 1):.0f} % per second from {live.BEFORE} s on; {live.RATE} frames/s",
        fontsize=10,
    )
    return figure


def rolling_shutter() -> Figure:
    """Exposures of the rows of two frames over time, above the displacement of the image."""
    figure = Figure(figsize=(8.4, 4.4), layout="constrained")
    rows, motion = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    starts = TIMING.frame_starts(2).tolist()
    readout = FRAME_ROWS * TIMING.row_time
    for number, start in enumerate(starts):
        corners = [
            (start, 0),
            (start + TIMING.exposure_time, 0),
            (start + TIMING.exposure_time + readout, FRAME_ROWS),
            (start + readout, FRAME_ROWS),
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
    rows.set(ylabel="row", ylim=(FRAME_ROWS, 0), title="Each row is exposed at its own time")
    axis = torch.linspace(-0.002, starts[1] + readout + 0.006, 800, dtype=torch.float64)
    motion.plot(1e3 * axis, ALONG_X.displacement(axis)[:, 0], color=GREY)
    middle = torch.tensor(times, dtype=torch.float64)
    values = ALONG_X.mean_displacement(middle, TIMING.exposure_time)[:, 0]
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


def offset_curve() -> Figure:
    """Displacement of the rows of two frames, and their difference: the offset curve."""
    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    starts = TIMING.row_starts(2, FRAME_ROWS)
    mean = ALONG_X.mean_displacement(starts, TIMING.exposure_time)[..., 0]
    row = torch.arange(FRAME_ROWS)
    for number, colour in enumerate((BLUE, ORANGE)):
        left.plot(mean[number], row, color=colour, label=f"frame {number}")
    left.set(xlabel="mean displacement x (px)", ylabel="row", ylim=(FRAME_ROWS, 0), title="Displacement of the rows")
    left.legend(loc="lower left")
    offset = mean[1] - mean[0]
    noise = 0.12 * torch.randn(FRAME_ROWS // 24, generator=torch.Generator().manual_seed(1))
    right.plot(offset[::24][: len(noise)] + noise, row[::24][: len(noise)], ".", color=GREY, label="measured")
    right.plot(offset, row, color=BLUE, label="fitted model")
    right.set(xlabel="offset x (px)", title="Offset curve: frame 1 minus frame 0")
    right.legend(loc="lower left")
    return figure


def blind_frequencies() -> Figure:
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


def architecture() -> Figure:
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


PICTURES: dict[str, Callable[[], Figure]] = {  # by the path in docs/
    "gallery/offsets": offsets,
    "gallery/kernels": kernels,
    "gallery/ways_to_restore": ways_to_restore,
    "gallery/training_data": training_data,
    "finer_grid": finer_grid,
    "mosaic": colour_mosaic,
    "live": tracking,
    "drawings/rolling_shutter": rolling_shutter,
    "drawings/offset_curve": offset_curve,
    "drawings/blind_frequencies": blind_frequencies,
    "drawings/architecture": architecture,
}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/figures"), help="folder (default: out/figures)")
    parser.add_argument("--only", choices=PICTURES, nargs="+", default=list(PICTURES), help="figures to draw")
    parser.add_argument("--drawings", action="store_true", help="the drawings only")
    options = parser.parse_args(arguments)
    names = [name for name in options.only if name.startswith("drawings/") or not options.drawings]
    mpl.rcParams["svg.hashsalt"] = "rsvib_torch"  # identifiers that do not change from run to run
    mpl.rcParams["svg.fonttype"] = "none"  # text stays text: smaller files that can be searched
    for name in names:
        is_drawing = name.startswith("drawings/")
        path = options.out / f"{name}.{'svg' if is_drawing else 'png'}"
        path.parent.mkdir(parents=True, exist_ok=True)
        if is_drawing:
            PICTURES[name]().savefig(path, metadata={"Date": None})
        else:
            save_figure(PICTURES[name](), path, dpi=90 if "/" in name else 105)
        print(path)


if __name__ == "__main__":
    main()
