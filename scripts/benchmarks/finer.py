"""Joint restoration on a grid of half pixels, compared with still frames and with the grid of pixels.

Frames come from a camera that aliases and is made without the package, see ``finer_camera``. The vibration is detected
in the frames.
"""

import argparse
import warnings
from typing import Any

import numpy as np
import torch
from benchmarks.finer_camera import BETWEEN, FINER, after_optics, still_image
from benchmarks.independent_camera import Array, Shake, closed, take_frames
from benchmarks.measure import one_thread
from benchmarks.restoration import SCENES
from scipy import ndimage

import rsvib_torch as rsv

ROW_TIME, EXPOSURE_ROWS, MARGIN, FADE, RIM, SEED = 20.52e-6, 20, 32, 60, 24, 1
OPTICS = (0.3, 0.5)
NOISES = (0.002, 0.005, 0.02)
FRAMES = (2, 4, 8)
SHAKE = Shake(np.array([[3.1], [5.2]]), np.array([[90.0], [61.0]]), np.array([[0.4], [1.3]]), np.zeros(2))


def decibel(image: Array, truth: Array, rim: int = RIM) -> float:
    """PSNR in dB for full scale 1, without a rim."""
    error = (np.asarray(image, dtype=np.float64) - truth)[..., rim:-rim, rim:-rim]
    return float(-10 * np.log10(np.mean(error**2)))


def interpolated(image: Array) -> Array:
    """An image at half pixels, by a quintic spline."""
    rows, columns = (np.arange(2 * size) / 2 for size in image.shape)
    return ndimage.map_coordinates(image, np.meshgrid(rows, columns, indexing="ij"), order=5, mode="mirror")


def cases(name: str, options: argparse.Namespace, sigma: float) -> list[dict[str, Any]]:
    """Figures of one scene behind optics of one width, for all noise levels and numbers of frames."""
    side, size = FINER * (options.finer_size + 2 * MARGIN), (options.finer_size, options.finer_size)
    scene = after_optics(closed(SCENES[name](side, side, 3).double().numpy(), FADE), sigma)
    half, pixels = still_image(scene, size, 2), still_image(scene, size)
    timing = rsv.SensorTiming(ROW_TIME, EXPOSURE_ROWS, 2 * options.finer_size + 59)
    clean = take_frames(
        scene,
        SHAKE,
        row_time=ROW_TIME,
        exposure_rows=EXPOSURE_ROWS,
        frame_rows=timing.frame_rows,
        num_frames=max(FRAMES),
        size=size,
        points=FINER,
        between=BETWEEN,
    )
    found = []
    for noise in NOISES:
        generator = np.random.default_rng(SEED)
        taken = torch.from_numpy(clean + noise * generator.standard_normal(clean.shape)).float()
        still = pixels + noise * generator.standard_normal(clean.shape)
        detection = rsv.detect_vibration(taken, timing)
        for count in FRAMES:
            frames = taken[:count]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", rsv.RestorationWarning)
                joint = rsv.restore(frames, timing, detection, joint=True, check=False)[0].double().numpy()
                finer = rsv.restore(frames, timing, detection, joint=True, check=False, scale=2)[0].double().numpy()
            found.append(
                {
                    "scene": name,
                    "sigma": sigma,
                    "noise": noise,
                    "frames": count,
                    "still": decibel(interpolated(still[:count].mean(0)), half),
                    "endless": decibel(interpolated(pixels), half),
                    "joint": decibel(interpolated(joint), half),
                    "finer": decibel(finer, half),
                    "joint_pixels": decibel(joint, pixels),
                    "finer_pixels": decibel(finer[::2, ::2], pixels),
                }
            )
    return found


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this section."""
    parser.add_argument("--finer-size", type=int, default=256, help="rows and columns of the frames of section finer")


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """PSNR on half pixels and on pixels, for all scenes, optics, noise levels and numbers of frames."""
    with one_thread():
        return [row for name in options.scenes for sigma in OPTICS for row in cases(name, options, sigma)]


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """A table of the figures."""
    text = [
        f"PSNR in dB against the noise-free scene after optics and pixel, without a border of {RIM} points; frames of "
        f"{options.finer_size} x {options.finer_size} px, exposure of {EXPOSURE_ROWS} rows, vibration detected in all "
        f"{max(FRAMES)} frames. Still frames are averaged and interpolated; in brackets, infinitely many of them.",
        "",
        "| scene | σ of the optics (px) | noise | frames | half pixels: still frames | `joint=True`, interpolated | "
        "`joint=True, scale=2` | pixels: `joint=True` | `joint=True, scale=2` |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    text += [
        f"| {row['scene']} | {row['sigma']} | {row['noise']} | {row['frames']} | {row['still']:.1f} "
        f"({row['endless']:.1f}) | {row['joint']:.1f} | **{row['finer']:.1f}** | {row['joint_pixels']:.1f} | "
        f"**{row['finer_pixels']:.1f}** |"
        for row in results
    ]
    return text
