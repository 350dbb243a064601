"""Row time from motion: errors, stated standard deviations and wrong results on frames of an independent camera.

Every case is simulated with several noise seeds, and case "random" with new amplitudes, frequencies and phases for each
of them. A result is wrong if it is reliable and off by more than 1 %, or has the wrong direction. The Cramér-Rao bound
is that with all tones and the image motion unknown.
"""

import argparse
import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from benchmarks.independent_camera import Array, Shake, closed, take_frames
from harness import Rows, table

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.evaluation.bound import Recording, projected_information

FRAME_PERIOD, READOUT, EXPOSURE = 1 / 30, 25.6e-3, 5e-4  # s
NOISE = 0.005
RIM = 24  # px; width of the border over which a scene fades to its mean


@dataclass(frozen=True)
class Case:
    """Tones of each axis (x, y), and the limits that are passed: part of the row time, and direction."""

    name: str
    amplitude: tuple[tuple[float, ...], tuple[float, ...]]
    frequency: tuple[tuple[float, ...], tuple[float, ...]]
    limits: tuple[float, float] | None = None
    direction: str | None = None


CASES = {
    "one": Case(
        "3 px 83 Hz along x, row time known to 12 %", ((3.0,), (0.0,)), ((83.0,), (1.0,)), (0.88, 1.12), "forward"
    ),
    "two": Case("3.1 px 83 Hz, 2.2 px 67 Hz", ((3.1,), (2.2,)), ((83.0,), (67.0,))),
    "slow": Case("3.1 px 10 Hz, 2.2 px 17 Hz", ((3.1,), (2.2,)), ((10.0,), (17.0,))),
    "four": Case("two tones per axis", ((1.5, 0.5), (1.1, 0.4)), ((41.0, 133.0), (67.0, 185.0))),
    "free": Case("free motion, 3 px rms, 6 Hz", ((), ()), ((), ()), (0.4, 1.3)),
    "same": Case("the same frequency on both axes: ambiguous", ((3.1,), (2.2,)), ((83.0,), (83.0,))),
    "random": Case("two random tones", ((), ()), ((), ())),
}

OPTIONS = {
    "row_time_cases": (tuple(CASES), "row_time: motions", CASES),
    "row_time_size": (256, "row_time: rows and columns"),
    "row_time_frames": (8, "row_time: frames"),
    "row_time_seeds": (20, "row_time: seeds"),
    "row_time_bound": (False, "row_time: also compute the Cramér-Rao bound"),
}
QUICK = {"row_time_cases": ("one",), "row_time_size": 128, "row_time_frames": 4, "row_time_seeds": 1}


def shake_of(case: Case, seed: int) -> Shake:
    """The motion with phases, and where the case leaves them open amplitudes and frequencies, of a seed."""
    generator = np.random.default_rng(seed)
    amplitude, frequency = np.array(case.amplitude), np.array(case.frequency)
    if case is CASES["free"]:
        frequency = np.tile(np.linspace(0.5, 24.0, 50), (2, 1))
        power = np.exp(-0.5 * (frequency / 6.0) ** 2) * -np.log(generator.uniform(size=frequency.shape))
        amplitude = 3.0 * np.sqrt(2 * power / power.sum(1, keepdims=True))
    if case is CASES["random"]:
        amplitude = generator.uniform(0.5, 4.0, (2, 1))
        frequency = np.exp(generator.uniform(math.log(8.0), math.log(220.0), (2, 1)))
    return Shake(amplitude, frequency, generator.uniform(-math.pi, math.pi, amplitude.shape), np.zeros(2))


def taken(shake: Shake, size: int, num_frames: int, seed: int) -> tuple[Array, Array]:
    """Frames without noise, and the scene."""
    reach = np.ceil(shake.reach((num_frames + 1) * FRAME_PERIOD)).astype(int) + RIM + 8
    scene = closed(city_and_fields(size + 2 * int(reach[1]), size + 2 * int(reach[0]), seed).double().numpy(), RIM)
    row_time = READOUT / size
    timing = rsv.SensorTiming(row_time, EXPOSURE / row_time, FRAME_PERIOD / row_time)
    return take_frames(scene, shake, timing, num_frames, (size, size)), scene


