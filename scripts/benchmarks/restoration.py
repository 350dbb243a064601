"""Restoration of one frame, against skimage.restoration.wiener row by row on the slabs of the banded method."""

import argparse
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from benchmarks.measure import in_turns
from skimage.restoration import wiener
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.imaging import rows_showing
from rsvib_torch.restoration.restore import METHODS

SEED, NOISE = 7, 0.003
MARGIN = RIM = 32
HALF_ROWS = 16
PEER = "skimage loop"
BALANCES = (0.001, 0.003, 0.01, 0.03)  # regularisation of skimage.restoration.wiener; the best for the scene counts


def slab_kernels(
    scene_rows: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration
) -> tuple[list[int], list[np.ndarray]]:
    """Frame row in the middle of each row's slab, and the centred kernel of the whole slab (Eqs. 26-39)."""
    start = timing.frame_starts(1)[0]
    shown_by = rows_showing(scene_rows.double(), start, timing, truth)
    middles = shown_by.round().long()
    psf = rsv.row_psf(truth, start + shown_by * timing.row_time, timing)
    kernels, (left, top) = psf.dense()
    padded = []
    for kernel, moved in zip(kernels, (middles - scene_rows).tolist(), strict=True):
        # centred on displacement (0, moved): the slab already follows its middle row
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


def restore_by_skimage(
    frame: np.ndarray, middles: Sequence[int], kernels: Sequence[np.ndarray], balance: float
) -> np.ndarray:
    """Central rows of slabs deconvolved one after another."""
    return np.stack(
        [
            wiener(frame[m - HALF_ROWS : m + HALF_ROWS + 1], kernel, balance, clip=False)[HALF_ROWS]
            for m, kernel in zip(middles, kernels, strict=True)
        ]
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this part."""
    parser.add_argument("--rows", type=int, default=64, help="rows that the restoring loop is timed on (default: 64)")


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Time and PSNR of each way to restore one frame; the loop is timed on a sample of rows."""
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
    generator = torch.Generator().manual_seed(SEED)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    truth = rsv.Vibration([3.1, 5.2], [50.0, 30.0], phase)
    scene = city_and_fields(options.size + 2 * MARGIN, options.size + 2 * MARGIN, SEED)
    noise = rsv.SensorNoise(read_noise=NOISE)
    size = (options.size, options.size)
    frame = rsv.simulate_frames(scene, timing, truth, 1, frame_size=size, noise=noise, generator=generator)[0]
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
    height, runs, sample = options.size, options.runs, options.rows
    safe = RIM + HALF_ROWS
    generator = torch.Generator().manual_seed(SEED)
    sampled = (torch.randperm(height - 2 * safe, generator=generator)[:sample] + safe).sort().values

    def quality(restored: Tensor) -> float:
        return float(rsv.psnr(restored[:, RIM:-RIM], still[sampled, RIM:-RIM], 1.0))

    options: dict[str, dict[str, Any]] = {name: {"method": name} for name in METHODS}
    options["banded, a slab for every row"] = {"method": "banded", "stride": 1}
    works: dict[str, Callable[[], Any]] = {
        name: lambda o=chosen: rsv.restore(frame[None], timing, truth, **o)[0, sampled]
        for name, chosen in options.items()
    }
    middles, kernels = slab_kernels(sampled, timing, truth)
    array = frame.numpy()

    def loop(balance: float) -> Tensor:
        return torch.from_numpy(restore_by_skimage(array, middles, kernels, balance))

    balance = max(BALANCES, key=lambda b: quality(loop(b)))
    done = in_turns(works | {PEER: lambda: loop(balance)}, runs)
    results = [
        {
            "method": name,
            "seconds": seconds * (height / len(sampled) if name == PEER else 1),
            "psnr_db": quality(restored),
        }
        for name, (seconds, restored) in done.items()
    ]
    return [{**result, "ratio": results[-1]["seconds"] / result["seconds"]} for result in results]


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """The figures as a Markdown table."""
    return [
        "| restoration of one frame | seconds | loop / this | PSNR of the sampled rows (dB) |",
        "|---|---|---|---|",
        *(f"| {r['method']} | {r['seconds']:.3f} | {r['ratio']:.1f} | {r['psnr_db']:.2f} |" for r in results),
        "",
        f"The restoring loop ran on {options.rows} rows drawn at random; its time is scaled to {options.size} rows, and "
        f"making its kernels is not counted. Times are medians of {options.runs} runs in turns.",
    ]
