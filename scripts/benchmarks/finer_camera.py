"""Frames of a vibrating rolling-shutter camera that aliases, independent of the package: NumPy, float64.

The scene is periodic and four times finer than the pixels. Optics (a Gaussian) and pixels (squares) are factors on its
spectrum. The frames sample the result at the pixels, so that detail beyond half a cycle per pixel is aliased.
"""

import numpy as np
from benchmarks.independent_camera import POINTS, Array, Shake, exposure_moments, fine_rows, polynomial_weights

FINER = 4  # points of the scene per px
BETWEEN = 4  # interpolated rows per row of the scene


def after_optics(scene: Array, sigma: float) -> Array:
    """The scene after Gaussian optics of ``sigma`` px and square pixels, on its own grid."""
    v, u = (np.fft.fftfreq(size) * FINER for size in scene.shape)  # cycles per px
    transfer = [np.exp(-2 * (np.pi * sigma * w) ** 2) * np.sinc(w) for w in (v, u)]
    return np.fft.ifft2(np.fft.fft2(scene) * transfer[0][:, None] * transfer[1]).real


def still_image(scene: Array, size: tuple[int, int], scale: int = 1, offset: tuple[int, int] = (0, 0)) -> Array:
    """The scene after the optics on a grid of ``scale`` points per px, moved by an offset in points of the scene."""
    top, left = ((whole - FINER * part) // 2 for whole, part in zip(scene.shape, size, strict=True))
    moved = np.roll(scene, (offset[0] - top, offset[1] - left), (0, 1))
    step = FINER // scale
    return moved[: FINER * size[0] : step, : FINER * size[1] : step]


def take_frames(
    scene: Array,
    shake: Shake,
    *,
    row_time: float,
    exposure_rows: float,
    frame_rows: float,
    num_frames: int,
    size: tuple[int, int],
) -> Array:
    """Frames (T, H, W) without noise, centred on a scene after the optics."""
    rows = fine_rows(scene, BETWEEN)
    top, left = ((whole - FINER * part) // 2 for whole, part in zip(scene.shape, size, strict=True))
    cycles = np.fft.rfftfreq(scene.shape[1]) * FINER  # per px
    frames = np.zeros((num_frames, *size))
    moments, shares = exposure_moments(shake, exposure_rows * row_time)
    for p in range(num_frames):
        total = np.zeros((size[0], len(cycles)), dtype=complex)
        for moment, share in zip(moments, shares, strict=True):
            place = p * frame_rows + np.arange(size[0]) + moment * exposure_rows
            x, y = shake.displacement(place * row_time)
            source = (top + FINER * (np.arange(size[0]) - y)) * BETWEEN
            cell = np.floor(source).astype(int)
            weights = polynomial_weights(source - cell)
            row = sum(weights[:, i, None] * rows[(cell + i - (POINTS // 2 - 1)) % len(rows)] for i in range(POINTS))
            total += share * row * np.exp(-2j * np.pi * x[:, None] * cycles)
        frames[p] = np.fft.irfft(total, n=scene.shape[1], axis=1)[:, left : left + FINER * size[1] : FINER]
    return frames
