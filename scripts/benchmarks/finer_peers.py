"""Images on half pixels by other software: drizzle, and shift-and-add, with the same motion.

Both put every pixel where it was on the scene, the mean displacement of its row. Parameters have the highest PSNR of
several values.
"""

from collections.abc import Iterator

import numpy as np
import torch
from benchmarks.independent_camera import Array
from scipy import ndimage

import rsvib_torch as rsv

try:
    from drizzle.resample import Drizzle
except ImportError:  # extra ``compare``
    Drizzle = None

WIDTHS = (0.3, 0.5, 0.7, 1.0)  # of the Gaussian of shift-and-add, points of the half-pixel grid
FRACTIONS = (0.4, 0.6, 0.8, 1.0)  # sizes of the drops of drizzle


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
