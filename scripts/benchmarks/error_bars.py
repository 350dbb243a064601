"""Stated standard deviations compared with errors and with the Cramér-Rao bound, on simulated recordings.

Seeds follow from the version. Every recording has a scene, motion and noise of its own. Tones have 0.3 to 4 px and 0.3
to 5 times the frame rate, exposures 1 to 200 rows of 2048; roll and zoom 0.2 to 2 px at half the width. Free motions
are random walks, smooth motions, sums of three tones, single tones within 8 % of the frequency at which all frames
have the same displacement, and tones that decay or sweep; the error is that of the part of the motion that differs
between frames, and of the whole motion. Row times from light have random row times and LED frequencies, in front of a
plain wall, with 20 times the noise, of textured scenes in one frame, strong and weak, and in four frames.

Other kinds have one motion and another noise in every recording: tones of all axes, and row times from motion, relative
to the true one.

z is the error over the standard deviation: 1 is expected for its root mean square, 68, 95 and 99.7 % within 1, 1.96
and 3. The bound is that of Cramér and Rao for a random scene. Axes with another number of tones than the true one are
refused or counted by the section honesty.
"""

import argparse
import math
import sys
import zlib
from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks import honesty_camera, independent_camera
from benchmarks.honesty_camera import FINER, MARGIN, Layer, fine_shape, seen_by_pixels
from benchmarks.honesty_cases import FRAME_PERIOD, Case, Generator, log_uniform, moving, record, tones_of, wave
from benchmarks.honesty_scenes import city
from benchmarks.independent_camera import Shake, closed
from harness import Rows, table
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, map_coordinates

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.evaluation import cramer_rao_bound

_TESTS = Path(__file__).parents[2] / "tests"
sys.path += [str(_TESTS), str(_TESTS / "row_time")]

from motion_truth import common_warp, rms  # noqa: E402
from test_calibrate import HEIGHT, WIDTH, blink, record_frames, shaded, sine  # noqa: E402
from truth import Curve, draw_scene, recorded  # noqa: E402

Array = NDArray[np.float64]
Error = tuple[str, float, float, float]  # quantity, error, standard deviation, bound or NaN
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=270)
FRAMES, ROWS, COLUMNS, NOISE, RIM = 5, 192, 160, 0.005, 12
TONES = {"tone, 2 frames": 2, "tone, 4 frames": 4, "tone, 8 frames": 8}
TURNS = {"roll, 4 frames": ("roll",), "zoom, 4 frames": ("roll", "zoom")}
TRACKED = "tracker, 12 frames"
CHANGES = {"decay": (3.0, 0.0), "sweep": (0.0, 3.0)}  # largest 1/s, Hz/s
FIXED = {  # amplitudes (px, px, rad, 1) and frequencies of the axes
    "amplitudes of 0.2 and 0.13 px": ((0.2, 0.13), (155.0, 155.0)),
    "no roll": ((3.0, 5.0), (90.0, 61.0)),
    "roll 0.5 mrad": ((3.0, 5.0, 5e-4), (90.0, 61.0, 70.0)),
    "roll 1 mrad": ((3.0, 5.0, 1e-3), (90.0, 61.0, 70.0)),
    "roll 2 mrad": ((3.0, 5.0, 2e-3), (90.0, 61.0, 70.0)),
    "roll with the frequency of x": ((3.0, 5.0, 1e-3), (70.0, 61.0, 70.0)),
    "roll 1 mrad, zoom 5e-4": ((3.0, 5.0, 1e-3, 5e-4), (90.0, 61.0, 70.0, 53.0)),
}
FREE = tuple(f"free motion: {kind}" for kind in ("walk", "smooth", "tones", "nearly blind", *CHANGES))
CALIBRATIONS = ("wall", "noisy wall", "textured", "weakly textured", "textured, four frames")
BY_MOTION: dict[str, tuple[Any, Any, Any, Any]] = {  # amplitudes, frequencies, limits of the row time, and direction
    "row time by motion: 83 Hz along x, known to 12 %": (((3.0,), (0.0,)), ((83.0,), (1.0,)), (0.88, 1.12), "forward"),
    "row time by motion: 83 and 67 Hz": (((3.1,), (2.2,)), ((83.0,), (67.0,)), None, None),
    "row time by motion: 10 and 17 Hz": (((3.1,), (2.2,)), ((10.0,), (17.0,)), None, None),
    "row time by motion: four tones": (((1.5, 0.5), (1.1, 0.4)), ((41.0, 133.0), (67.0, 185.0)), None, None),
    "row time by motion: random tones": (None, None, None, None),
}
KINDS = (*TONES, *TURNS, TRACKED, *FREE, *(f"row time: {kind}" for kind in CALIBRATIONS), *FIXED, *BY_MOTION)
OPTIONS = {
    "bar_kinds": (KINDS, "error_bars: kinds of recordings", KINDS),
    "bar_recordings": (200, "error_bars: recordings of each kind"),
    "bar_size": (256, "error_bars: rows and columns of the frames with tones, and for row times from motion"),
}
QUICK = {"bar_kinds": ("tone, 2 frames", "row time: wall"), "bar_recordings": 2, "bar_size": 128}