def bound(scene: Array, shake: Shake, size: int, num_frames: int) -> float:
    """Cramér-Rao bound of the row time in s, all tones and the image motion being unknown as well.

    The displacement by the row time along each axis is a parameter of its own; the row time changes both.
    """
    row_time = READOUT / size
    timing = rsv.SensorTiming(row_time, EXPOSURE / row_time, FRAME_PERIOD / row_time).in_row_order()
    motion = rsv.Vibration(*(torch.from_numpy(part) for part in (shake.amplitude, shake.frequency, shake.phase)))
    axes: list[int] = []

    def sensitivity(times: torch.Tensor) -> torch.Tensor:
        axes.clear()
        columns = []
        for axis, tone in np.ndindex(shake.amplitude.shape):
            size_, hertz, phase = (part[axis, tone] for part in (shake.amplitude, shake.frequency, shake.phase))
            if size_ > 0:
                turn = 2 * math.pi * hertz * times + phase
                columns += [turn.sin(), size_ * turn.cos(), size_ * turn.cos() * 2 * math.pi * times]
                axes.extend([axis] * 3)
        columns += [times, times]
        axes.extend([0, 1])
        rows = (times - (times / FRAME_PERIOD).floor() * FRAME_PERIOD) / row_time
        columns += [rows * part for part in motion.velocity(times).unbind(-1)]
        axes.extend([0, 1])
        return torch.stack(columns)

    sensitivity(torch.zeros(1, 1, dtype=torch.float64))
    recording = Recording(torch.from_numpy(scene), timing, motion, num_frames, (size, size), tuple(axes), sensitivity)
    separate = projected_information(recording)
    merge = torch.eye(len(axes), dtype=torch.float64)[:, :-1]
    merge[-1, -1] = 1.0
    information = merge.T @ separate @ merge
    scale = information.diagonal().rsqrt()
    inverse = torch.linalg.inv(information * scale * scale[:, None]) * scale * scale[:, None]
    return NOISE * float(inverse[-1, -1].sqrt())


def run(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Figures of one case, row times relative to the true one."""
    case, row_time, begin = CASES[name], READOUT / options.row_time_size, time.perf_counter()
    errors, stds, wrong, reliable, frames = [], [], 0, 0, None
    for seed in range(options.row_time_seeds):
        if frames is None or name == "random":
            shake = shake_of(case, seed)
            frames, scene = taken(shake, options.row_time_size, options.row_time_frames, 3)
        noisy = frames + NOISE * np.random.default_rng(1000 + seed).standard_normal(frames.shape)
        found = rsv.calibrate_row_time_by_motion(
            torch.from_numpy(noisy).float(),
            frame_rate=1 / FRAME_PERIOD,
            row_time=None if case.limits is None else tuple(part * row_time for part in case.limits),
            readout_direction=case.direction,
            exposure_time=EXPOSURE,
        )
        error = (found.row_time or math.nan) / row_time - 1
        off = not abs(error) < 0.01 or found.readout_direction != "forward"
        wrong += found.reliable and off
        reliable += found.reliable
        if found.reliable and not off:
            errors.append(error)
            stds.append((found.row_time_std or math.nan) / row_time)
    least = None
    if options.row_time_bound and name != "free":
        least = bound(scene, shake, options.row_time_size, options.row_time_frames) / row_time
    seconds = (time.perf_counter() - begin) / options.row_time_seeds
    figures = {"errors": errors, "stds": stds, "wrong": wrong, "reliable": reliable, "bound": least}
    return {"case": case.name, "seconds": seconds, **figures}


def rows(options: argparse.Namespace) -> Rows:
    """Figures of all cases."""
    return [run(name, options) for name in options.row_time_cases]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as a Markdown table."""
    heads = ("motion", "results", "reliable", "of these wrong", "rms error (%)", "largest (%)", "bound (%)")
    cells = []
    for row in results:
        errors, least = np.array(row["errors"]), row["bound"]
        figures = [""] * 4
        if len(errors):
            z = errors / np.array(row["stds"])
            figures = [f"{100 * np.sqrt(np.mean(errors**2)):.5f}", f"{100 * np.abs(errors).max():.5f}"]
            figures += [f"{np.sqrt(np.mean(z**2)):.2f}", f"{np.mean(np.abs(z) < 1.96):.0%}"]
        shown_bound = "" if least is None else f"{100 * least:.5f}"
        counts = (options.row_time_seeds, row["reliable"], row["wrong"])
        cells.append((row["case"], *counts, *figures[:2], shown_bound, *figures[2:], f"{row['seconds']:.0f}"))
    return table((*heads, "error / stated std", "within 95 %", "seconds of a result"), cells)
