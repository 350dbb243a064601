"""Restoration with other software: unwarping with OpenCV, and deconvolution with scikit-image row by row."""

import math

import cv2
import numpy as np
import torch
from benchmarks.library_chain import kernel_of_row
from numpy.typing import NDArray
from skimage.restoration import wiener
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.imaging import rows_showing

Frame = NDArray[np.float32]
HALF_ROWS = 16  # of the slab that a row is deconvolved in
SAMPLED_ROWS = 32
BALANCES = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1)  # of skimage.restoration.wiener


def rows_and_displacements(
    scene_rows: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int = 0
) -> tuple[Tensor, Tensor]:
    """Rows of frame ``index`` in which rows of the scene appear, and their mean displacements (N, 2)."""
    start = timing.frame_starts(index + 1)[index]
    shown_by = rows_showing(scene_rows.double(), start, timing, truth)
    return shown_by, truth.mean_displacement(start + shown_by * timing.row_time, timing.exposure_time)


def remap_lanczos(frame: Frame, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int = 0) -> Tensor:
    """Unwarp with the mean displacement of every row, by Lanczos-4."""
    height, width = frame.shape
    shown_by, mean = rows_and_displacements(torch.arange(height), timing, truth, index)
    map_x = (np.arange(width)[None] + mean[:, :1].numpy()).astype(np.float32)
    map_y = np.broadcast_to(shown_by[:, None].numpy().astype(np.float32), map_x.shape)
    fetched = cv2.remap(frame, map_x, np.ascontiguousarray(map_y), cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    return torch.from_numpy(fetched)


def sampled_rows(height: int, rim: int) -> Tensor:
    """Random rows of a frame whose slabs are inside the frame."""
    safe = rim + HALF_ROWS
    generator = torch.Generator().manual_seed(0)
    return (torch.randperm(height - 2 * safe, generator=generator)[:SAMPLED_ROWS] + safe).sort().values


def slabs_and_kernels(
    frame: Frame, scene_rows: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int
) -> list[tuple[Frame, NDArray[np.float64]]]:
    """The slab of rows of frame ``index`` around each row of the scene, and its kernel (Secs. 3.1 and 3.2)."""
    shown_by, _ = rows_and_displacements(scene_rows, timing, truth, index)
    starts = (timing.frame_starts(index + 1)[index] + shown_by * timing.row_time).tolist()
    middles = shown_by.round().long()
    moved = (middles - scene_rows).tolist()
    return [
        (frame[middle - HALF_ROWS : middle + HALF_ROWS + 1], kernel_of_row(truth, start, timing, rows))
        for middle, start, rows in zip(middles.tolist(), starts, moved, strict=True)
    ]


def wiener_loop(pairs: list[tuple[Frame, NDArray[np.float64]]], balance: float) -> NDArray[np.float32]:
    """Middle rows of slabs deconvolved one after another."""
    return np.stack([wiener(slab, kernel, balance, clip=False)[HALF_ROWS] for slab, kernel in pairs])


def wiener_rows(
    frame: Frame, timing: rsv.SensorTiming, truth: rsv.Vibration, still: Tensor, rim: int, index: int = 0
) -> float:
    """PSNR in dB of random rows that are restored one by one, with the balance of the highest PSNR."""
    sampled = sampled_rows(len(frame), rim)
    pairs = slabs_and_kernels(frame, sampled, timing, truth, index)
    scene = still[sampled][:, rim:-rim].numpy()
    errors = [float(np.square(wiener_loop(pairs, balance)[:, rim:-rim] - scene).mean()) for balance in BALANCES]
    finite = [error for error in errors if math.isfinite(error)]
    if not finite:
        raise ValueError("wiener: no balance gives finite values")
    return -10 * math.log10(min(finite))
