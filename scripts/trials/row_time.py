#!/usr/bin/env python
"""Row time from motion: errors, stated standard deviations and wrong results on frames of an independent camera.

Every case is simulated with several noise seeds, and with phases and (case "random") frequencies of a seed. Printed are
the rms error of the row time in per cent, the rms ratio of error to stated standard deviation, the coverage of the
95 % intervals, the number of results that are reliable, and of those that are reliable and wrong by more than 1 %.
"""

import argparse
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.detection_cases import RIM
from benchmarks.independent_camera import Array, Shake, closed, take_frames

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.evaluation.bound import Recording, projected_information

FRAME_PERIOD, READOUT, EXPOSURE = 1 / 30, 25.6e-3, 5e-4  # s
NOISE = 0.005


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
    frames = take_frames(
        scene,
        shake,
        row_time=row_time,
        exposure_rows=EXPOSURE / row_time,
        frame_rows=FRAME_PERIOD / row_time,
        num_frames=num_frames,
        size=(size, size),
    )
    return frames, scene


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
    each = projected_information(recording)
    merge = torch.eye(len(axes), dtype=torch.float64)[:, :-1]
    merge[-1, -1] = 1.0
    information = merge.T @ each @ merge
    scale = information.diagonal().rsqrt()
    inverse = torch.linalg.inv(information * scale * scale[:, None]) * scale * scale[:, None]
    return NOISE * float(inverse[-1, -1].sqrt())


def run(case: Case, options: argparse.Namespace) -> None:
    """Print the figures of one case."""
    row_time = READOUT / options.size
    rows, stds, wrong, reliable, begin = [], [], 0, 0, time.perf_counter()
    frames, scene, shake = None, None, shake_of(case, options.first)
    for seed in range(options.first, options.first + options.seeds):
        if frames is None or case is CASES["random"] or options.new_motions:
            shake = shake_of(case, seed)
            frames, scene = taken(shake, options.size, options.frames, 3)
        noisy = frames + NOISE * np.random.default_rng(1000 + seed).standard_normal(frames.shape)
        found = rsv.calibrate_row_time_by_motion(
            torch.from_numpy(noisy).float(),
            frame_rate=1 / FRAME_PERIOD,
            row_time=None if case.limits is None else tuple(part * row_time for part in case.limits),
            readout_direction=case.direction,
            exposure_time=EXPOSURE,
        )
        error = (found.row_time or math.nan) / row_time - 1
        stated = (found.row_time_std or math.nan) / row_time
        off = not abs(error) < 0.01 or found.readout_direction != "forward"
        wrong += found.reliable and off
        reliable += found.reliable
        if found.reliable and not off:
            rows.append(error)
            stds.append(stated)
        if options.verbose:
            why = "" if found.reliable else f" ({found.reasons[0][:90]})"
            print(f"  {seed}: {100 * error:+.5f} ± {100 * stated:.5f} %{why}", flush=True)
    line = f"{case.name}: {options.seeds} results, {reliable} reliable, {wrong} of them wrong"
    if rows:
        errors = np.array(rows)
        ratio = errors / np.array(stds)
        line += (
            f"; rms error {100 * np.sqrt(np.mean(errors**2)):.5f} %, largest {100 * np.abs(errors).max():.5f} %, "
            f"over stated std {np.sqrt(np.mean(ratio**2)):.2f}, "
            f"95 % intervals cover {np.mean(np.abs(ratio) < 1.96):.0%}"
        )
    if options.bound and case is not CASES["free"] and scene is not None:
        line += f"; bound {100 * bound(scene, shake, options.size, options.frames) / row_time:.5f} %"
    print(f"{line}; {(time.perf_counter() - begin) / options.seeds:.0f} s each", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--size", type=int, default=256, help="rows and columns")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--new-motions", action="store_true", help="new phases for every seed")
    parser.add_argument("--bound", action="store_true", help="also compute the Cramér-Rao bound")
    parser.add_argument("--verbose", action="store_true", help="print every result")
    options = parser.parse_args()
    for name in options.cases:
        run(CASES[name], options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
