"""Cost of detection: seconds and FFT round trips (rfft2 and irfft2 of one frame) of pairs and of longer stacks."""

import argparse
from typing import Any

import torch
from benchmarks.measure import in_turns

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields

SEED, NOISE = 11, 0.005
MARGIN = 40


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Time of each method for two and four frames, in turns with the round trip."""
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=options.size)
    vibration = rsv.Vibration([3.1, 5.2], [50.0, 30.0], [0.7, 2.1])
    scene = city_and_fields(options.size + 2 * MARGIN, options.size + 2 * MARGIN, seed=SEED)
    frames = rsv.simulate_frames(scene, timing, vibration, 4, frame_size=(options.size, options.size))
    frames = frames + NOISE * torch.randn(frames.shape, generator=torch.Generator().manual_seed(SEED))
    tasks = {"round trip": lambda: torch.fft.irfft2(torch.fft.rfft2(frames[0]))}
    for method in ("bands", "direct"):
        for count in (2, 4):
            tasks[f"{method}, {count} frames"] = lambda m=method, n=count: rsv.detect_vibration(
                frames[:n], timing, method=m
            )
    seconds = {name: taken for name, (taken, _) in in_turns(tasks, options.runs).items()}
    return [{"name": name, "seconds": s, "round_trips": s / seconds["round trip"]} for name, s in seconds.items()]


def lines(rows: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """The table in Markdown."""
    text = [f"| detection, {options.size}^2 | seconds | FFT round trips |", "|---|---|---|"]
    return text + [f"| {row['name']} | {row['seconds']:.3f} | {row['round_trips']:.1f} |" for row in rows]
