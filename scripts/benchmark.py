#!/usr/bin/env python
"""Speed and accuracy next to loops of scikit-image, in one run on one machine.

Registration: all bands of a pair of frames, against skimage.registration.phase_cross_correlation band by band.
Restoration: one frame, against skimage.restoration.wiener row by row on the slabs of the banded method.
"""

import argparse
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import skimage
import torch
from skimage.registration import phase_cross_correlation
from skimage.restoration import wiener
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.imaging import rows_showing
from rsvib_torch.restoration.restore import METHODS

SEED, NOISE = 7, 0.003
MARGIN = RIM = 32
BAND_ROWS, BAND_STEP, HALF_ROWS = 32, 16, 16
OUTLIER = 0.5  # px
PEER = "skimage loop"
BALANCES = (0.001, 0.003, 0.01, 0.03)  # regularisation of skimage.restoration.wiener; the best for the scene counts


def in_turns(works: dict[str, Callable[[], Any]], runs: int) -> dict[str, tuple[float, Any]]:
    """Median time of each piece of work, and its result, all taking turns so that a busy moment hits all alike."""
    results = {name: work() for name, work in works.items()}  # warms up
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(runs):
        for name, work in works.items():
            begin = time.perf_counter()
            work()
            seconds[name].append(time.perf_counter() - begin)
    return {name: (statistics.median(seconds[name]), results[name]) for name in works}


def true_offsets(rows: Tensor, height: int, timing: rsv.SensorTiming, truth: rsv.Vibration) -> Tensor:
    """Offsets (N, 2) of bands centred on ``rows``, averaged over the rows of each band."""
    rows = rows[:, None] + torch.arange(height, dtype=torch.float64) - 0.5 * (height - 1)
    earlier, later = timing.frame_starts(2)
    before = truth.mean_displacement(earlier + rows * timing.row_time, timing.exposure_time)
    found = rows_showing(rows - before[..., 1], later, timing, truth)
    after = truth.mean_displacement(later + found * timing.row_time, timing.exposure_time)
    return (after - before).mean(1)


def register_by_skimage(frames: np.ndarray, tops: Sequence[int]) -> Tensor:
    """Offsets (N, 2) of bands by phase correlation, one after another; skimage gives (y, x) of the way back."""
    shifts = [phase_cross_correlation(*frames[:, top : top + BAND_ROWS], upsample_factor=100)[0][::-1] for top in tops]
    return -torch.from_numpy(np.stack(shifts))


def benchmark_registration(
    frames: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, runs: int
) -> list[dict[str, Any]]:
    """Time and error of each way to register all bands of the pair."""
    options = {"band_rows": BAND_ROWS, "band_step": BAND_STEP}
    array = frames.numpy()
    tops = list(range(0, frames.shape[-2] - BAND_ROWS + 1, BAND_STEP))
    works: dict[str, Callable[[], Any]] = {
        method: lambda m=method: rsv.register_bands(frames, timing, method=m, **options)
        for method in ("projection", "ncc", "phase")
    }
    done = in_turns(works | {PEER: lambda: register_by_skimage(array, tops)}, runs)
    results = []
    for name, (seconds, found) in done.items():
        rows = torch.tensor(tops, dtype=torch.float64) + 0.5 * (BAND_ROWS - 1)
        heights = (BAND_ROWS, BAND_ROWS) if name == PEER else found.heights
        offsets = found if name == PEER else found.offsets[0]
        wanted = torch.stack([true_offsets(rows, h, timing, truth)[:, a] for a, h in enumerate(heights)], dim=-1)
        error = (offsets - wanted).abs()
        off = ~(error < OUTLIER).all(-1)  # NaN, a band given up, counts as off
        rms = error[~off].square().mean(0).sqrt().tolist()
        share = off.double().mean().item()
        results.append({"method": name, "seconds": seconds, "rms_px": rms, "share_off": share})
    return with_ratios(results)


