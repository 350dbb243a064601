"""Time of detection in seconds and in FFT round trips (rfft2 and irfft2 of one frame), for two and four frames."""

import argparse
from typing import Any

import torch
from benchmarks.measure import in_turns, named, shown_seconds

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields

SEED, NOISE = 11, 0.005
MARGIN = 40


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Time of each method for two and four frames, alternating with the round trip."""
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=options.size)
    vibration = rsv.Vibration([3.1, 5.2], [50.0, 30.0], [0.7, 2.1])
    scene = city_and_fields(options.size + 2 * MARGIN, options.size + 2 * MARGIN, seed=SEED)
    frames = rsv.simulate_frames(scene, timing, vibration, 4, frame_size=(options.size, options.size))
    frames = frames + NOISE * torch.randn(frames.shape, generator=torch.Generator().manual_seed(SEED))
    results = []
    for device in options.device:
        taken = frames.to(device)
        tasks = {"round trip": lambda f=taken: torch.fft.irfft2(torch.fft.rfft2(f[0]))}
        for method in ("bands", "direct"):
            for count in (2, 4):
                tasks[f"{method}, {count} frames"] = lambda m=method, f=taken[:count]: rsv.detect_vibration(
                    f, timing, method=m
                )
        done = in_turns(tasks, options.runs)
        unit = done["round trip"].seconds
        results += [
            {"name": named(name, device), **timed.figures(), "round_trips": timed.seconds / unit}
            for name, timed in done.items()
        ]
    return results


def lines(rows: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """The table in Markdown."""
    text = [f"| detection, {options.size}^2 | seconds | FFT round trips |", "|---|---|---|"]
    return text + [f"| {row['name']} | {shown_seconds(row)} | {row['round_trips']:.1f} |" for row in rows]
