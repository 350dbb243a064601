#!/usr/bin/env python
"""Draw docs/finer_grid.png: a wedge beyond the pixel Nyquist frequency, from still and from vibrating frames."""

from pathlib import Path

import numpy as np
import torch
from benchmarks.finer import EXPOSURE_ROWS, FADE, MARGIN, ROW_TIME, SHAKE, decibel, interpolated
from benchmarks.finer_camera import BETWEEN, FINER, after_optics, still_image
from benchmarks.independent_camera import Array, closed, take_frames
from matplotlib import pyplot as plt

import rsvib_torch as rsv
from rsvib_torch.evaluation.scenes import city_and_fields

SIZE, NOISE, COUNT = 160, 0.002, 8
FIGURE = Path(__file__).parents[1] / "docs" / "finer_grid.png"


def wedge_scene() -> Array:
    """A city with a wedge of lines that converge from 0.35 to 0.85 cycles per px."""
    side = FINER * (SIZE + 2 * MARGIN)
    scene = closed(city_and_fields(side, side, seed=3).double().numpy(), FADE)
    row, column = np.meshgrid(np.arange(side), np.arange(side) - side / 2, indexing="ij")
    progress = (row - side / 2 + 160) / 320
    cycles = 0.35 + 0.5 * progress.clip(0, 1)
    lines = 0.5 + 0.35 * np.cos(2 * np.pi * cycles / FINER * column)
    inside = (progress >= 0) & (progress < 1) & (np.abs(column) < 220 * 0.35 / cycles)
    return np.where(inside, lines, scene)


def main() -> None:
    size = (SIZE, SIZE)
    scene = after_optics(wedge_scene(), 0.3)
    timing = rsv.SensorTiming(ROW_TIME, EXPOSURE_ROWS, 2 * SIZE + 59)
    clean = take_frames(
        scene,
        SHAKE,
        row_time=ROW_TIME,
        exposure_rows=EXPOSURE_ROWS,
        frame_rows=timing.frame_rows,
        num_frames=COUNT,
        size=size,
        points=FINER,
        between=BETWEEN,
    )
    generator = np.random.default_rng(1)
    frames = torch.from_numpy(clean + NOISE * generator.standard_normal(clean.shape)).float()
    still = still_image(scene, size) + NOISE * generator.standard_normal(clean.shape)
    restored = rsv.restore(frames, timing, rsv.detect_vibration(frames, timing), joint=True, scale=2)[0].numpy()
    truth = still_image(scene, size, 2)
    images = {
        "one still frame, interpolated": interpolated(still[0]),
        f"mean of {COUNT} still frames, interpolated": interpolated(still.mean(0)),
        f"{COUNT} vibrating frames, scale=2": restored,
        "scene after optics and pixel": truth,
    }
    figure, axes = plt.subplots(1, len(images), figsize=(12, 4.2), layout="constrained")
    for axis, (name, image) in zip(axes, images.items(), strict=True):
        axis.imshow(image[60:-60, 90:-90], cmap="gray", vmin=0.1, vmax=0.9, interpolation="nearest")
        axis.set_axis_off()
        axis.set_title(name if image is truth else f"{name}\n{decibel(image, truth):.1f} dB", fontsize=9)
    figure.savefig(FIGURE, dpi=110)


if __name__ == "__main__":
    main()