def generator_of(kind: str, number: int) -> Generator:
    """Random numbers of a recording, others in each version of the package."""
    return np.random.default_rng([zlib.crc32(f"{rsv.__version__} {kind}".encode()), number])


# Tones


def one_tone(generator: Generator, low: float, high: float) -> Array:
    """A tone (1, 3) with an amplitude from a range, not at a frequency at which all frames move alike."""
    turns = 0.0
    while abs(turns - round(turns)) < 0.15:
        turns = float(log_uniform(generator, 0.3, 5.0)[0])
    return tones_of(generator, log_uniform(generator, low, high).tolist(), [turns / FRAME_PERIOD])


def bound_of(layer: Layer, timing: rsv.SensorTiming, true: rsv.Vibration, frames: int, noise: float, size: int) -> Any:
    """The bound of a random scene, which is known 32 px beyond the frame on each side."""
    place = FINER * (np.arange(-32, size + 32) + MARGIN + 0.5)  # as in honesty_camera.take_frames
    grid = np.meshgrid(place, place, indexing="ij")
    still = torch.from_numpy(map_coordinates(layer.light, grid, np.float64, prefilter=False))
    return cramer_rao_bound(still, timing, true, frames, noise=noise, frame_size=(size, size), method="random")


def random_tones(kind: str, number: int, size: int) -> tuple[torch.Tensor, rsv.SensorTiming, rsv.Vibration, Any]:
    """A recording with one tone of each axis, also of roll or zoom: frames, timing, true vibration, and its bound."""
    generator = generator_of(kind, number)
    parts = [one_tone(generator, 0.3, 4.0) for _ in range(2)]
    turn = {name: one_tone(generator, 0.2 / (0.5 * size), 2.0 / (0.5 * size)) for name in TURNS.get(kind, ())}
    case = Case(
        moving(*(partial(wave, part) for part in parts), **turn),
        None,
        num_frames=TONES.get(kind, 12 if kind == TRACKED else 4),
        exposure=float(log_uniform(generator, 1.0, 200.0)[0]),
        noise=float(log_uniform(generator, 0.002, 0.01)[0]),
    )
    taken = record(case, generator, size)
    true = rsv.Vibration(*([float(part[0, place]) for part in (*parts, *turn.values())] for place in range(3)))
    scene, timing, bound = taken.layers[0], taken.timing, None
    if kind != TRACKED:
        bound = bound_of(scene, timing, true, case.num_frames, case.noise, size)
    return torch.from_numpy(taken.frames).float(), timing, true, bound


@lru_cache(maxsize=1)
def fixed_tones(kind: str, size: int) -> tuple[Array, rsv.SensorTiming, rsv.Vibration, Any]:
    """Four frames without noise of a drawn city with the tones of a kind, readout 24.6 ms, exposure 0.2 ms."""
    amplitude, frequency = FIXED[kind]
    tones = [np.array([tone]) for tone in zip(amplitude, frequency, (0.3, 1.1, 2.0, 0.7), strict=False)]
    true = rsv.Vibration(*([float(tone[0, place]) for tone in tones] for place in range(3)))
    timing = rsv.SensorTiming(24.6e-3 / size, 2e-4 * size / 24.6e-3, 25.6e-3 * size / 24.6e-3)
    scene = Layer(seen_by_pixels(city(fine_shape(size, size), np.random.default_rng(3)), 0.7))
    motion = moving(*(partial(wave, tone) for tone in tones[:2]), *tones[2:])
    frames = honesty_camera.take_frames([scene], motion, timing.row_starts(4, size).numpy(), 2e-4, size)
    return frames, timing, true, bound_of(scene, timing, true, 4, NOISE, size)


