"""Restoration with other software: unwarping with OpenCV, and deconvolution with scikit-image row by row."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from skimage.restoration import richardson_lucy, wiener
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.imaging import rows_showing

HALF_ROWS = 16  # of the slab that a row is deconvolved in
SAMPLED_ROWS = 32
SAMPLES = 64  # of an exposure
BALANCES = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1)  # of skimage.restoration.wiener
ITERATIONS = (5, 20, 60)  # of skimage.restoration.richardson_lucy


@dataclass(frozen=True, eq=False)
class Peer:
    """Result of a method for one frame.

    Attributes:
        restored: (H, W), or only some rows of it.
        seconds: Time for the whole frame.
        setting: Parameters with the highest PSNR.
        rows: The restored rows; None for all.
    """

    restored: Tensor
    seconds: float
    setting: str
    rows: list[int] | None = None


def rows_and_displacements(
    scene_rows: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int = 0
) -> tuple[Tensor, Tensor]:
    """Rows of frame ``index`` in which rows of the scene appear, and their mean displacements (N, 2)."""
    start = timing.frame_starts(index + 1)[index]
    shown_by = rows_showing(scene_rows.double(), start, timing, truth)
    return shown_by, truth.mean_displacement(start + shown_by * timing.row_time, timing.exposure_time)


def remap_lanczos(frame: np.ndarray, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int = 0) -> Peer:
    """Unwarp with the mean displacement of every row, by Lanczos-4."""
    begin = time.perf_counter()
    height, width = frame.shape
    shown_by, mean = rows_and_displacements(torch.arange(height), timing, truth, index)
    map_x = (np.arange(width)[None] + mean[:, :1].numpy()).astype(np.float32)
    map_y = np.broadcast_to(shown_by[:, None].numpy().astype(np.float32), map_x.shape)
    fetched = cv2.remap(frame, map_x, np.ascontiguousarray(map_y), cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    return Peer(torch.from_numpy(fetched), time.perf_counter() - begin, "")


def slab_kernels(
    scene_rows: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int = 0
) -> tuple[list[int], list[np.ndarray]]:
    """Frame row in the middle of each row's slab, and the centred kernel of the whole slab (Eqs. 26-39)."""
    start = timing.frame_starts(index + 1)[index]
    shown_by, _ = rows_and_displacements(scene_rows, timing, truth, index)
    middles = shown_by.round().long()
    psf = rsv.row_psf(truth, start + shown_by * timing.row_time, timing)
    kernels, (left, top) = psf.dense()
    padded = []
    for kernel, moved in zip(kernels, (middles - scene_rows).tolist(), strict=True):
        # centred on displacement (0, moved), because the slab follows its middle row
        height, width = kernel.shape
        y, x = top - moved, left
        half = max(abs(y), abs(y + height - 1)), max(abs(x), abs(x + width - 1))
        canvas = np.zeros((2 * half[0] + 1, 2 * half[1] + 1))
        canvas[half[0] + y : half[0] + y + height, half[1] + x : half[1] + x + width] = kernel.numpy()
        rows, columns = (np.flatnonzero(canvas.sum(axis)) for axis in (1, 0))
        keep = [max(abs(int(i[0]) - h), abs(int(i[-1]) - h)) for i, h in zip((rows, columns), half, strict=True)]
        inner = tuple(slice(h - k, h + k + 1) for h, k in zip(half, keep, strict=True))
        padded.append(canvas[inner])
    return middles.tolist(), padded


def lanczos(place: np.ndarray) -> np.ndarray:
    """Lanczos-4 window at distances in px."""
    return np.where(np.abs(place) < 4, np.sinc(place) * np.sinc(place / 4), 0.0)


def row_kernels(rows: np.ndarray, timing: rsv.SensorTiming, truth: rsv.Vibration, dtype: str) -> np.ndarray:
    """Centred kernels (N, KH, KW) of frame rows: the motion during their exposures."""
    times = torch.from_numpy(rows * timing.row_time)[:, None] + timing.exposure_time * (
        (torch.arange(SAMPLES, dtype=torch.float64) + 0.5) / SAMPLES
    )
    moved = truth.displacement(times).numpy()
    half_x, half_y = (math.ceil(float(a.sum())) + 4 for a in truth.amplitude)
    taps_x = lanczos(np.arange(-half_x, half_x + 1) - moved[..., :1])
    taps_y = lanczos(np.arange(-half_y, half_y + 1) - moved[..., 1:])
    taps_x, taps_y = (taps / taps.sum(-1, keepdims=True) for taps in (taps_x, taps_y))
    return (np.einsum("nsy,nsx->nyx", taps_y, taps_x) / SAMPLES).astype(dtype)


def restore_rows(
    frame: np.ndarray,
    middles: Sequence[int],
    kernels: Sequence[np.ndarray],
    deconvolve: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Central rows of slabs deconvolved one after another."""
    return np.stack(
        [
            deconvolve(frame[m - HALF_ROWS : m + HALF_ROWS + 1], kernel)[HALF_ROWS]
            for m, kernel in zip(middles, kernels, strict=True)
        ]
    )


def sampled_rows(height: int, rim: int, count: int = SAMPLED_ROWS) -> Tensor:
    """Random rows of a frame whose slabs are inside the frame."""
    safe = rim + HALF_ROWS
    generator = torch.Generator().manual_seed(0)
    return (torch.randperm(height - 2 * safe, generator=generator)[:count] + safe).sort().values


def by_wiener(balance: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """``skimage.restoration.wiener`` with a balance."""
    return lambda slab, kernel: wiener(slab, kernel, balance, clip=False)


def by_richardson_lucy(iterations: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """``skimage.restoration.richardson_lucy`` with a number of iterations."""
    return lambda slab, kernel: richardson_lucy(slab, kernel, iterations, clip=False, filter_epsilon=1e-6)


@dataclass(frozen=True, eq=False)
class _Loop:
    """A loop over sampled rows of a frame, with several settings."""

    settings: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]
    count: int


LOOPS = {
    "skimage wiener, row loop": _Loop(
        {f"balance {balance:g}": by_wiener(balance) for balance in BALANCES}, SAMPLED_ROWS
    ),
    "skimage richardson_lucy, row loop": _Loop(
        {f"{count} iterations": by_richardson_lucy(count) for count in ITERATIONS}, SAMPLED_ROWS // 2
    ),
}


def loop_rows(
    name: str,
    frame: np.ndarray,
    timing: rsv.SensorTiming,
    truth: rsv.Vibration,
    still: Tensor,
    rim: int,
    index: int = 0,
) -> Peer:
    """Random rows restored one by one, with the setting of the highest PSNR."""
    height = frame.shape[0]
    sampled = sampled_rows(height, rim, LOOPS[name].count)
    middles, kernels = slab_kernels(sampled, timing, truth, index)
    best, error = None, math.inf
    for setting, deconvolve in LOOPS[name].settings.items():
        begin = time.perf_counter()
        found = torch.from_numpy(restore_rows(frame, middles, kernels, deconvolve))
        seconds = (time.perf_counter() - begin) * height / len(sampled)
        wrong = float((found - still[sampled])[:, rim:-rim].square().mean())
        if wrong < error:
            best, error = Peer(found, seconds, setting, sampled.tolist()), wrong
    if best is None:
        raise ValueError(f"{name}: no setting gives finite values")
    return best
