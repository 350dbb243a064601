"""Registration: all bands of a pair of frames, against skimage.registration.phase_cross_correlation band by band."""

import argparse
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from benchmarks.measure import in_turns
from skimage.registration import phase_cross_correlation
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.imaging import rows_showing

SEED, NOISE = 7, 0.003
MARGIN = 32
BAND_ROWS, BAND_STEP = 32, 16
OUTLIER = 0.5  # px
PEER = "skimage loop"


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


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Registration of a pair of frames of a drawn scene."""
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
    generator = torch.Generator().manual_seed(SEED)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    truth = rsv.Vibration([3.1, 5.2], [50.0, 30.0], phase)
    scene = city_and_fields(options.size + 2 * MARGIN, options.size + 2 * MARGIN, SEED)
    noise, size = rsv.SensorNoise(read_noise=NOISE), (options.size, options.size)
    frames = rsv.simulate_frames(scene, timing, truth, 2, frame_size=size, noise=noise, generator=generator)
    return benchmark_registration(frames, timing, truth, options.runs)


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """The figures as a Markdown table."""
    bands = (options.size - BAND_ROWS) // BAND_STEP + 1
    lines = [
        f"{options.size} x {options.size} px, noise {100 * NOISE:g} % of full scale.",
        "",
        f"| registration of {bands} bands | seconds | loop / this | rms x, y (px) | given up or off > {OUTLIER} px |",
        "|---|---|---|---|---|",
    ]
    for r in results:
        rms = ", ".join(f"{value:.4f}" for value in r["rms_px"])
        lines.append(
            f"| {r['method']} | {r['seconds']:.3f} | {r['ratio']:.1f} | {rms} | {100 * r['share_off']:.1f} % |"
        )
    return lines


# rows(options) measures, lines(rows, options) makes a Markdown table of it