def tones(kind: str, number: int, size: int) -> Iterator[Error]:
    """Errors of one tone of each axis, or of the tones that a tracker follows."""
    # 1. The recording, and what is found.
    if kind in FIXED:
        clean, timing, true, bound = fixed_tones(kind, size)
        noise = generator_of(kind, number).standard_normal(clean.shape)
        frames = torch.from_numpy(clean + NOISE * noise).float()
    else:
        frames, timing, true, bound = random_tones(kind, number, size)
    found: Any
    if kind == TRACKED:
        tracker = rsv.VibrationTracker(timing)
        for frame in frames:
            found = tracker.update(frame).detection
        if found is None:
            return
    else:
        found = rsv.detect_vibration(frames, timing, roll=true.num_axes > 2, zoom=true.num_axes > 3)
    # 2. Errors of the axes that are reliable with one tone.
    for axis in range(true.num_axes):
        if not bool(found.reliable[axis]) or int((found.vibration.amplitude[axis] > 0).sum()) != 1:
            continue
        name = ("x", "y", "roll", "zoom")[axis] if axis > 1 or kind in FIXED else "x, y"
        for quantity in ("amplitude", "frequency", "phase"):
            if quantity == "phase" and bound is None:  # a tracker states it at another time origin
                continue
            value, truth, std = (float(getattr(part, quantity)[axis, 0]) for part in (found.vibration, true, found.std))
            error = math.remainder(value - truth, 2 * math.pi) if quantity == "phase" else value - truth
            least = math.nan if bound is None else float(getattr(bound, quantity)[axis, 0])
            yield f"{name} {quantity}", error, std, least


# Free motion


def drawn(kind: str, draw: Generator) -> Curve:
    """A random motion of one kind."""
    span = 1.2 * FRAMES * TIMING.frame_period
    times = np.linspace(-0.1 * span, span, 400)
    turns = times[:, None] / TIMING.frame_period
    if kind in CHANGES:
        tone = np.concatenate([one_tone(draw, 0.5, 3.0) for _ in range(2)])
        decay, sweep = (draw.uniform(0.1, 1, 2) * largest for largest in CHANGES[kind])
        cycles = tone[:, 1] * FRAME_PERIOD * turns + 0.5 * sweep * times[:, None] ** 2
        path = tone[:, 0] * np.exp(-decay * times[:, None]) * np.sin(2 * np.pi * cycles + tone[:, 2])
    elif kind == "walk":
        path = gaussian_filter1d(np.cumsum(draw.standard_normal((400, 2)), 0), 8, axis=0)
        path *= 2.0 / path.std(0)
    elif kind == "smooth":
        path = np.cumsum(np.cumsum(draw.standard_normal((400, 2)), 0), 0)
        path = 3.0 * (path - path.mean(0)) / path.std(0)
    else:
        parts = [(draw.uniform(0.2, 1.8), draw.uniform(0.3, 2, 2)) for _ in range(3)]
        parts = parts if kind == "tones" else [(1 + draw.uniform(-0.08, 0.08), np.full(2, 1.5))]
        path = draw.uniform(-2, 2, 2) * turns
        for frequency, size in parts:
            path = path + size * np.sin(2 * np.pi * frequency * turns + draw.uniform(0, 2 * np.pi, 2))
    return Curve(CubicSpline(times, path))


def free_motion(kind: str, number: int) -> Iterator[Error]:
    """Errors of the rows of each reliable axis, and of what differs between frames, rms over the rows."""
    draw = generator_of(kind, number)
    motion = drawn(kind.removeprefix("free motion: "), draw)
    frames = recorded((ROWS, COLUMNS), TIMING, motion, FRAMES, NOISE, seed=int(draw.integers(2**32)))
    found = rsv.detect_motion(frames, TIMING)
    error = found.displacement.numpy() - motion.displacement(found.times.numpy())
    error = (error - error.mean((0, 1)))[:, ::16]
    error, stds = (values[..., found.reliable.numpy()].ravel() for values in (error, found.std.numpy()[:, ::16]))
    for value, std in zip(error, stds, strict=True):
        yield "displacement of rows", float(value), float(std), math.nan
    moments = (TIMING.row_starts(FRAMES, ROWS) + 0.5 * TIMING.exposure_time).numpy()
    truth = motion.displacement(moments)
    left = found.motion.displacement(torch.from_numpy(moments)).numpy() - truth
    left = left - common_warp(left, truth)
    for size, std in zip(rms(left[:, RIM:-RIM]), found.std_seen.numpy(), strict=True):
        yield "rms between frames", float(size), float(std), math.nan


# Row time


def calibration(kind: str, number: int) -> Iterator[Error]:
    """Error of the row time from a light that flickers."""
    draw, of_light = generator_of(kind, number), kind.removeprefix("row time: ")
    row_time, frequency, start = 1e-6 * draw.uniform(8, 30), draw.uniform(500, 1500), draw.uniform(0, 1)
    city = draw_scene(HEIGHT, WIDTH, int(draw.integers(1000)))
    scene, contrast = {
        "textured": (0.5 * city, 0.5),
        "weakly textured": (0.35 + 0.05 * (city - 0.45), 0.3),
        "textured, four frames": (0.6 * city, 0.1),
    }.get(of_light, (shaded(), 0.6))

    def light(time: Array) -> Array:
        square = "wall" in of_light and number % 2 == 0
        return np.asarray(blink(time, frequency) if square else sine(time, frequency, contrast))

    frames = record_frames(
        light,
        frames=4 if "four" in of_light else 1,
        row_time=row_time,
        scene=scene,
        noise=0.06 if "noisy" in of_light else 0.003,
        seed=int(draw.integers(10**6)),
        start=start,
    )
    try:
        found = rsv.calibrate_row_time(frames, frequency)
    except ValueError:
        return
    yield "row time", found.row_time - row_time, found.row_time_std, math.nan


