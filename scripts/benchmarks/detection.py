"""Errors of detection, its stated standard deviations, and the Cramér-Rao bound, also of roll and zoom.

Frames come from the camera of ``honesty_camera``. Every case is one motion with several noise seeds; the free motions
are drawn for every seed. The bound is that for a random scene.
"""

import argparse
import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from benchmarks.honesty_camera import FINER, MARGIN, Array, Layer, Motion, fine_shape, seen_by_pixels, take_frames
from benchmarks.honesty_scenes import city
from harness import Rows, table
from scipy.ndimage import map_coordinates

import rsvib_torch as rsv
from rsvib_torch.evaluation import cramer_rao_bound

FRAMES = 4
READOUT, FRAME_PERIOD, EXPOSURE = 24.6e-3, 25.6e-3, 2e-4  # s
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
    "paper": Case("two axes of Liu et al. 2023", (3.1, 5.2), (50.0, 30.0)),
    "small": Case("two axes, amplitudes of 0.2 and 0.13 px", (0.2, 0.13), (155.0, 155.0)),
    "roll": Case("three axes, roll 1 mrad", (3.0, 5.0, 1e-3), (90.0, 61.0, 70.0)),
    "weak": Case("three axes, roll 0.5 mrad", (3.0, 5.0, 5e-4), (90.0, 61.0, 70.0)),
    "strong": Case("three axes, roll 2 mrad", (3.0, 5.0, 2e-3), (90.0, 61.0, 70.0)),
    "same": Case("roll with the frequency of x", (3.0, 5.0, 1e-3), (70.0, 61.0, 70.0)),
    "zoom": Case("four axes, zoom 5e-4", (3.0, 5.0, 1e-3, 5e-4), (90.0, 61.0, 70.0, 53.0)),
    "none": Case("no roll", (3.0, 5.0), (90.0, 61.0)),
}
FREE = {"free": 3, "free zoom": 4, "free none": 2}  # random motions with so many axes
OPTIONS = {
    "detection_motions": ((*CASES, *FREE), "detection: motions", (*CASES, *FREE)),
    "detection_noises": ((0.005,), "detection: noise levels of full scale"),
    "detection_size": (512, "detection: rows and columns"),
    "detection_seeds": (20, "detection: noise seeds"),
    "detection_axes": (2, "detection: measure at least so many axes"),
    "detection_auto": (False, "detection: detection decides on the axes"),
    "detection_optics": (0.7, "detection: standard deviation of the optics in px"),
}
QUICK = {"detection_motions": ("roll", "free"), "detection_size": 224, "detection_seeds": 1}


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


def scene_of(size: int, optics: float) -> tuple[Layer, torch.Tensor]:
    """A drawn city as a layer of the camera, and its pixels at rest."""
    layer = Layer(seen_by_pixels(city(fine_shape(size, size), np.random.default_rng(3)), optics))
    return layer, pixels_at_rest(layer, size)


def pixels_at_rest(layer: Layer, size: int) -> torch.Tensor:
    """Pixels of a scene at rest, ``RIM`` px larger on each side than the frame."""
    place = FINER * (np.arange(-RIM, size + RIM) + MARGIN + 0.5)  # as in take_frames
    return torch.from_numpy(
        map_coordinates(layer.light, np.meshgrid(place, place, indexing="ij"), np.float64, prefilter=False)
    )


def noisy(frames: Array, noise: float, seed: int) -> torch.Tensor:
    """Frames with white noise."""
    return torch.from_numpy(frames + noise * np.random.default_rng(seed).standard_normal(frames.shape)).float()


def refusals(seed: int, found: Any) -> list[str]:
    """Reasons against the axes of a result, with its seed."""
    return [f"{seed}: {NAMES[axis]} {'; '.join(why)}" for axis, why in enumerate(found.reasons) if why]


def tones(case: Case, noise: float, options: argparse.Namespace) -> dict[str, Any]:
    """Errors of the parameters of one motion, over the bound and over the stated standard deviations."""
    size, timing, truth = options.detection_size, timing_of(options.detection_size), case.vibration()
    axes = max(truth.num_axes, options.detection_axes)
    layer, scene = scene_of(size, options.detection_optics)
    frames = take_frames([layer], motion_of(truth), timing.row_starts(FRAMES, size).numpy(), EXPOSURE, size)
    bound = cramer_rao_bound(scene, timing, truth, FRAMES, noise=noise, frame_size=(size, size), method="random")
    errors: dict[tuple[int, str], list[tuple[float, float]]] = {}
    begin, refused, wrong_tones = time.perf_counter(), [], 0
    for seed in range(options.detection_seeds):
        auto = "auto" if options.detection_auto else False
        found = rsv.detect_vibration(noisy(frames, noise, seed), timing, roll=auto or axes > 2, zoom=auto or axes > 3)
        refused += refusals(seed, found)
        others = found.vibration.num_axes != truth.num_axes
        wrong_tones += others or bool((found.vibration.amplitude[:, 1:] > 0).any())
        for axis in range(min(truth.num_axes, found.vibration.num_axes)):
            for name in PARAMETERS:
                value, true, std = (float(getattr(part, name)[axis, 0]) for part in (found.vibration, truth, found.std))
                error = math.remainder(value - true, 2 * math.pi) if name == "phase" else value - true
                errors.setdefault((axis, name), []).append((error, std))
    parameters = []
    for (axis, name), pairs in errors.items():
        error, std = np.array(pairs).T
        least, ratio = float(getattr(bound, name)[axis, 0]), error / std
        figures = {"bound": least, "rms": rms(error) / least, "mean": float(error.mean()) / least}
        coverage = float(np.mean(np.abs(ratio) < 1.96))
        parameters.append({"axis": NAMES[axis], "parameter": name, **figures, "z": rms(ratio), "coverage": coverage})
    result = {"kind": "tones", "case": case.name, "refused": refused, "wrong_tones": wrong_tones}
    return {**result, "seconds": (time.perf_counter() - begin) / options.detection_seeds, "parameters": parameters}


