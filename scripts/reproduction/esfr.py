"""The slanted-edge MTF of ISO 12233 with a straight line: NumPy, independent of the package.

With a straight line, the distortion of an edge counts as blur. The usual tools, and presumably the paper, measure
frames of a vibrating camera in this way.
"""

import numpy as np
from benchmarks.independent_camera import Array

_FINER = 4  # bins per pixel


def _centroids(roi: Array, window: Array) -> Array:
    slope = np.diff(roi, axis=1) * window
    place = np.arange(slope.shape[1]) + 0.5
    return (slope * place).sum(1) / slope.sum(1)


def straight_edge_mtf(roi: Array, frequency: Array) -> Array:
    """MTF along the rows' edge normal at frequencies in cycles/px, of an edge near the vertical.

    Centroids of the rows' derivatives, a straight line through them, the pixels in quarter-pixel bins by distance,
    derivative, Hamming window, Fourier transform, and the correction for derivative and bins.

    Args:
        roi: (h, w) with one near-vertical edge; transpose for a near-horizontal one.
        frequency: (F,) cycles/px along the normal.
    """
    height, width = roi.shape
    if roi[:, : width // 4].mean() > roi[:, -width // 4 :].mean():
        roi = roi[:, ::-1]
    rows, places = np.arange(height), np.arange(width - 1)
    window = np.hamming(width - 1)[None].repeat(height, 0)
    for _ in range(2):  # in the second pass the windows follow the edge
        slope, start = np.polyfit(rows, _centroids(roi, window), 1)
        middle = start + slope * rows
        apart = (places[None] + 0.5 - middle[:, None]) / (0.5 * (width - 1))
        window = np.where(np.abs(apart) < 1, 0.54 + 0.46 * np.cos(np.pi * apart), 0.0)
    normal = np.cos(np.arctan(slope))
    distance = (np.arange(width)[None] - middle[:, None]) * normal
    reach = int(np.floor((0.5 * (width - 1) - abs(slope) * height / 2 - 1) * normal))
    bins = np.round(distance * _FINER).astype(int) + _FINER * reach
    inside = (bins >= 0) & (bins <= 2 * _FINER * reach)
    size = 2 * _FINER * reach + 1
    counts = np.bincount(bins[inside], minlength=size)
    sums = np.bincount(bins[inside], roi[inside], minlength=size)
    filled = counts > 0
    spread = np.interp(np.arange(size), np.flatnonzero(filled), sums[filled] / counts[filled])
    line = 0.5 * (spread[2:] - spread[:-2])
    at = (np.arange(len(line)) + 1) / _FINER - reach
    peak = at[np.argmax(np.abs(np.convolve(line, np.ones(_FINER), "same")))]
    apart = (at - peak) / np.abs(at - peak).max()
    line = line * (0.54 + 0.46 * np.cos(np.pi * apart))
    response = np.abs(np.exp(-2j * np.pi * frequency[:, None] * at) @ line) / abs(line.sum())
    correction = np.sinc(2 * frequency / _FINER) * np.sinc(frequency / _FINER)
    return response / np.maximum(correction, 0.1)


def crossing(frequency: Array, mtf: Array, level: float = 0.5) -> float:
    """Frequency at which an MTF first falls to a level; NaN if it does not."""
    below = np.flatnonzero(mtf <= level)
    if not len(below) or below[0] == 0:
        return float("nan")
    i = int(below[0])
    return float(frequency[i - 1] + (mtf[i - 1] - level) / (mtf[i - 1] - mtf[i]) * (frequency[i] - frequency[i - 1]))
