#!/usr/bin/env python
"""Draw docs/mosaic.png: a part of a colour scene, from raw frames that are demosaiced one by one and together."""

from pathlib import Path

import numpy as np
import torch
from benchmarks.finer import EXPOSURE_ROWS, FADE, MARGIN, ROW_TIME, SHAKE, decibel
from benchmarks.finer_camera import BETWEEN, FINER, after_optics, mosaic_of, still_image
from benchmarks.independent_camera import closed, take_frames
from benchmarks.mosaic import PATTERN, RIM, SIGMA, colour_scene, opencv
from matplotlib import pyplot as plt

import rsvib_torch as rsv

SIZE, NOISE, COUNT = 128, 0.003, 8
FIGURE = Path(__file__).parents[1] / "docs" / "mosaic.png"


def main() -> None:
    size = (SIZE, SIZE)
    whole = colour_scene("astronaut", FINER * (SIZE + 2 * MARGIN))
    scene = [after_optics(closed(part, FADE), SIGMA) for part in whole]
    timing = rsv.SensorTiming(ROW_TIME, EXPOSURE_ROWS, 2 * SIZE + 59)
    camera = {"row_time": ROW_TIME, "exposure_rows": EXPOSURE_ROWS, "frame_rows": timing.frame_rows}
    taken = [
        take_frames(part, SHAKE, **camera, num_frames=COUNT, size=size, points=FINER, between=BETWEEN) for part in scene
    ]
    raw = mosaic_of(np.stack(taken, 1), PATTERN)
    raw = raw + NOISE * np.random.default_rng(1).standard_normal(raw.shape)
    frames = torch.from_numpy(raw).float()
    detection = rsv.detect_vibration(frames, timing)
    each = torch.from_numpy(opencv(raw)).float()
    images = {
        "one frame, OpenCV": each[0],
        f"{COUNT} frames, OpenCV, then joint=True": rsv.restore(each, timing, detection, joint=True)[0],
        f"{COUNT} frames, mosaic={PATTERN!r}": rsv.restore(frames, timing, detection, joint=True, mosaic=PATTERN)[0],
        "scene after optics and pixel": torch.from_numpy(np.stack([still_image(part, size) for part in scene])),
    }
    truth = list(images.values())[-1].numpy()
    figure, axes = plt.subplots(1, len(images), figsize=(12, 3.7), layout="constrained")
    for number, (axis, (name, image)) in enumerate(zip(axes, images.items(), strict=True)):
        part = image.numpy()[:, 24:-24, 24:-24].clip(0, 1) ** (1 / 2.2)
        axis.imshow(np.moveaxis(part, 0, -1), interpolation="nearest")
        axis.set_axis_off()
        known = 0 < number < len(images) - 1
        axis.set_title(f"{name}\n{decibel(image, truth, RIM):.1f} dB" if known else name, fontsize=9)
    figure.savefig(FIGURE, dpi=110)


if __name__ == "__main__":
    main()
