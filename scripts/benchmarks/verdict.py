"""Receiver operating characteristic of the verdict on a restoration.

Random scenes with random vibrations, exposures and noise levels are restored with the correct, a partly correct and a
wrong vibration. The true gain is the PSNR of the restored frames minus that of the input frames in dB, relative to the
scene at rest. The tables contain the outcomes by the true gain, the area under the ROC curve of each score, and the
thresholds with the largest sum of sensitivity and specificity. Frames come from a camera that is independent of the
package.
"""

import argparse
import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from benchmarks.finer import decibel
from benchmarks.independent_camera import Shake, closed, take_frames
from harness import Rows, one_thread, table
from scipy.stats import mannwhitneyu
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields, resolution_chart
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

Arrays = dict[str, np.ndarray[Any, np.dtype[np.float64]]]
Hypothesis = Callable[[Arrays, np.random.Generator], Arrays]


def _changed(name: str, change: Callable[[Any], Any]) -> Hypothesis:
    return lambda truth, generator: {**truth, name: change(truth[name])}


def draw_vibration(generator: np.random.Generator) -> Arrays:
    """Amplitude 0.1-6 px, frequency 20-150 Hz and phase of one tone per axis (x, y)."""
    return {
        "amplitude": np.exp(generator.uniform(math.log(0.1), math.log(6.0), 2)),
        "frequency": generator.uniform(20.0, 150.0, 2),
        "phase": generator.uniform(-math.pi, math.pi, 2),
    }


HYPOTHESES: dict[str, tuple[str, Hypothesis, dict[str, Any]]] = {  # name: (group, vibration, options of restore)
    "correct": ("correct", lambda truth, generator: truth, {}),
    "correct, dewarp": ("correct", lambda truth, generator: truth, {"method": "dewarp"}),
    "correct, one axis": ("correct", _changed("amplitude", lambda a: a * [0, 1]), {}),
    "amplitude +10 %": ("correct", _changed("amplitude", lambda a: 1.1 * a), {}),
    "amplitude x 0.5": ("half", _changed("amplitude", lambda a: 0.5 * a), {}),
    "y inverted": ("half", _changed("amplitude", lambda a: a * [1, -1]), {}),
    "phase + pi / 2": ("half", _changed("phase", lambda p: p + math.pi / 2), {}),
    "inverted": ("wrong", _changed("phase", lambda p: p + math.pi), {}),
    "other vibration": ("wrong", lambda truth, generator: draw_vibration(generator), {}),
    "other frequency": (
        "wrong",
        lambda truth, generator: {**truth, "frequency": generator.uniform(20.0, 150.0, 2)},
        {"method": "dewarp"},
    ),
    "too little smoothing": ("smoothing", lambda truth, generator: truth, {"regularisation": 1e-4}),
    "too much smoothing": ("smoothing", lambda truth, generator: truth, {"regularisation": 1e4}),
}


def as_vibration(arrays: Arrays) -> rsv.Vibration:
    """A ``Vibration``; a negative amplitude becomes a phase of pi."""
    phase = arrays["phase"] + np.where(arrays["amplitude"] < 0, math.pi, 0.0)
    return rsv.Vibration(np.abs(arrays["amplitude"]).tolist(), arrays["frequency"].tolist(), phase.tolist())


