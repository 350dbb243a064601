#!/usr/bin/env python
"""Roll and zoom: errors of detection, its stated standard deviations, and the Cramér-Rao bound.

Frames come from the camera of benchmarks/honesty_camera.py. Every case is one motion with several noise seeds. Printed
for every parameter are the bound, the rms error over the bound, the rms error over the stated standard deviation, and
the share of the 95 % intervals that contain the truth.
"""

import argparse
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import map_coordinates

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.honesty_camera import FINER, MARGIN, Array, Layer, Motion, fine_shape, seen_by_pixels, take_frames
from benchmarks.honesty_scenes import city

import rsvib_torch as rsv
from rsvib_torch.evaluation import cramer_rao_bound

NOISE, FRAMES = 0.005, 4
READOUT, FRAME_PERIOD, EXPOSURE = 24.6e-3, 25.6e-3, 2e-4  # s
OPTICS = 0.7  # px, standard deviation
RIM = 32  # px of the scene of the bound beyond the frame
NAMES = ("x", "y", "roll", "zoom")
PARAMETERS = ("amplitude", "frequency", "phase")


@dataclass(frozen=True)
class Case:
    """Tones of x (px), y (px), roll (rad) and zoom, one of each axis; amplitude 0 for none."""

    name: str
    amplitude: tuple[float, ...]
    frequency: tuple[float, ...]
    phase: tuple[float, ...] = (0.3, 1.1, 2.0, 0.7)

    def vibration(self) -> rsv.Vibration:
        """The motion, with as many axes as have a tone."""
        axes = 2 + sum(size > 0 for size in self.amplitude[2:])
        return rsv.Vibration(*(values[:axes] for values in (self.amplitude, self.frequency, self.phase)))


CASES = {
    "roll": Case("three axes, roll 1 mrad", (3.0, 5.0, 1e-3), (90.0, 61.0, 70.0)),
    "weak": Case("three axes, roll 0.5 mrad", (3.0, 5.0, 5e-4), (90.0, 61.0, 70.0)),
    "strong": Case("three axes, roll 2 mrad", (3.0, 5.0, 2e-3), (90.0, 61.0, 70.0)),
    "same": Case("roll with the frequency of x", (3.0, 5.0, 1e-3), (70.0, 61.0, 70.0)),
    "zoom": Case("four axes, zoom 5e-4", (3.0, 5.0, 1e-3, 5e-4), (90.0, 61.0, 70.0, 53.0)),
    "none": Case("no roll", (3.0, 5.0), (90.0, 61.0)),
}

FREE = {"free": 3, "free zoom": 4, "free none": 2}  # random motions with so many axes


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def timing_of(size: int) -> rsv.SensorTiming:
    """A camera with the same times for every number of rows."""
    row_time = READOUT / size
    return rsv.SensorTiming(row_time, EXPOSURE / row_time, FRAME_PERIOD / row_time)


def motion_of(vibration: rsv.Vibration) -> Motion:
    """The components as a function of times."""

    def components(times: Array) -> Array:
        parts = [
            (size * np.sin(2 * np.pi * hertz * times + phase))
            for size, hertz, phase in zip(*(getattr(vibration, n)[:, 0].tolist() for n in PARAMETERS), strict=True)
        ]
        return np.stack(parts + [np.zeros(times.shape)] * (4 - len(parts)))

    return components


def scene_of(size: int, seed: int, optics: float) -> tuple[Layer, torch.Tensor]:
    """A drawn city as a layer of the camera, and its pixels at rest, ``RIM`` px larger on each side than the frame."""
    layer = Layer(seen_by_pixels(city(fine_shape(size, size), np.random.default_rng(seed)), optics))
    place = FINER * (np.arange(-RIM, size + RIM) + MARGIN + 0.5)  # as in take_frames
    pixels = map_coordinates(layer.light, np.meshgrid(place, place, indexing="ij"), np.float64, prefilter=False)
    return layer, torch.from_numpy(pixels)


def run(case: Case, options: argparse.Namespace) -> None:
    """Print the table of one case."""
    size, timing, truth = options.size, timing_of(options.size), case.vibration()
    axes = max(truth.num_axes, options.axes)
    layer, scene = scene_of(size, 3, options.optics)
    starts = timing.row_starts(FRAMES, size).numpy()
    frames = take_frames([layer], motion_of(truth), starts, EXPOSURE, size)
    bound = cramer_rao_bound(scene, timing, truth, FRAMES, noise=NOISE, frame_size=(size, size), method=options.bound)
    errors: dict[tuple[int, str], list[tuple[float, float]]] = {}
    begin, refused, wrong_tones = time.perf_counter(), [], 0
    for seed in range(options.first, options.first + options.seeds):
        noisy = frames + NOISE * np.random.default_rng(seed).standard_normal(frames.shape)
        found = rsv.detect_vibration(
            torch.from_numpy(noisy).float(), timing, roll=options.auto or axes > 2, zoom=options.auto or axes > 3
        )
        refused += [f"{seed}: {NAMES[axis]} {'; '.join(why)}" for axis, why in enumerate(found.reasons) if why]
        if found.vibration.num_axes != truth.num_axes or bool((found.vibration.amplitude[:, 1:] > 0).any()):
            wrong_tones += 1
            if options.verbose:
                print(found)
        for axis, name in np.ndindex(min(truth.num_axes, found.vibration.num_axes), len(PARAMETERS)):
            value, true, std = (
                getattr(part, PARAMETERS[name])[axis, 0] for part in (found.vibration, truth, found.std)
            )
            error = float(value - true)
            if PARAMETERS[name] == "phase":
                error = math.remainder(error, 2 * math.pi)
            errors.setdefault((axis, PARAMETERS[name]), []).append((error, float(std)))
    seconds = (time.perf_counter() - begin) / options.seeds
    print(
        f"\n{case.name}: {size} px, {options.seeds} seeds, {seconds:.1f} s each, {len(refused)} axes refused, "
        f"{wrong_tones} results with other axes or further tones\n"
    )
    print(
        "| axis | parameter | bound | rms error / bound | mean error / bound | rms error / std | coverage |\n"
        + "|---" * 7
        + "|"
    )
    for (axis, name), pairs in errors.items():
        error, std = np.array(pairs).T
        least = float(getattr(bound, name)[axis, 0])
        ratio = error / std
        print(
            f"| {NAMES[axis]} | {name} | {least:.3g} | {rms(error) / least:.2f} | {error.mean() / least:+.2f} "
            f"| {rms(ratio):.2f} | {np.mean(np.abs(ratio) < 1.96):.0%} |",
            flush=True,
        )
    for text in refused:
        print(text)


