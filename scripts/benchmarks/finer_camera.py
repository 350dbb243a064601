"""Frames of a vibrating rolling-shutter camera that aliases, independent of the package: NumPy, float64.

The scene is periodic and four times finer than the pixels. Optics (a Gaussian) and pixels (squares) are factors on its
spectrum. The frames sample the result at the pixels, so that detail beyond half a cycle per pixel is aliased.
"""

import numpy as np
from benchmarks.independent_camera import Array

FINER = 4  # points of the scene per px
BETWEEN = 4  # interpolated rows per row of the scene


def after_optics(scene: Array, sigma: float, pixel: float = 1.0) -> Array:
    """The scene after Gaussian optics of ``sigma`` px and square pixels of ``pixel`` px, on its own grid."""
    v, u = (np.fft.fftfreq(size) * FINER for size in scene.shape)  # cycles per px
    transfer = [np.exp(-2 * (np.pi * sigma * w) ** 2) * np.sinc(pixel * w) for w in (v, u)]
    return np.fft.ifft2(np.fft.fft2(scene) * transfer[0][:, None] * transfer[1]).real


def still_image(scene: Array, size: tuple[int, int], scale: int = 1, offset: tuple[int, int] = (0, 0)) -> Array:
    """The scene after the optics on a grid of ``scale`` points per px, moved by an offset in points of the scene."""
    top, left = ((whole - FINER * part) // 2 for whole, part in zip(scene.shape, size, strict=True))
    moved = np.roll(scene, (offset[0] - top, offset[1] - left), (0, 1))
    step = FINER // scale
    return moved[: FINER * size[0] : step, : FINER * size[1] : step]


def mosaic_of(frames: Array, pattern: str) -> Array:
    """Raw frames (T, H, W) behind colour filters from colour frames (T, 3, H, W).

    ``pattern`` names the colours of the pixels (0, 0), (0, 1), (1, 0), (1, 1).
    """
    raw = np.empty((len(frames), *frames.shape[-2:]))
    for place, colour in enumerate(pattern):
        part = (slice(place // 2, None, 2), slice(place % 2, None, 2))
        raw[:, *part] = frames[:, "RGB".index(colour), *part]
    return raw