def cases(draw: int) -> Rows:
    """All hypotheses on one random recording of two frames: verdict, its scores, and the true gain in dB."""
    generator = np.random.default_rng(draw)
    size = (HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN)
    scene = city_and_fields(*size, draw) if generator.random() < 0.7 else resolution_chart(*size, seed=draw)
    exposure, noise = int(generator.choice(EXPOSURES)), float(generator.choice(NOISES))
    truth = draw_vibration(generator)
    timing = rsv.SensorTiming(row_time=ROW_TIME, exposure_rows=exposure, frame_rows=int(generator.integers(384, 700)))
    vibration = as_vibration(truth)
    periodic = closed(scene.double().numpy(), 24)
    taken = take_frames(periodic, Shake.of(vibration), timing, 2, (HEIGHT, WIDTH))
    frames = torch.from_numpy(taken + noise * generator.standard_normal(taken.shape)).float()
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN].double()
    raw = decibel(frames, still.numpy(), RIM)
    found = []
    for name, (group, hypothesis, options) in HYPOTHESES.items():
        claimed = as_vibration(hypothesis(truth, generator))
        restored = restore(frames, timing, claimed, check=False, **options)
        verdict = judge_restoration(frames, restored, timing, claimed)
        found.append(
            {
                "draw": draw,
                "hypothesis": name,
                "group": group,
                "exposure_rows": exposure,
                "noise": noise,
                "raw_db": raw,
                "gain_db": decibel(restored, still.numpy(), RIM) - raw,
                "moves": (claimed.amplitude[:, 0] > 0).tolist(),
                "outcome": verdict.overall,
                "reason": verdict.reasons[0],
                "predicted_gain": float(verdict.predicted_gain),
                "chi_square": float(verdict.chi_square),
                **{key: getattr(verdict, key)[0].tolist() for key in ("misfit_before", "misfit_after", "resolution")},
            }
        )
    return found


def best_threshold(score: Tensor, positive: Tensor) -> tuple[float, float, float]:
    """Threshold with the largest sum of sensitivity and specificity, and these two."""
    values = score.sort().values
    rates = [
        (float((score[positive] > value).double().mean()), float((score[~positive] <= value).double().mean()))
        for value in values
    ]
    best = max(range(len(rates)), key=lambda index: sum(rates[index]))
    return float(values[best]), *rates[best]


def residual(row: dict[str, Any]) -> float:
    """Largest residual displacement of an axis with motion, relative to that between the raw frames."""
    ratios = [
        after / max(before, least, 0.03) if after > max(least, 0.03) else 0.0
        for before, after, least, moves in zip(
            row["misfit_before"], row["misfit_after"], row["resolution"], row["moves"], strict=True
        )
        if moves
    ]
    return max(ratios, default=0.0)


def rows(options: argparse.Namespace) -> Rows:
    """All cases of the random recordings."""
    with one_thread():
        return [row for draw in range(options.verdict_draws) for row in cases(options.verdict_seed + draw)]


def lines(results: Rows, options: argparse.Namespace, tie: float = 0.3) -> list[str]:
    """Outcomes by the true gain, and the ROC of both scores; gains within ``tie`` dB count as equal."""
    counts = Counter(((row["gain_db"] > tie) - (row["gain_db"] < -tie), row["outcome"]) for row in results)
    gains = ((f"> {tie} dB", 1), (f"within {tie} dB", 0), (f"< -{tie} dB", -1))
    text = table(("true gain", *OUTCOMES), [(name, *(counts[sign, one] for one in OUTCOMES)) for name, sign in gains])
    visible = [row for row in results if row["outcome"] != "unknown"]
    motion = [row for row in visible if row["hypothesis"] != "amplitude +10 %" and row["group"] != "smoothing"]
    right = [row for row in visible if residual(row) < 0.35 and abs(row["gain_db"]) > tie]
    scores = {
        "residual displacement, for a wrong motion": (
            [residual(row) for row in motion],
            [row["group"] != "correct" for row in motion],
        ),
        "negated gain in dB, for a loss with the correct motion": (
            [-row["predicted_gain"] for row in right],
            [row["gain_db"] < 0 for row in right],
        ),
    }
    curves = []
    for name, (score, positive) in scores.items():
        values, truth = torch.tensor(score, dtype=torch.float64), torch.tensor(positive)
        if not bool(truth.any()) or bool(truth.all()):
            continue  # no curve without both kinds of cases
        threshold, sensitivity, specificity = best_threshold(values, truth)
        # the probability that a positive case has a higher score than a negative one, ties counted by half
        area = mannwhitneyu(values[truth], values[~truth]).statistic / (int(truth.sum()) * int((~truth).sum()))
        rates = (f"{value:.2f}" for value in (threshold, sensitivity, specificity))
        curves.append((name, f"{area:.3f}", *rates, len(truth)))
    heads = ("score", "area under the curve", "best threshold", "sensitivity", "specificity", "cases")
    return text + table(heads, curves)
