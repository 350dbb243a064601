"""Validation of standard deviations: errors over estimated standard deviations, on simulated recordings.

Free motions are random walks, smooth motions, sums of three tones, and single tones within 8 % of the frequency at
which all frames have the same displacement; five frames of drawn cities, noise 0.005. The error is that of the part of
the motion that differs between frames, and of the whole motion.

Calibrations have random row times and LED frequencies, in front of a plain wall, with 20 times the noise, of textured
scenes in one frame, strong and weak, and in four frames. 1 is expected for the root mean square of error over standard
deviation, 0.67 for the median of its absolute value.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import Rows, table
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

import rsvib_torch as rsv

_TESTS = Path(__file__).parents[2] / "tests"
sys.path += [str(_TESTS), str(_TESTS / "calibration")]

from motion_truth import common_warp, rms  # noqa: E402
from test_calibrate import HEIGHT, WIDTH, blink, record_frames, shaded, sine  # noqa: E402
from truth import Curve, draw_scene, take_frames  # noqa: E402

Array = NDArray[np.float64]
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=270)
FRAMES, ROWS, COLUMNS, NOISE, RIM = 5, 192, 160, 0.005, 12
KINDS = ("walk", "smooth", "tones", "blind")
CALIBRATIONS = ("wall", "noisy wall", "textured", "weakly textured", "textured, four frames")
OPTIONS = {
    "bar_kinds": ((*KINDS, *CALIBRATIONS), "error_bars: kinds of motions and calibrations", (*KINDS, *CALIBRATIONS)),
    "bar_motions": (12, "error_bars: motions of each kind"),
    "bar_seeds": (1, "error_bars: noise seeds of each motion"),
    "bar_recordings": (40, "error_bars: recordings of each calibration"),
}
QUICK = {"bar_kinds": ("walk", "wall"), "bar_motions": 1, "bar_recordings": 2}


def drawn(kind: str, seed: int) -> Curve:
    """A random motion of one kind."""
    draw = np.random.default_rng(seed)
    span = 1.2 * FRAMES * TIMING.frame_period
    times = np.linspace(-0.1 * span, span, 400)
    turns = times[:, None] / TIMING.frame_period
    if kind == "walk":
        path = gaussian_filter1d(np.cumsum(draw.standard_normal((400, 2)), 0), 8, axis=0)
        path *= 2.0 / path.std(0)
    elif kind == "smooth":
        path = np.cumsum(np.cumsum(draw.standard_normal((400, 2)), 0), 0)
        path = 3.0 * (path - path.mean(0)) / path.std(0)
    else:
        tones = [(draw.uniform(0.2, 1.8), draw.uniform(0.3, 2, 2)) for _ in range(3)]
        tones = tones if kind == "tones" else [(1 + draw.uniform(-0.08, 0.08), np.full(2, 1.5))]
        path = draw.uniform(-2, 2, 2) * turns
        for frequency, size in tones:
            path = path + size * np.sin(2 * np.pi * frequency * turns + draw.uniform(0, 2 * np.pi, 2))
    return Curve(CubicSpline(times, path))


def free_motion(kind: str, motions: int, seeds: int) -> dict[str, Any]:
    """Errors of the displacement over its standard deviations, and of the part that differs between frames."""
    pulls, seen = [], []
    moments = (TIMING.row_starts(FRAMES, ROWS) + 0.5 * TIMING.exposure_time).numpy()
    for number in range(motions):
        motion = drawn(kind, 100 + number)
        clean = take_frames(draw_scene(ROWS + 80, COLUMNS + 80, 20 + number % 5), TIMING, motion, FRAMES, 0.0)
        for seed in range(seeds):
            noise = NOISE * np.random.default_rng(seed).standard_normal(clean.shape)
            found = rsv.detect_motion(torch.from_numpy(clean + noise).float(), TIMING)
            error = found.displacement.numpy() - motion.displacement(found.times.numpy())
            pulls.append((error - error.mean((0, 1))) / found.std.numpy())
            truth = motion.displacement(moments)
            left = found.motion.displacement(torch.from_numpy(moments)).numpy() - truth
            left = left - common_warp(left, truth)
            seen.append(rms(left[:, RIM:-RIM]) / found.std_seen.numpy())
    between = float(np.sqrt(np.mean(np.square(seen))))
    return {"kind": kind, "number": motions * seeds, "between": between, **spread(np.ravel(pulls))}


def spread(pulls: Array) -> dict[str, float]:
    """Root mean square and median of errors over standard deviations, and the share within two."""
    size = np.abs(pulls)
    rms_ = float(np.sqrt(np.mean(size**2)))
    return {"rms": rms_, "median": float(np.median(size)), "within_two": float(np.mean(size < 2))}


def calibration(kind: str, count: int) -> dict[str, Any]:
    """Errors of the row time over its standard deviation."""
    pulls = []
    for seed in range(count):
        draw = np.random.default_rng(1000 + seed)
        row_time, frequency, start = 1e-6 * draw.uniform(8, 30), draw.uniform(500, 1500), draw.uniform(0, 1)
        city = draw_scene(HEIGHT, WIDTH, seed % 30)
        scene, contrast = {
            "textured": (0.5 * city, 0.5),
            "weakly textured": (0.35 + 0.05 * (city - 0.45), 0.3),
            "textured, four frames": (0.6 * city, 0.1),
        }.get(kind, (shaded(), 0.6))
        square = "wall" in kind and seed % 2 == 0

        def light(
            time: Array, frequency: float = frequency, contrast: float = contrast, square: bool = square
        ) -> Array:
            return np.asarray(blink(time, frequency) if square else sine(time, frequency, contrast))

        frames = record_frames(
            light,
            frames=4 if "four" in kind else 1,
            row_time=row_time,
            scene=scene,
            noise=0.06 if "noisy" in kind else 0.003,
            seed=seed,
            start=start,
        )
        try:
            found = rsv.calibrate_row_time(frames, frequency)
        except ValueError:
            continue
        pulls.append((found.row_time - row_time) / found.row_time_std)
    return {"kind": kind, "number": len(pulls), "between": None, **spread(np.array(pulls))}


def rows(options: argparse.Namespace) -> Rows:
    """All kinds."""
    return [
        free_motion(kind, options.bar_motions, options.bar_seeds)
        if kind in KINDS
        else calibration(kind, options.bar_recordings)
        for kind in options.bar_kinds
    ]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as a Markdown table."""
    cells = []
    for row in results:
        between = "" if row["between"] is None else f"{row['between']:.2f}"
        figures = (f"{row['rms']:.2f}", f"{row['median']:.2f}", f"{row['within_two']:.0%}")
        cells.append((row["kind"], row["number"], between, *figures))
    heads = (
        "motion or calibration",
        "results",
        "rms error / std between frames",
        "of the whole",
        "median",
        "within two",
    )
    return table(heads, cells)
