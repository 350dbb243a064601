"""Registration of all bands of a pair of frames, compared with OpenCV and scikit-image band by band."""

import argparse
import math
from collections.abc import Callable
from typing import Any

import torch
from benchmarks.measure import Timed, in_turns, named, shown_seconds
from benchmarks.registration_peers import PEERS
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.imaging import rows_showing

SEED, NOISE = 7, 0.003
MARGIN = 32
BAND_ROWS, BAND_STEP = 32, 16
OUTLIER = 0.5  # px
METHODS = ("projection", "ncc", "phase")


def true_offsets(rows: Tensor, height: int, timing: rsv.SensorTiming, truth: rsv.Vibration) -> Tensor:
    """Offsets (N, 2) of bands centred on ``rows``, averaged over the rows of each band."""
    rows = rows[:, None] + torch.arange(height, dtype=torch.float64) - 0.5 * (height - 1)
    earlier, later = timing.frame_starts(2)
    before = truth.mean_displacement(earlier + rows * timing.row_time, timing.exposure_time)
    found = rows_showing(rows - before[..., 1], later, timing, truth)
    after = truth.mean_displacement(later + found * timing.row_time, timing.exposure_time)
    return (after - before).mean(1)


def _accuracy(
    offsets: Tensor, heights: tuple[int, int], tops: list[int], timing: rsv.SensorTiming, truth: rsv.Vibration
) -> dict[str, Any]:
    """Root-mean-square error of the bands within ``OUTLIER`` of the truth, and the fraction of the others."""
    rows = torch.tensor(tops, dtype=torch.float64) + 0.5 * (BAND_ROWS - 1)
    wanted = torch.stack([true_offsets(rows, h, timing, truth)[:, a] for a, h in enumerate(heights)], dim=-1)
    error = (offsets - wanted).abs()
    off = ~(error < OUTLIER).all(-1)  # includes NaN, a failed band
    return {"rms_px": error[~off].square().mean(0).sqrt().tolist(), "share_off": off.double().mean().item()}


def benchmark_registration(
    frames: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, options: argparse.Namespace
) -> list[dict[str, Any]]:
    """Time and error of each method for all bands of the pair."""
    band = {"band_rows": BAND_ROWS, "band_step": BAND_STEP}
    array = frames.numpy()
    tops = list(range(0, frames.shape[-2] - BAND_ROWS + 1, BAND_STEP))
    works: dict[str, Callable[[], Any]] = {}
    for device in options.device:
        taken = frames.to(device)
        for method in METHODS:
            works[named(method, device)] = lambda m=method, f=taken: rsv.register_bands(f, timing, method=m, **band)
    works |= {name: lambda p=peer: p(array, tops, BAND_ROWS) for name, peer in PEERS.items()}
    results = []
    for name, done in in_turns(works, options.runs).items():
        found = done.result
        heights = (BAND_ROWS, BAND_ROWS) if name in PEERS else found.heights
        offsets = torch.from_numpy(found) if name in PEERS else found.offsets[0].cpu()
        results.append({"method": name, **done.figures(), **_accuracy(offsets, heights, tops, timing, truth)})
    return with_ratios(results)


def with_ratios(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The results with their speed relative to the loop of skimage, which is the last one."""
    return [{**result, "ratio": results[-1]["seconds"] / result["seconds"]} for result in results]


def fastest_method(frames: Tensor, timing: rsv.SensorTiming, runs: int) -> tuple[str, dict[str, Timed]]:
    """The fastest registration method of the package, and the times of all."""
    works = {m: lambda m=m: rsv.register_bands(frames, timing, method=m) for m in METHODS}
    done = in_turns(works, runs)
    return min(done, key=lambda method: done[method].seconds), done


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Registration of a pair of frames of a drawn scene."""
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=max(2048, options.size))
    generator = torch.Generator().manual_seed(SEED)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    truth = rsv.Vibration([3.1, 5.2], [50.0, 30.0], phase)
    scene = city_and_fields(options.size + 2 * MARGIN, options.size + 2 * MARGIN, SEED)
    noise, size = rsv.SensorNoise(read_noise=NOISE), (options.size, options.size)
    frames = rsv.simulate_frames(scene, timing, truth, 2, frame_size=size, noise=noise, generator=generator)
    return benchmark_registration(frames, timing, truth, options)


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """The figures as a Markdown table."""
    bands = (options.size - BAND_ROWS) // BAND_STEP + 1
    lines = [
        f"Registration: {options.size} x {options.size} px, noise {100 * NOISE:g} % of full scale. Seconds are medians "
        f"of {options.runs} alternating runs (range).",
        "",
        f"| registration of {bands} bands | seconds | skimage loop / this | rms x, y (px) | failed or error "
        f"> {OUTLIER} px |",
        "|---|---|---|---|---|",
    ]
    for r in results:
        rms = ", ".join(f"{value:.4f}" for value in r["rms_px"])
        lines.append(
            f"| {r['method']} | {shown_seconds(r)} | {r['ratio']:.1f} | {rms} | {100 * r['share_off']:.1f} % |"
        )
    return lines
