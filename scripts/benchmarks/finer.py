"""Joint restoration on a grid of half pixels, compared with still frames, other software and the grid of pixels.

Other software is drizzle, and shift-and-add: both put every pixel where it was on the scene, the mean displacement of
its row, with the best of several parameters. Frames come from cameras that alias and are made without the package, see
``independent_camera``, and for roll ``honesty_camera``. The vibration is detected in the frames of the first table, and
given in those of the second.
"""

import argparse
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from benchmarks import honesty_camera
from benchmarks.honesty_cases import moving, wave
from benchmarks.independent_camera import (
    POINTS_PER_PX,
    Array,
    Shake,
    after_optics,
    closed,
    decibel,
    still_image,
    take_frames,
)
from benchmarks.resolution_chart import SCENES
from harness import Rows, table_of
from scipy import ndimage

import rsvib_torch as rsv

try:
    from drizzle.resample import Drizzle
except ImportError:  # extra ``compare``
    Drizzle = None

OPTIONS = {
    "scenes": (tuple(SCENES), "drawn scenes to compare on", SCENES),
    "finer_size": (256, "finer: rows and columns of the frames"),
    "finer_noises": ((0.002, 0.005, 0.02), "finer: noise levels of full scale"),
}
QUICK = {"scenes": ("city",), "finer_size": 128, "finer_noises": (0.005,)}
ROW_TIME, EXPOSURE_ROWS, MARGIN, FADE, RIM, SEED = 20.52e-6, 20, 32, 60, 24, 1
OPTICS = (0.3, 0.5)
FRAMES = (2, 4, 8)
SHAKE = Shake(np.array([[3.1], [5.2]]), np.array([[90.0], [61.0]]), np.array([[0.4], [1.3]]), np.zeros(2))
WIDTHS = (0.3, 0.5, 0.7, 1.0)  # of the Gaussian of shift-and-add, points of the half-pixel grid
FRACTIONS = (0.4, 0.6, 0.8, 1.0)  # sizes of the drops of drizzle


def interpolated(image: Array) -> Array:
    """An image at half pixels, by a quintic spline."""
    rows, columns = (np.arange(2 * size) / 2 for size in image.shape)
    return ndimage.map_coordinates(image, np.meshgrid(rows, columns, indexing="ij"), order=5, mode="mirror")


def joint(frames: torch.Tensor, timing: rsv.SensorTiming, motion: Any, scale: int = 1, **options: Any) -> Array:
    """All frames restored jointly."""
    restored = rsv.restore(frames, timing, motion, joint=True, scale=scale, check=False, **options)
    return np.asarray(restored[0].double())


@dataclass(frozen=True)
class Recording:
    """Frames without noise, and the scene after optics and pixel on half pixels and on pixels."""

    frames: Array  # (T, H, W)
    half: Array  # (2 H, 2 W)
    timing: rsv.SensorTiming  # the sensor
    vibration: rsv.Vibration  # the true motion

    @property
    def pixels(self) -> Array:
        """The scene on pixels."""
        return self.half[::2, ::2]

    def noisy(self, noise: float) -> torch.Tensor:
        """Frames with white noise."""
        generator = np.random.default_rng(SEED)
        return torch.from_numpy(self.frames + noise * generator.standard_normal(self.frames.shape)).float()

    def still(self, noise: float, count: int) -> Array:
        """Mean of as many still frames, interpolated."""
        generator = np.random.default_rng(SEED + 1)
        taken = self.pixels + noise * generator.standard_normal((count, *self.pixels.shape))
        return interpolated(taken.mean(0))