def with_ratios(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The results, each with how many times faster it is than the loop, which is the last one."""
    return [{**result, "ratio": results[-1]["seconds"] / result["seconds"]} for result in results]


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


def benchmark_restoration(
    frame: Tensor, still: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, runs: int, sample: int
) -> list[dict[str, Any]]:
    """Time and PSNR of each way to restore one frame; the loop is timed on a sample of rows."""
    height = frame.shape[-1]
    safe = RIM + HALF_ROWS
    generator = torch.Generator().manual_seed(SEED)
    rows = (torch.randperm(height - 2 * safe, generator=generator)[:sample] + safe).sort().values

    def quality(restored: Tensor) -> float:
        return float(rsv.psnr(restored[:, RIM:-RIM], still[rows, RIM:-RIM], 1.0))

    options: dict[str, dict[str, Any]] = {name: {"method": name} for name in METHODS}
    options["banded, a slab for every row"] = {"method": "banded", "stride": 1}
    works: dict[str, Callable[[], Any]] = {
        name: lambda o=chosen: rsv.restore(frame[None], timing, truth, **o)[0, rows] for name, chosen in options.items()
    }
    middles, kernels = slab_kernels(rows, timing, truth)
    array = frame.numpy()

    def loop(balance: float) -> Tensor:
        return torch.from_numpy(restore_by_skimage(array, middles, kernels, balance))

    balance = max(BALANCES, key=lambda b: quality(loop(b)))
    done = in_turns(works | {PEER: lambda: loop(balance)}, runs)
    results = [
        {"method": name, "seconds": seconds * (height / len(rows) if name == PEER else 1), "psnr_db": quality(restored)}
        for name, (seconds, restored) in done.items()
    ]
    return with_ratios(results)


def report(summary: dict[str, Any]) -> str:
    """The figures as Markdown tables."""
    machine = summary["machine"]
    size = summary["size"]
    lines = [
        f"{size} x {size} px, noise {100 * NOISE:g} % of full scale, "
        f"{machine['cores']} cores ({machine['processor']}),",
        f"Python {machine['python']}, torch {machine['torch']} on {machine['threads']} threads, "
        f"scikit-image {machine['skimage']}.",
        "",
        f"| registration of {summary['bands']} bands | seconds | loop / this | rms x, y (px) | given up or off > "
        f"{OUTLIER} px |",
        "|---|---|---|---|---|",
    ]
    for r in summary["registration"]:
        rms = ", ".join(f"{value:.4f}" for value in r["rms_px"])
        lines.append(
            f"| {r['method']} | {r['seconds']:.3f} | {r['ratio']:.1f} | {rms} | {100 * r['share_off']:.1f} % |"
        )
    lines += [
        "",
        "| restoration of one frame | seconds | loop / this | PSNR of the sampled rows (dB) |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| {r['method']} | {r['seconds']:.3f} | {r['ratio']:.1f} | {r['psnr_db']:.2f} |"
        for r in summary["restoration"]
    ]
    lines += [
        "",
        f"The restoring loop ran on {summary['sampled_rows']} rows drawn at random; its time is scaled to {size} rows, "
        "and making its kernels is not counted. "
        f"Times are medians of {summary['runs']} runs in turns.",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/benchmark"), help="folder for benchmark.md and .json")
    parser.add_argument("--size", type=int, default=2048, help="rows and columns of the frames (default: 2048)")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each (default: 5)")
    parser.add_argument("--rows", type=int, default=64, help="rows that the restoring loop is timed on (default: 64)")
    options = parser.parse_args()
    threads = os.cpu_count() or 1
    torch.set_num_threads(threads)
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
    generator = torch.Generator().manual_seed(SEED)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    truth = rsv.Vibration([3.1, 5.2], [50.0, 30.0], phase)
    size = options.size
    scene = city_and_fields(size + 2 * MARGIN, size + 2 * MARGIN, SEED)
    noise = rsv.SensorNoise(read_noise=NOISE)
    frames = rsv.simulate_frames(scene, timing, truth, 2, frame_size=(size, size), noise=noise, generator=generator)
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
    summary = {
        "size": size,
        "runs": options.runs,
        "sampled_rows": options.rows,
        "bands": (size - BAND_ROWS) // BAND_STEP + 1,
        "registration": benchmark_registration(frames, timing, truth, options.runs),
        "restoration": benchmark_restoration(frames[0], still, timing, truth, options.runs, options.rows),
        "machine": {
            "cores": threads,
            "threads": torch.get_num_threads(),
            "processor": platform.processor() or platform.machine(),
            "python": platform.python_version(),
            "torch": torch.__version__,
            "skimage": skimage.__version__,
        },
    }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "benchmark.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    text = report(summary)
    (options.out / "benchmark.md").write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