def free_components(seed: int, axes: int) -> Motion:
    """Random motion below about 100 Hz: 1.5 px rms along x and y, roll of 1 mrad, zoom of 1e-3."""
    generator, frequency = np.random.default_rng(seed), np.linspace(1.0, 120.0, 100)
    spectrum = np.exp(-0.5 * (frequency / 40.0) ** 2)
    amplitude = spectrum * np.sqrt(-np.log(generator.uniform(size=(4, 100))))
    size = np.array([1.5, 1.5, 1e-3, 1e-3]) * (np.arange(4) < axes)
    amplitude *= np.sqrt(2) * size[:, None] / np.linalg.norm(amplitude, axis=1, keepdims=True)
    phase = generator.uniform(-np.pi, np.pi, (4, 100))

    def components(times: Array) -> Array:
        angle = 2 * np.pi * frequency * times[..., None] + phase[(slice(None), *(None,) * times.ndim)]
        return np.asarray((amplitude[(slice(None), *(None,) * times.ndim)] * np.sin(angle)).sum(-1))

    return components


def run_free(axes: int, options: argparse.Namespace) -> None:
    """Print the table of random motions, a new one for every seed."""
    size, timing = options.size, timing_of(options.size)
    layer, _ = scene_of(size, 3, options.optics)
    starts = timing.row_starts(FRAMES, size).numpy()
    whole, between, seconds, refused = [], [], [], []
    for seed in range(options.first, options.first + options.seeds):
        motion = free_components(seed, axes)
        frames = take_frames([layer], motion, starts, EXPOSURE, size)
        noisy = frames + NOISE * np.random.default_rng(seed).standard_normal(frames.shape)
        begin = time.perf_counter()
        found = rsv.detect_motion(torch.from_numpy(noisy).float(), timing, roll=axes > 2, zoom=axes > 3)
        seconds.append(time.perf_counter() - begin)
        refused += [f"{seed}: {NAMES[axis]} {'; '.join(why)}" for axis, why in enumerate(found.reasons) if why]
        true = motion(found.times.numpy())[:axes].transpose(1, 2, 0)
        error = found.displacement.numpy() - (true - true.mean((0, 1)))
        ratio = error / found.std.numpy()
        # of the rows that show one scene row, less the mean over the frames
        rows = np.arange(0.1 * size, 0.9 * size)
        times = FRAME_PERIOD * np.arange(FRAMES)[:, None] + READOUT / size * rows
        for _ in range(20):
            times = FRAME_PERIOD * np.arange(FRAMES)[:, None] + READOUT / size * (rows + motion(times)[1])
        times += 0.5 * EXPOSURE
        seen = found.motion.displacement(torch.from_numpy(times)).numpy() - motion(times)[:axes].transpose(1, 2, 0)
        seen -= seen.mean(0)
        whole.append(
            [np.sqrt(np.mean(part**2, (0, 1))) for part in (true, error, ratio)]
            + [np.mean(np.abs(ratio) < 1.96, (0, 1))]
        )
        between.append([np.sqrt(np.mean(seen**2, (0, 1))), found.std_seen.numpy()])
    table, parts = np.array(whole), np.array(between)
    print(
        f"\nfree motion, {axes} axes: {size} px, {options.seeds} seeds, {np.mean(seconds):.1f} s each, "
        f"{len(refused)} axes refused\n"
    )
    print(
        "| axis | rms motion | rms error | error / std | coverage | rms error between frames | over its std |\n"
        + "|---" * 7
        + "|"
    )
    for axis in range(axes):
        motion_, error_, ratio_ = (np.sqrt(np.mean(table[:, i, axis] ** 2)) for i in range(3))
        seen_, std_ = (np.sqrt(np.mean(parts[:, i, axis] ** 2)) for i in range(2))
        print(
            f"| {NAMES[axis]} | {motion_:.3g} | {error_:.2g} | {ratio_:.2f} | {table[:, 3, axis].mean():.0%} "
            f"| {seen_:.2g} | {seen_ / std_:.2f} |",
            flush=True,
        )
    for text in refused:
        print(text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=[*CASES, *FREE], default=[*CASES, *FREE])
    parser.add_argument("--size", type=int, default=512, help="rows and columns")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--axes", type=int, default=2, help="measure at least so many axes")
    parser.add_argument("--auto", action="store_const", const="auto", default=False, help="roll='auto', zoom='auto'")
    parser.add_argument("--bound", choices=("projection", "gradients", "random"), default="random")
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--optics", type=float, default=OPTICS, help="px, standard deviation")
    options = parser.parse_args()
    for name in options.cases:
        if name in FREE:
            run_free(FREE[name], options)
        else:
            run(CASES[name], options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
