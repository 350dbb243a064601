"""Verdict on a restoration, compared with its true gain.

Random scenes with random vibrations, exposures and noise levels are restored with the correct, a partly correct and a
wrong vibration. The true gain is the PSNR of the restored frames minus that of the input frames in dB, relative to the
scene at rest. Frames come from a camera that is independent of the package.
"""

import argparse
import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from benchmarks.independent_camera import Array, Shake, closed, decibel, take_frames
from benchmarks.resolution_chart import resolution_chart
from harness import Rows, table

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.restoration import judge_restoration, restore

OPTIONS = {
    "verdict_draws": (60, "verdict: random recordings"),
    "verdict_seed": (0, "verdict: seed of the first recording"),
}
QUICK = {"verdict_draws": 1}
HEIGHT, WIDTH, MARGIN, RIM = 384, 192, 48, 32
ROW_TIME = 4e-5
NOISES = (0.0, 0.002, 0.005, 0.01, 0.02, 0.04)
EXPOSURES = (5, 20, 50, 100, 200)
OUTCOMES = ("helps", "unknown", "partly", "worse")

Motion = tuple[Array, Array, Array]  # amplitude in px, frequency in Hz and phase of one tone per axis (x, y)


def drawn(generator: np.random.Generator) -> Motion:
    """A random motion: 0.1 to 6 px, 20 to 150 Hz."""
    amplitude = np.exp(generator.uniform(math.log(0.1), math.log(6.0), 2))
    return amplitude, generator.uniform(20.0, 150.0, 2), generator.uniform(-math.pi, math.pi, 2)


def vibration_of(motion: Motion) -> rsv.Vibration:
    """A ``Vibration``; a negative amplitude becomes a phase of pi."""
    amplitude, frequency, phase = (torch.from_numpy(values) for values in motion)
    return rsv.Vibration(amplitude.abs(), frequency, phase + math.pi * (amplitude < 0))


# the motion that is restored with, from the true one and random numbers, and options of restore
HYPOTHESES: dict[str, tuple[Callable[[Array, Array, Array, np.random.Generator], Motion], dict[str, Any]]] = {
    "correct": (lambda a, f, p, _: (a, f, p), {}),
    "correct, dewarp": (lambda a, f, p, _: (a, f, p), {"method": "dewarp"}),
    "correct, one axis": (lambda a, f, p, _: (a * [0, 1], f, p), {}),
    "amplitude +10 %": (lambda a, f, p, _: (1.1 * a, f, p), {}),
    "amplitude x 0.5": (lambda a, f, p, _: (0.5 * a, f, p), {}),
    "y inverted": (lambda a, f, p, _: (a * [1, -1], f, p), {}),
    "phase + pi / 2": (lambda a, f, p, _: (a, f, p + math.pi / 2), {}),
    "inverted": (lambda a, f, p, _: (a, f, p + math.pi), {}),
    "other vibration": (lambda a, f, p, generator: drawn(generator), {}),
    "other frequency": (lambda a, f, p, generator: (a, generator.uniform(20.0, 150.0, 2), p), {"method": "dewarp"}),
    "too little smoothing": (lambda a, f, p, _: (a, f, p), {"regularisation": 1e-4}),
    "too much smoothing": (lambda a, f, p, _: (a, f, p), {"regularisation": 1e4}),
}


def cases(draw: int) -> Rows:
    """All hypotheses on one random recording of two frames: the outcome, and the estimated and true gain in dB."""
    generator = np.random.default_rng(draw)
    size = (HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN)
    scene = city_and_fields(*size, draw) if generator.random() < 0.7 else resolution_chart(*size, seed=draw)
    exposure, noise = int(generator.choice(EXPOSURES)), float(generator.choice(NOISES))
    truth = drawn(generator)
    timing = rsv.SensorTiming(row_time=ROW_TIME, exposure_rows=exposure, frame_rows=int(generator.integers(384, 700)))
    periodic = closed(scene.double().numpy(), 24)
    taken = take_frames(periodic, Shake.of(vibration_of(truth)), timing, 2, (HEIGHT, WIDTH))
    frames = torch.from_numpy(taken + noise * generator.standard_normal(taken.shape)).float()
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN].double().numpy()
    found = []
    for name, (hypothesis, options) in HYPOTHESES.items():
        claimed = vibration_of(hypothesis(*truth, generator))
        restored = restore(frames, timing, claimed, check=False, **options)
        verdict = judge_restoration(frames, restored, timing, claimed)
        gain = decibel(restored, still, RIM) - decibel(frames, still, RIM)
        case = {"draw": draw, "hypothesis": name, "exposure_rows": exposure, "noise": noise, "gain_db": gain}
        found.append(case | {"outcome": verdict.overall, "predicted_gain": float(verdict.predicted_gain)})
    return found


def rows(options: argparse.Namespace) -> Rows:
    return [row for draw in range(options.verdict_draws) for row in cases(options.verdict_seed + draw)]


def lines(results: Rows, options: argparse.Namespace, tie: float = 0.3) -> list[str]:
    """Outcomes by the true gain, of which those within ``tie`` dB count as equal, and the outcome "worse"."""
    counts = Counter(((row["gain_db"] > tie) - (row["gain_db"] < -tie), row["outcome"]) for row in results)
    gains = ((f"> {tie} dB", 1), (f"within {tie} dB", 0), (f"< -{tie} dB", -1))
    text = table(("true gain", *OUTCOMES), [(name, *(counts[sign, one] for one in OUTCOMES)) for name, sign in gains])
    better, worse = (sum(counts[sign, one] for one in OUTCOMES) for sign in (1, -1))
    index = counts[-1, "worse"] / max(worse, 1) - counts[1, "worse"] / max(better, 1)
    return [*text, f'Sensitivity plus specificity minus 1 of the outcome "worse": {index:.3f}.']