def free(axes: int, noise: float, options: argparse.Namespace) -> dict[str, Any]:
    """Errors of random motions, a new one for every seed."""
    size, timing = options.detection_size, timing_of(options.detection_size)
    layer, _ = scene_of(size, options.detection_optics)
    starts = timing.row_starts(FRAMES, size).numpy()
    motions, errors, ratios, covered, apart, stated = [], [], [], [], [], []
    begin, refused = time.perf_counter(), []
    for seed in range(options.detection_seeds):
        motion = free_components(seed, axes)
        frames = take_frames([layer], motion, starts, EXPOSURE, size)
        found = rsv.detect_motion(noisy(frames, noise, seed), timing, roll=axes > 2, zoom=axes > 3)
        refused += refusals(seed, found)
        true = motion(found.times.numpy())[:axes].transpose(1, 2, 0)
        error = found.displacement.numpy() - (true - true.mean((0, 1)))
        ratio = error / found.std.numpy()
        # of the rows that show one scene row, less the mean over the frames
        rows_of_scene = np.arange(0.1 * size, 0.9 * size)
        times = FRAME_PERIOD * np.arange(FRAMES)[:, None] + READOUT / size * rows_of_scene
        for _ in range(20):
            times = FRAME_PERIOD * np.arange(FRAMES)[:, None] + READOUT / size * (rows_of_scene + motion(times)[1])
        times += 0.5 * EXPOSURE
        seen = found.motion.displacement(torch.from_numpy(times)).numpy() - motion(times)[:axes].transpose(1, 2, 0)
        seen -= seen.mean(0)
        for values, part in ((motions, true), (errors, error), (ratios, ratio), (apart, seen)):
            values.append(np.sqrt(np.mean(part**2, (0, 1))))
        covered.append(np.mean(np.abs(ratio) < 1.96, (0, 1)))
        stated.append(found.std_seen.numpy())
    figures = {"motion": motions, "rms": errors, "z": ratios, "seen": apart, "seen_std": stated}
    parameters = [
        {"axis": NAMES[axis], "coverage": float(np.mean(np.array(covered)[:, axis]))}
        | {name: rms(np.array(values)[:, axis]) for name, values in figures.items()}
        for axis in range(axes)
    ]
    result = {"kind": "free", "case": f"free motion, {axes} axes", "refused": refused, "wrong_tones": 0}
    return {**result, "seconds": (time.perf_counter() - begin) / options.detection_seeds, "parameters": parameters}


def rows(options: argparse.Namespace) -> Rows:
    """All motions with all noise levels."""
    return [
        {"noise": noise} | (free(FREE[name], noise, options) if name in FREE else tones(CASES[name], noise, options))
        for name in options.detection_motions
        for noise in options.detection_noises
    ]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """A table for each motion."""
    text = []
    for row in results:
        text += [
            f"{row['case']}, noise {row['noise']}: {options.detection_size} px, {options.detection_seeds} seeds, "
            f"{row['seconds']:.1f} s each, {len(row['refused'])} axes refused, {row['wrong_tones']} results with other "
            "axes or further tones.",
            "",
        ]
        cells = []
        for p in row["parameters"]:
            last = (f"{p['z']:.2f}", f"{p['coverage']:.0%}")
            if row["kind"] == "tones":
                first = (p["parameter"], f"{p['bound']:.3g}", f"{p['rms']:.2f}", f"{p['mean']:+.2f}")
            else:
                over = p["seen"] / p["seen_std"]
                first = (f"{p['motion']:.3g}", f"{p['rms']:.2g}", f"{p['seen']:.2g}", f"{over:.2f}")
            cells.append((p["axis"], *first, *last))
        heads = {
            "tones": ("parameter", "bound", "rms error / bound", "mean error / bound"),
            "free": ("rms motion", "rms error", "rms error between frames", "over its std"),
        }
        text += table(("axis", *heads[row["kind"]], "rms error / std", "coverage"), cells)
        if row["refused"]:
            text += [*(f"* {why}" for why in row["refused"]), ""]
    return text
