"""Colour mosaics restored jointly, compared with demosaicing each frame before restoration.

Frames come from the camera of ``independent_camera``, behind colour filters. The vibration is detected in the raw
frames.
"""

import argparse
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from benchmarks.finer import EXPOSURE_ROWS, FADE, MARGIN, ROW_TIME, SEED, SHAKE
from benchmarks.independent_camera import (
    POINTS_PER_PX,
    Array,
    after_optics,
    closed,
    decibel,
    mosaic_of,
    still_image,
    take_frames,
)
from harness import Rows, table
from skimage import data

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

OPTIONS = {
    "mosaic_size": (160, "mosaic: rows and columns of the frames"),
    "mosaic_scenes": (("drawn", "astronaut", "coffee"), "mosaic: a drawing and photographs of scikit-image"),
}
QUICK = {"mosaic_size": 96, "mosaic_scenes": ("drawn",)}
SIGMA, PATTERN, RIM = 0.4, "RGGB", 12
NOISES = (0.002, 0.005, 0.01)
FRAMES = (1, 8)
Demosaicing = Callable[[Array], Array]


def colour_scene(name: str, side: int) -> Array:
    """Red, green and blue (3, side, side), linear in light: a photograph of half the resolution, or a drawing."""
    if name != "drawn":
        image = (getattr(data, name)()[..., :3] / 255.0) ** 2.2
        top, left = ((size - side // 2) // 2 for size in image.shape[:2])
        rows, columns = (max(0, -place) for place in (top, left))
        image = np.pad(image, ((rows, rows + 1), (columns, columns + 1), (0, 0)), mode="symmetric")
        part = image[max(top, 0) :, max(left, 0) :][: side // 2, : side // 2]
        return np.moveaxis(cv2.resize(part, (side, side), interpolation=cv2.INTER_CUBIC), -1, 0)
    grey, first, second = (city_and_fields(side, side, seed=seed).double().numpy() for seed in (3, 4, 5))
    first, second = first - first.mean(), second - second.mean()
    return np.stack([grey + 0.3 * first, grey - 0.15 * first + 0.1 * second, grey - 0.25 * second])


def opencv(raw: Array) -> Array:
    """Edge-aware demosaicing of OpenCV."""
    low, scale = float(raw.min()), 60000 / float(raw.max() - raw.min())
    counts = ((raw - low) * scale).round().astype(np.uint16)
    images = [cv2.cvtColor(frame, cv2.COLOR_BayerRGGB2RGB_EA) for frame in counts]
    return np.moveaxis(np.stack(images), -1, 1) / scale + low


def peers() -> dict[str, Demosaicing]:
    """Demosaicing of raw frames (T, H, W) with the pattern RGGB, by the name of the software that is installed."""
    found: dict[str, Demosaicing] = {"OpenCV": opencv}
    with suppress(ImportError):
        from colour_demosaicing import demosaicing_CFA_Bayer_Menon2007 as menon  # noqa: PLC0415

        found["Menon"] = lambda raw: np.stack([np.moveaxis(menon(frame, PATTERN), -1, 0) for frame in raw])
    with suppress(ImportError):
        from demosaicnet import BayerDemosaick  # noqa: PLC0415

        found["demosaicnet"] = partial(network, BayerDemosaick().eval())
    return found


@torch.no_grad()
def network(net: torch.nn.Module, raw: Array, rim: int = 32) -> Array:
    """Demosaicing by a network for the pattern GRBG, which is RGGB with the columns reversed."""
    wide = np.pad(raw[..., ::-1], ((0, 0), (rim, rim), (rim, rim)), mode="reflect")
    colours = np.zeros((len(wide), 3, *wide.shape[-2:]))
    for place, colour in enumerate("GRBG"):
        part = (slice(place // 2, None, 2), slice(place % 2, None, 2))
        colours[:, "RGB".index(colour), *part] = wide[:, *part]
    images = np.concatenate([net(torch.from_numpy(frame[None]).float()).numpy() for frame in colours])
    cut = (images.shape[-1] - raw.shape[-1]) // 2
    return images[..., cut : cut + raw.shape[-2], cut : cut + raw.shape[-1]][..., ::-1].copy()


def raw_frames(name: str, timing: rsv.SensorTiming, count: int, side: int) -> tuple[list[Array], Array]:
    """The colours of a scene after the optics, and its raw frames (T, side, side) without noise."""
    whole = colour_scene(name, POINTS_PER_PX * (side + 2 * MARGIN))
    scene = [after_optics(closed(part, FADE), SIGMA) for part in whole]
    taken = [take_frames(part, SHAKE, timing, count, (side, side), points=POINTS_PER_PX) for part in scene]
    return scene, mosaic_of(np.stack(taken, 1), PATTERN)


def cases(name: str, side: int) -> Rows:
    """Figures of one scene for all noise levels and numbers of frames."""
    size = (side, side)
    timing = rsv.SensorTiming(ROW_TIME, EXPOSURE_ROWS, 2 * side + 59)
    scene, clean = raw_frames(name, timing, max(FRAMES), side)
    pixels, half = (np.stack([still_image(part, size, scale) for part in scene]) for scale in (1, 2))
    found = []
    for noise in NOISES:
        raw = clean + noise * np.random.default_rng(SEED).standard_normal(clean.shape)
        detection = rsv.detect_vibration(torch.from_numpy(raw).float(), timing)
        coloured = {peer: torch.from_numpy(demosaic(raw)).float() for peer, demosaic in peers().items()}
        for count in FRAMES:
            options: dict[str, Any] = {"joint": True, "check": False}
            row: dict[str, Any] = {"scene": name, "noise": noise, "frames": count, "peers": {}, "peers_half": {}}
            for peer, frames in coloured.items():
                image = rsv.restore(frames[:count], timing, detection, **options)[0]
                row["peers"][peer] = decibel(image, pixels, RIM)
                image = rsv.restore(frames[:count], timing, detection, scale=2, **options)[0]
                row["peers_half"][peer] = decibel(image, half, 2 * RIM)
            frames = torch.from_numpy(raw[:count]).float()
            image = rsv.restore(frames, timing, detection, scale=2, mosaic=PATTERN, **options)[0].numpy()
            row["mosaic"], row["mosaic_half"] = decibel(image[:, ::2, ::2], pixels, RIM), decibel(image, half, 2 * RIM)
            found.append(row)
    return found


def rows(options: argparse.Namespace) -> Rows:
    return [row for name in options.mosaic_scenes for row in cases(name, options.mosaic_size)]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    names = list(results[0]["peers"])
    text = [
        f"PSNR in dB of all three colours against the noise-free scene after optics and pixel, without a border of "
        f"{RIM} px; frames of {options.mosaic_size} x {options.mosaic_size} px behind a {PATTERN} mosaic, optics of "
        f"σ = {SIGMA} px, exposure of {EXPOSURE_ROWS} rows, vibration detected in all {max(FRAMES)} raw frames. Other "
        "software interpolates the colours of each frame, and `restore(joint=True)` follows: on pixels / with "
        "`scale=2` on half pixels. Scenes: a drawing, and two photographs of scikit-image.",
        "",
    ]
    cells = []
    for row in results:
        others = [f"{row['peers'][name]:.1f} / {row['peers_half'][name]:.1f}" for name in names]
        ours = f"**{row['mosaic']:.1f}** / **{row['mosaic_half']:.1f}**"
        cells.append((row["scene"], row["noise"], row["frames"], *others, ours))
    return text + table(("scene", "noise", "frames", *names, "`restore(joint=True, mosaic=...)`"), cells)
