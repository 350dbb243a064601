"""Vibrations that were measured in orbit: the tones of other articles, seen by an independent camera and detected.

Zhao et al. 2022 (Acta Optica Sinica 42, 0228001, Table 1) measured tones of 155 Hz with a rolling-shutter camera of a
satellite. Zhu et al. 2022 (Remote Sensing 14, 342) recovered simulated tones of 100, 10 and 2 Hz to 0.02 px. Here the
frame rate and the exposure are those of Liu et al. 2023, and the scene is a drawn city.
"""

import argparse
from functools import cache
from typing import Any

import numpy as np
import torch
from benchmarks.independent_camera import POINTS_PER_PX, Array, Shake, after_optics, closed, take_frames
from harness import Rows, table

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

OPTIONS = {"orbit_size": ((512, 256), "orbit: rows and columns of the frames")}
QUICK = {"orbit_size": (256, 128)}
FRAME_PERIOD, EXPOSURE = 42.02e-3, 410e-6  # s; the rows are read out in the whole period
CASES = {  # frames, amplitudes in px and frequencies in Hz along x and y
    "Zhao 2022, area 1": (4, (0.181, 0.135), (156.036, 155.481)),
    "Zhao 2022, area 2": (4, (0.235, 0.195), (155.304, 155.835)),
    "Zhao 2022, area 3": (4, (0.283, 0.177), (154.812, 154.705)),
    "Zhu 2022, 100 Hz": (4, (1.0, 1.0), (100.0, 100.0)),
    "Zhu 2022, 10 Hz": (6, (1.0, 1.0), (10.0, 10.0)),
    "Zhu 2022, 2 Hz": (24, (1.0, 1.0), (2.0, 2.0)),
    "100 Hz, 0.02 px": (8, (0.02, 0.02), (100.0, 100.0)),
}
SIGMA, NOISE, MARGIN, FADE, SEED = 0.5, 0.005, 16, 24, 11


@cache
def scene_of(size: tuple[int, int]) -> Array:
    """A drawn city after the optics."""
    light = city_and_fields(*(POINTS_PER_PX * (side + 2 * MARGIN) for side in size), seed=SEED)
    return after_optics(closed(light.double().numpy(), FADE), SIGMA)


def case(name: str, size: tuple[int, int]) -> dict[str, Any]:
    """The detection of one case: what was found, and the errors of the displacement of all rows."""
    count, amplitude, frequency = CASES[name]
    draw = np.random.default_rng(SEED)
    phase = draw.uniform(-np.pi, np.pi, 2)
    shake = Shake(*(np.array(values)[:, None] for values in (amplitude, frequency, phase)), np.zeros(2))
    row_time = FRAME_PERIOD / size[0]
    timing = rsv.SensorTiming(row_time, EXPOSURE / row_time, size[0])
    frames = take_frames(scene_of(size), shake, timing, count, size, points=POINTS_PER_PX)
    frames += NOISE * draw.standard_normal(frames.shape)
    found = rsv.detect_vibration(torch.from_numpy(frames).float(), timing)
    # the displacement of all rows, less its mean, which frames do not determine
    times = timing.row_starts(count, size[0]).flatten() + 0.5 * timing.exposure_time
    error = found.vibration.displacement(times).numpy() - shake.displacement(times.numpy())
    error -= error.mean(0)
    return {
        "case": name,
        "frames": count,
        "true": [list(pair) for pair in zip(amplitude, frequency, strict=True)],
        "found": torch.stack([found.vibration.amplitude, found.vibration.frequency], -1)[:, 0].tolist(),
        "std": found.std.displacement.tolist(),
        "error": np.sqrt(np.square(error).mean(0)).tolist(),
        "reliable": found.reliable.tolist(),
    }


def rows(options: argparse.Namespace) -> Rows:
    return [case(name, tuple(options.orbit_size)) for name in CASES]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    height, width = options.orbit_size
    text = [
        f"Tones along x and y in frames of {height} x {width} px of an independent camera ({1 / FRAME_PERIOD:.1f} "
        f"frames per second, exposure {1e6 * EXPOSURE:.0f} µs, optics of σ = {SIGMA} px, noise {NOISE} of full scale). "
        "The error is that of the displacement of all rows (rms). Zhao et al. 2022 measured the first three in orbit. "
        "Zhu et al. 2022 state an accuracy of 0.02 px.",
        "",
    ]
    cells = []
    for row in results:
        tones = (", ".join(f"{size:.4f} px {hertz:.2f} Hz" for size, hertz in row[key]) for key in ("true", "found"))
        figures = (", ".join(f"{value:.4f}" for value in row[key]) for key in ("error", "std"))
        verdict = ", ".join("yes" if reliable else "no" for reliable in row["reliable"])
        cells.append((row["case"], row["frames"], *tones, *figures, verdict))
    return text + table(("case", "frames", "true", "found", "error (px)", "std (px)", "reliable"), cells)