def record(
    fine: Array, sigma: float, size: int, *, exposure: int = EXPOSURE_ROWS, image_motion: float = 0.0
) -> Recording:
    """Frames of a scene behind optics of a width, and the truth at the place of the middle frame."""
    scene, shape = after_optics(closed(fine, FADE), sigma), (size, size)
    timing = rsv.SensorTiming(ROW_TIME, exposure, max(2 * size + 59, exposure + 59))
    shake = replace(SHAKE, image_motion=np.array([image_motion, 0.0]))
    frames = take_frames(scene, shake, timing, max(FRAMES), shape, points=POINTS_PER_PX)
    vibration = rsv.Vibration(
        *(torch.from_numpy(v) for v in (SHAKE.amplitude, SHAKE.frequency, SHAKE.phase)), shake.image_motion
    )
    _, shift = rsv.visible_pixels(timing, vibration, shape, max(FRAMES))
    offset = (0, POINTS_PER_PX * int(shift[max(FRAMES) // 2, 0]))
    return Recording(frames, still_image(scene, shape, 2, offset), timing, vibration)


def rolling(fine: Array, size: int, roll: float) -> Recording:
    """Frames of a camera that also rolls."""
    tones = np.array([[3.1, 90.0, 0.4], [5.2, 61.0, 1.3], [roll, 70.0, 2.0]])
    motion = moving(partial(wave, tones[:1]), partial(wave, tones[1:2]), tones[2:])
    layers = [honesty_camera.layer(fine)]
    timing = rsv.SensorTiming(ROW_TIME, EXPOSURE_ROWS, 2 * size + 59)
    starts = np.arange(max(FRAMES))[:, None] * timing.frame_period + np.arange(size) * ROW_TIME
    frames = honesty_camera.take_frames(layers, motion, starts, timing.exposure_time, size)
    half = np.empty((2 * size, 2 * size))
    for down in (0, 1):
        for right in (0, 1):
            standing = honesty_camera.standing(-0.5 * right, -0.5 * down)
            half[down::2, right::2] = honesty_camera.take_frames(layers, standing, starts[:1], 1e-9, size)[0]
    return Recording(frames, half, timing, rsv.Vibration(*tones.T))


def places(frames: torch.Tensor, timing: rsv.SensorTiming, vibration: rsv.Vibration) -> tuple[Array, Array]:
    """Columns and rows (T, H, W) of all pixels on the half-pixel grid of the scene."""
    count, height, width = frames.shape
    starts = np.arange(count)[:, None] * timing.frame_period + np.arange(height) * timing.row_time
    moved = vibration.mean_displacement(torch.from_numpy(starts), timing.exposure_time).numpy()
    columns = np.arange(width) - moved[..., 0, None]
    rows = np.broadcast_to((np.arange(height) - moved[..., 1])[..., None], columns.shape)
    return 2 * columns, 2 * rows


def _filled(total: Array, weight: Array, sigma: float) -> Array:
    """Weighted mean with a Gaussian; points without data from their neighbourhood."""
    image, known = np.zeros_like(total), np.zeros(total.shape, dtype=bool)
    for width in (sigma, 1.0, 2.0, 4.0, 8.0):
        smooth = ndimage.gaussian_filter(weight, width)
        found = ~known & (smooth > 1e-3)
        image[found] = ndimage.gaussian_filter(total, width)[found] / smooth[found]
        known |= found
    return image


def shift_and_add(frames: torch.Tensor, timing: rsv.SensorTiming, vibration: rsv.Vibration) -> Iterator[Array]:
    """Images of several widths: bilinear shares of all pixels, added and divided by their sum."""
    columns, rows = places(frames, timing, vibration)
    shape = 2 * frames.shape[-2], 2 * frames.shape[-1]
    total, weight, values = np.zeros(shape), np.zeros(shape), frames.double().numpy()
    for down in (0, 1):
        for right in (0, 1):
            i, j = np.floor(rows).astype(int) + down, np.floor(columns).astype(int) + right
            share = (1 - np.abs(rows - i)) * (1 - np.abs(columns - j))
            inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
            np.add.at(total, (i[inside], j[inside]), (share * values)[inside])
            np.add.at(weight, (i[inside], j[inside]), share[inside])
    for width in WIDTHS:
        yield _filled(total, weight, width)


def drizzled(frames: torch.Tensor, timing: rsv.SensorTiming, vibration: rsv.Vibration) -> Iterator[Array]:
    """Images of drizzle for several sizes of the drops; none if it is not installed."""
    if Drizzle is None:
        return
    columns, rows = places(frames, timing, vibration)
    shape = 2 * frames.shape[-2], 2 * frames.shape[-1]
    for fraction in FRACTIONS:
        drops = Drizzle(kernel="square", out_shape=shape, fillval="0")
        for frame, column, row in zip(frames.numpy(), columns, rows, strict=True):
            drops.add_image(frame.astype(np.float32), exptime=1.0, pixmap=np.stack([column, row], -1), pixfrac=fraction)
        image, weight = np.asarray(drops.out_img, float), np.asarray(drops.out_wht, float)
        yield np.where(weight > 0, image, _filled(image * weight, weight, 1.0))


def cases(name: str, options: argparse.Namespace, sigma: float) -> Rows:
    """Figures of one scene behind optics of one width, for all noise levels and numbers of frames."""
    side = POINTS_PER_PX * (options.finer_size + 2 * MARGIN)
    taken = record(SCENES[name](side, side, 3).double().numpy(), sigma, options.finer_size)
    found = []
    for noise in options.finer_noises:
        detection = rsv.detect_vibration(taken.noisy(noise), taken.timing)
        for count in FRAMES:
            frames = taken.noisy(noise)[:count]
            before, finer = (joint(frames, taken.timing, detection, scale) for scale in (1, 2))
            row = {
                "scene": name,
                "sigma": sigma,
                "noise": noise,
                "frames": count,
                "still": decibel(taken.still(noise, count), taken.half, RIM),
                "endless": decibel(interpolated(taken.pixels), taken.half, RIM),
                "joint": decibel(interpolated(before), taken.half, RIM),
                "finer": decibel(finer, taken.half, RIM),
                "joint_pixels": decibel(before, taken.pixels, RIM),
                "finer_pixels": decibel(finer[::2, ::2], taken.pixels, RIM),
            }
            for peer, images in (("drizzle", drizzled), ("added", shift_and_add)):
                shown = images(frames, taken.timing, detection.vibration)
                row[peer] = max((decibel(image, taken.half, RIM) for image in shown), default=float("nan"))
            found.append(row)
    return found


def without_data(frames: torch.Tensor) -> torch.Tensor:
    """Frames in which 3 % of the pixels and a square of 24 px have no data."""
    missing = torch.rand(frames.shape, generator=torch.Generator().manual_seed(SEED)) < 0.03
    missing[:, 60:84, 60:84] |= torch.arange(len(frames))[:, None, None] == 0
    return frames.masked_fill(missing, torch.nan)


def conditions(options: argparse.Namespace) -> Rows:
    """Figures of eight frames of the city with other exposures, motions, missing data and a wrong vibration."""
    size, margin = options.finer_size, 64
    side = POINTS_PER_PX * (size + 2 * margin)
    scene = SCENES["city"](side, side, 3).double().numpy()
    usual = record(scene, 0.3, size)
    wrong = rsv.Vibration(usual.vibration.amplitude, usual.vibration.frequency, usual.vibration.phase + 0.05)
    level = float(np.quantile(usual.frames, 0.975))
    below = usual.half < level
    layers = SCENES["city"](*honesty_camera.fine_shape(size, size), 3).double().numpy()
    named: dict[str, tuple[Recording, Callable[[torch.Tensor], torch.Tensor], Any, dict[str, Any]]] = {
        "exposure of 100 rows": (record(scene, 0.3, size, exposure=100), torch.clone, None, {}),
        "exposure of 400 rows": (record(scene, 0.3, size, exposure=400), torch.clone, None, {}),
        "image motion of 500 px/s": (record(scene, 0.3, size, image_motion=500.0), torch.clone, None, {}),
        "roll of 2 mrad": (rolling(layers, size, 2e-3), torch.clone, None, {}),
        "3 % of the pixels and a square without data": (usual, without_data, None, {}),
        "2.5 % saturated pixels, PSNR below saturation": (
            usual,
            lambda frames: frames.clamp(max=level),
            None,
            {"saturation": level},
        ),
        "phases wrong by 0.05 rad": (usual, torch.clone, wrong, {}),
    }
    found = []
    for name, (taken, change, motion, chosen) in named.items():
        for noise in options.finer_noises:
            frames = change(taken.noisy(noise))
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", rsv.RestorationWarning)
                before, finer = (
                    joint(frames, taken.timing, motion or taken.vibration, scale, **chosen) for scale in (1, 2)
                )
            counted = below if chosen else np.ones_like(taken.half, dtype=bool)
            still = taken.still(noise, max(FRAMES))
            all_points = 10 * np.log10(1 / counted.mean())  # dB; the error of others is zero
            figures = {
                kind: decibel(np.where(counted, image, taken.half), taken.half, RIM) - all_points
                for kind, image in (("still", still), ("joint", interpolated(before)), ("finer", finer))
            }
            found.append({"condition": name, "noise": noise, "warned": len(caught) > 0, **figures})
    return found


def rows(options: argparse.Namespace) -> Rows:
    """PSNR on half pixels and on pixels, for all scenes, optics, noise levels and numbers of frames."""
    table = [row for name in options.scenes for sigma in OPTICS for row in cases(name, options, sigma)]
    return [*table, *conditions(options)]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    return [
        f"PSNR in dB against the noise-free scene after optics and pixel, without a border of {RIM} points; frames of "
        f"{options.finer_size} x {options.finer_size} px, exposure of {EXPOSURE_ROWS} rows, vibration detected in all "
        f"{max(FRAMES)} frames. Still frames are averaged and interpolated; in brackets, infinitely many of them.",
        "",
        *table_of(
            (row for row in results if "scene" in row),
            ("scene", "{scene}"),
            ("σ of the optics (px)", "{sigma}"),
            ("noise", "{noise}"),
            ("frames", "{frames}"),
            ("half pixels: still frames", "{still:.1f} ({endless:.1f})"),
            ("drizzle", "{drizzle:.1f}"),
            ("shift-and-add", "{added:.1f}"),
            ("`joint=True`, interpolated", "{joint:.1f}"),
            ("`joint=True, scale=2`", "**{finer:.1f}**"),
            ("pixels: `joint=True`", "{joint_pixels:.1f}"),
            ("`joint=True, scale=2`", "**{finer_pixels:.1f}**"),
        ),
        f"The same for {max(FRAMES)} frames of the city, σ 0.3 px (roll: 0.4 px), with the true vibration but in the "
        "last rows. Still frames have none of the conditions. Saturated: points below saturation only.",
        "",
        *table_of(
            (row for row in results if "condition" in row),
            ("condition", "{condition}"),
            ("noise", "{noise}"),
            ("still frames", "{still:.1f}"),
            ("`joint=True`, interpolated", "{joint:.1f}"),
            ("`joint=True, scale=2`", "**{finer:.1f}**"),
            ("warning", lambda row: "yes" if row["warned"] else ""),
        ),
    ]
