#!/usr/bin/env python
"""Figures for docs/gallery.md, each drawn from a scene, a camera and a seed given here.

``scripts/gallery.py --out docs/gallery`` draws them again. Each figure is one case; statistics are in docs/accuracy.md.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
from kornia.augmentation import AugmentationSequential
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields, resolution_chart
from rsvib_torch.report.plots import offset_figure, psf_figure, save_figure

SEED = 3
ROW_TIME, FRAME_ROWS = 20.52e-6, 2048
VIBRATION = rsv.Vibration([3.1, 5.2], [50.0, 30.0], [0.7, -1.9])  # amplitudes and frequencies of Liu et al. 2023
MARGIN = 32  # px of scene around the frame


def camera(exposure_rows: int) -> rsv.SensorTiming:
    """The camera of Liu et al. 2023 with another exposure."""
    return rsv.SensorTiming(row_time=ROW_TIME, exposure_rows=exposure_rows, frame_rows=FRAME_ROWS)


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


PICTURES: dict[str, Callable[[], Figure]] = {
    "offsets": offsets,
    "kernels": kernels,
    "ways_to_restore": ways_to_restore,
    "training_data": training_data,
}


def main() -> None:
    """Draw the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/gallery"), help="folder (default: out/gallery)")
    parser.add_argument("--only", choices=PICTURES, nargs="+", default=list(PICTURES), help="pictures to draw")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        save_figure(PICTURES[name](), options.out / f"{name}.png", dpi=90)
        print(options.out / f"{name}.png")


if __name__ == "__main__":
    main()
