"""Frames whose times are far apart, in another unit, or have gaps: a right answer, or a refusal, at bounded cost."""

import random
from collections.abc import Iterator
from dataclasses import replace
from itertools import accumulate
from pathlib import Path

import torch
from attacks.files import BANDS, DETECTION, FULL_SCALE, vibrating_counts
from attacks.trial import Trial
from attacks.warm import in_warm_child
from small_stack import TIMING

import rsvib_torch as rsv

_FUNCTIONS = ("detect_vibration", "detect_motion", "tracker", "restore")
_UNITS = (1.0, 1.0, 1e3, 1e6, 1e9, 1e12)  # factors of the stated times; 1: they are true
_TRUE = torch.tensor([[130.0], [170.0]], dtype=torch.float64)  # Hz, of ``vibrating_counts``


def attempt(folder: Path, item: int) -> str:
    """Frames at random times, and one function."""
    choice = random.Random(item)
    name, unit, count = _FUNCTIONS[item % len(_FUNCTIONS)], choice.choice(_UNITS), choice.choice((3, 8, 24, 64))
    longest = choice.choice((1, 5, 100, 10**4))  # frame periods
    steps = [choice.choice((1, 1, choice.randint(1, longest))) for _ in range(count)]
    starts = [TIMING.frame_period * step for step in accumulate(steps)]
    counts = vibrating_counts(replace(TIMING, frame_start_times=starts), count, (96, 64))
    frames = torch.from_numpy(counts / FULL_SCALE).float()
    timing = replace(TIMING, frame_start_times=[unit * start for start in starts])
    if name == "detect_vibration":
        found = rsv.detect_vibration(frames, timing, **DETECTION)
        error = (found.vibration.frequency - _TRUE).abs() / found.std.frequency
        return f"{error.flatten().tolist()} std" if unit == 1 and (error[found.reliable] > 5).any() else ""
    if name == "tracker":
        tracker = rsv.VibrationTracker(TIMING, window=8)
        results = [tracker.update(frame, unit * start) for frame, start in zip(frames, starts, strict=True)]
        return "" if all(torch.isfinite(one.restored).all() for one in results) else "not finite"
    if name == "restore":
        vibration = rsv.Vibration([1.2, 0.8], [130.0, 170.0], [0.3, 0.9])
        return "" if rsv.restore(frames, timing, vibration, check=False).isfinite().all() else "not finite"
    getattr(rsv, name)(frames, timing, **BANDS)
    return ""


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """The functions in turn."""
    items = range(seed * 10**6, seed * 10**6 + count)
    names = (f"{_FUNCTIONS[item % len(_FUNCTIONS)]}, seed {item}" for item in items)
    yield from in_warm_child(attempt, zip(names, items, strict=True), folder)
