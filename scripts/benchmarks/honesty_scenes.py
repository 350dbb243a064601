"""Scenes drawn on a fine grid, brightness 0 to 1."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from benchmarks.honesty_camera import FINER, Array, Layer, fine_shape, layer
from scipy.ndimage import gaussian_filter

Generator = np.random.Generator


def _grid(shape: tuple[int, int]) -> tuple[Array, Array]:
    """Positions (rows, columns) in px."""
    return np.arange(shape[0])[:, None] / FINER, np.arange(shape[1])[None, :] / FINER


def texture(shape: tuple[int, int], generator: Generator, exponent: float = 1.2) -> Array:
    """Gaussian noise whose spectrum decreases as a power of the frequency, as in natural images."""
    u, v = np.fft.rfftfreq(shape[1]), np.fft.fftfreq(shape[0])[:, None]
    radius = np.maximum(np.hypot(u, v), 1.0 / max(shape))
    noise = np.fft.irfft2(np.fft.rfft2(generator.standard_normal(shape)) * radius**-exponent, s=shape)
    return np.asarray(np.clip(0.5 + 0.15 * (noise - noise.mean()) / noise.std(), 0.0, 1.0))


def city(shape: tuple[int, int], generator: Generator) -> Array:
    """Buildings with windows, shadows and roofs between straight roads, over a rough ground."""
    scene = 0.3 + 0.5 * (texture(shape, generator, 0.9) - 0.5)
    y, x = _grid(shape)
    for _ in range(8):
        angle, at = generator.uniform(0, np.pi), generator.uniform(0.1, 0.9, 2) * shape / FINER
        across = np.abs(np.cos(angle) * (x - at[1]) + np.sin(angle) * (y - at[0]))
        scene = np.where(across < generator.uniform(2, 5), generator.uniform(0.15, 0.6), scene)
    for _ in range(shape[0] * shape[1] // (18 * FINER) ** 2):
        top, left = (int(generator.integers(0, n - 4 * FINER)) for n in shape)
        height, width = (int(FINER * generator.uniform(4, 22)) for _ in range(2))
        depth = int(FINER * generator.uniform(1, 4))
        scene[top + depth : top + height + depth, left + depth : left + width + depth] = 0.05
        roof = scene[top : top + height, left : left + width]
        roof[:] = generator.uniform(0.2, 0.95) + generator.uniform(0, 0.1) * generator.standard_normal(roof.shape)
        roof[:: int(FINER * generator.uniform(2, 6)) + 1] *= 0.7
    return np.asarray(np.clip(scene, 0.0, 1.0))


def chart(shape: tuple[int, int], generator: Generator) -> Array:
    """Tiles with bars of many directions and widths, checkers, rings and sector stars."""
    scene = np.full(shape, 0.8)
    y, x = _grid(shape)
    tile = 32 * FINER
    for top in range(0, shape[0], tile):
        for left in range(0, shape[1], tile):
            here = (slice(top, top + tile), slice(left, left + tile))
            down, right = y[here[0]] - y[top] - 16.0, x[:, here[1]] - x[0, left] - 16.0
            period, angle = generator.uniform(2.2, 12.0), generator.uniform(0, np.pi)
            along = (np.cos(angle) * right + np.sin(angle) * down) / period
            across = (np.cos(angle) * down - np.sin(angle) * right) / period
            pattern = (
                along % 1 < 0.5,
                (along % 1 < 0.5) ^ (across % 1 < 0.5),
                np.hypot(along, across) % 1 < 0.5,
                (np.arctan2(down, right) / np.pi * 9) % 1 < 0.5,
            )[int(generator.integers(4))]
            inside = (np.abs(down) < 14.0) & (np.abs(right) < 14.0)
            scene[here] = np.where(pattern & inside, generator.uniform(0.05, 0.4), scene[here])
    return scene


def text(shape: tuple[int, int], generator: Generator) -> Array:
    """Lines of characters made of strokes, of several sizes, on paper."""
    letters = np.zeros((24, 9, 7))  # rows and columns of a character with its spaces
    for letter in letters:
        for _ in range(int(generator.integers(2, 5))):
            row, column = int(generator.integers(0, 7)), int(generator.integers(0, 5))
            if generator.random() < 0.5:
                letter[row, : column + 2] = 1.0
            else:
                letter[: row + 1, column] = 1.0
        letter[7:], letter[:, 5:] = 0.0, 0.0
    scene, top = np.full(shape, 0.9), 0
    while top < shape[0]:
        scale = int(generator.integers(3, 9))
        count = shape[1] // (7 * scale) + 1
        line = np.concatenate([letters[i] for i in generator.integers(0, len(letters), count)], axis=1)
        line[:, generator.random(line.shape[1] // 7).repeat(7) < 0.15] = 0.0  # spaces between words
        drawn = np.kron(line, np.ones((scale, scale)))[: shape[0] - top, : shape[1]]
        scene[top : top + len(drawn)] -= 0.8 * drawn
        top += 9 * scale + 2
    return scene


def stars(shape: tuple[int, int], generator: Generator) -> Array:
    """Points of unequal brightness, one on 40 x 40 px, on a dark ground."""
    scene = np.zeros(shape)
    for _ in range(shape[0] * shape[1] // (40 * FINER) ** 2):
        scene[int(generator.integers(shape[0])), int(generator.integers(shape[1]))] = generator.uniform(0.1, 1.0)
    sigma = 0.7 * FINER
    return np.asarray(0.02 + gaussian_filter(scene, sigma) * 2 * np.pi * sigma**2 * 0.9)


SCENES: dict[str, Callable[[tuple[int, int], Generator], Array]] = {
    "city": city,
    "chart": chart,
    "texture": texture,
    "text": text,
    "stars": stars,
}


@lru_cache(maxsize=12)  # 14 MB each for 384 x 384 px
def scene_layer(name: str, seed: int, height: int, width: int) -> Layer:
    """A drawn scene of a seed."""
    return layer(SCENES[name](fine_shape(height, width), np.random.default_rng(seed)))


def cars(height: int, width: int, generator: Generator, velocity: tuple[float, float], share: float = 0.05) -> Layer:
    """Rectangles of 8 x 16 px with windows that cover a share of the area."""
    shape = fine_shape(height, width)
    light, cover = np.zeros(shape), np.zeros(shape)
    while cover.mean() < share:
        top, left = (int(generator.integers(0, n)) for n in shape)
        light[top : top + 8 * FINER, left : left + 16 * FINER] = generator.uniform(0.1, 1.0)
        light[top + FINER : top + 7 * FINER, left + 4 * FINER : left + 7 * FINER] = 0.05
        cover[top : top + 8 * FINER, left : left + 16 * FINER] = 1.0
    return layer(light, cover, velocity)


def cloud(height: int, width: int, generator: Generator, velocity: tuple[float, float], share: float = 0.24) -> Layer:
    """Bright opaque areas with soft borders that cover a share of the area."""
    shape = fine_shape(height, width)
    smooth = gaussian_filter(generator.standard_normal(shape), 24 * FINER, mode="wrap")
    cover = np.clip(0.5 + 8.0 * (smooth - np.quantile(smooth, 1.0 - share)) / smooth.std(), 0.0, 1.0)
    return layer(0.8 + 0.4 * (texture(shape, generator, 1.8) - 0.5), cover, velocity)


def near_half(height: int, width: int, generator: Generator, velocity: tuple[float, float]) -> Layer:
    """The right half of another city, in front of the scene."""
    shape = fine_shape(height, width)
    cover = np.zeros(shape)
    cover[:, shape[1] // 2 :] = 1.0
    return layer(city(shape, generator), cover, velocity)