def shake_of(kind: str, generator: Generator) -> Shake:
    """The motion of a recording whose row time is measured, with random phases."""
    amplitude, frequency, *_ = BY_MOTION[kind]
    if frequency is None:  # two random tones
        amplitude = generator.uniform(0.5, 4.0, (2, 1))
        frequency = log_uniform(generator, 8.0, 220.0, 2)[:, None]
    phase = generator.uniform(-math.pi, math.pi, np.shape(amplitude))
    return Shake(np.array(amplitude), np.array(frequency), phase, np.zeros(2))


def by_motion(kind: str, number: int, size: int) -> Iterator[Error]:
    """Error of the row time from eight frames, relative to the true one; readout 25.6 ms, exposure 0.5 ms."""
    generator, (*_, limits, direction) = generator_of(kind, number), BY_MOTION[kind]
    row_time, period, count, rim = 25.6e-3 / size, 1 / 30, 8, 24
    shake = shake_of(kind, generator)
    reach = np.ceil(shake.reach((count + 1) * period)).astype(int) + rim + 8
    scene = city_and_fields(size + 2 * int(reach[1]), size + 2 * int(reach[0]), seed=3).double().numpy()
    timing = rsv.SensorTiming(row_time, 5e-4 / row_time, period / row_time)
    clean = independent_camera.take_frames(closed(scene, rim), shake, timing, count, (size, size))
    found = rsv.calibrate_row_time_by_motion(
        torch.from_numpy(clean + NOISE * generator.standard_normal(clean.shape)).float(),
        frame_rate=1 / period,
        row_time=None if limits is None else tuple(part * row_time for part in limits),
        readout_direction=direction,
        exposure_time=5e-4,
    )
    if found.reliable and found.row_time is not None:
        wrong_way = 0.0 if found.readout_direction == "forward" else 1.0
        yield "relative row time", found.row_time / row_time - 1 + wrong_way, found.row_time_std / row_time, math.nan


# The table


def errors_of(kind: str, number: int, size: int) -> Iterator[Error]:
    """All errors of a recording."""
    if kind in FREE:
        return free_motion(kind, number)
    if kind.startswith("row time: "):
        return calibration(kind, number)
    return by_motion(kind, number, size) if kind in BY_MOTION else tones(kind, number, size)


def rows(options: argparse.Namespace) -> Rows:
    figures: Rows = []
    for kind in options.bar_kinds:
        found: dict[str, list[tuple[float, float, float]]] = {}
        for number in range(options.bar_recordings):
            for quantity, *values in errors_of(kind, number, options.bar_size):
                found.setdefault(quantity, []).append(tuple(values))
        for quantity, values in found.items():
            error, std, bound = np.array(values).T
            z = np.abs(error / std)
            within = {f"within_{share}": float(np.mean(z < limit)) for share, limit in WITHIN.items()}
            spread = {"z": float(rms(z[:, None])[0]), **within, "largest": float(z.max())}
            least = {"std_over_bound": float(np.median(std / bound)), "rms": float(rms(error[:, None])[0])}
            of_bound = float(rms((error / bound)[:, None])[0]) if np.isfinite(bound).all() else math.nan
            row = {"kind": kind, "quantity": quantity, "number": len(z)}
            figures.append(row | spread | least | {"error_over_bound": of_bound})
    return figures


WITHIN = {"68": 1.0, "95": 1.96, "99.7": 3.0}


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    heads = ("recordings", "quantity", "values", "rms of z", *(f"{share} %" for share in WITHIN), "largest z")
    ratios = {"median of std / bound": "std_over_bound", "rms of error / bound": "error_over_bound"}
    cells = []
    for row in results:
        within = (f"{row[f'within_{share}']:.1%}".replace("100.0", "100") for share in WITHIN)
        over = ("" if math.isnan(row.get(key, math.nan)) else f"{row[key]:.2f}" for key in ratios.values())
        first = (row["kind"], row["quantity"], row["number"], f"{row['z']:.2f}")
        cells.append((*first, *within, f"{row['largest']:.1f}", *over))
    return table((*heads, *ratios), cells)
