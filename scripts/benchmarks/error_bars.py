"""Stated standard deviations compared with errors, on simulated recordings whose seeds follow from the version.

Every recording has a scene, motion and noise of its own. Tones have 0.3 to 4 px and 0.3 to 5 times the frame rate,
exposures 1 to 200 rows of 2048; roll and zoom 0.2 to 2 px at half the width. Free motions are random walks, smooth
motions, sums of three tones, and single tones within 8 % of the frequency at which all frames have the same
displacement; the error is that of the part of the motion that differs between frames, and of the whole motion.
Calibrations have random row times and LED frequencies, in front of a plain wall, with 20 times the noise, of textured
scenes in one frame, strong and weak, and in four frames.

z is the error over the standard deviation: 1 is expected for its root mean square, 68, 95 and 99.7 % within 1, 1.96
and 3. The bound is that of Cramér and Rao for a random scene. Axes with another number of tones than the true one are
refused or counted by the section honesty.
"""

import argparse
import math
import sys
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from benchmarks.detection import pixels_at_rest
from benchmarks.honesty_cases import FRAME_PERIOD, Case, Generator, log_uniform, moving, record, tones_of, wave
from harness import Rows, one_thread, table
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

import rsvib_torch as rsv
from rsvib_torch.evaluation import cramer_rao_bound

_TESTS = Path(__file__).parents[2] / "tests"
sys.path += [str(_TESTS), str(_TESTS / "calibration")]

from motion_truth import common_warp, rms  # noqa: E402
from test_calibrate import HEIGHT, WIDTH, blink, record_frames, shaded, sine  # noqa: E402
from truth import Curve, draw_scene, take_frames  # noqa: E402

Array = NDArray[np.float64]
Error = tuple[str, float, float, float]  # quantity, error, standard deviation, bound or NaN
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=270)
FRAMES, ROWS, COLUMNS, NOISE, RIM = 5, 192, 160, 0.005, 12
TONES = {"tone, 2 frames": 2, "tone, 4 frames": 4, "tone, 8 frames": 8}
TURNS = {"roll, 4 frames": "roll", "zoom, 4 frames": "zoom"}
TRACKED = "tracker, 12 frames"
FREE = {"free motion: walk": "walk", "free motion: smooth": "smooth", "free motion: tones": "tones"}
FREE |= {"free motion: nearly blind": "blind"}
CALIBRATIONS = ("wall", "noisy wall", "textured", "weakly textured", "textured, four frames")
KINDS = (*TONES, *TURNS, TRACKED, *FREE, *(f"row time: {kind}" for kind in CALIBRATIONS))
OPTIONS = {
    "bar_kinds": (KINDS, "error_bars: kinds of recordings", KINDS),
    "bar_recordings": (200, "error_bars: recordings of each kind"),
    "bar_size": (256, "error_bars: rows and columns of the frames with tones"),
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


def tones(kind: str, number: int, size: int) -> Iterator[Error]:
    """Errors of one tone of each axis, also of roll or zoom, or of the tones that a tracker follows."""
    # 1. The recording.
    generator, what = generator_of(kind, number), TURNS.get(kind)
    parts = [one_tone(generator, 0.3, 4.0) for _ in range(2)]
    names, turn = ["x", "y"], {}
    if what is not None:
        for name in ("roll", "zoom")[: 1 + (what == "zoom")]:
            parts.append(one_tone(generator, 0.2 / (0.5 * size), 2.0 / (0.5 * size)))
            names.append(name)
            turn[name] = parts[-1]
    case = Case(
        moving(*(partial(wave, part) for part in parts[:2]), **turn),
        None,
        num_frames=TONES.get(kind, 12 if kind == TRACKED else 4),
        exposure=float(log_uniform(generator, 1.0, 200.0)[0]),
        noise=float(log_uniform(generator, 0.002, 0.01)[0]),
    )
    taken = record(case, generator, size)
    frames = torch.from_numpy(taken.frames).float()
    # 2. What is found, and the bound.
    true = rsv.Vibration(*([float(part[0, place]) for part in parts] for place in range(3)))
    if kind == TRACKED:
        tracker = rsv.VibrationTracker(taken.timing)
        for frame in frames:
            tracked = tracker.update(frame)
        found, bound = tracked.detection, None
        if found is None:
            return
    else:
        found = rsv.detect_vibration(frames, taken.timing, roll=what is not None, zoom=what == "zoom")
        scene = pixels_at_rest(taken.layers[0], size)
        of_frames = {"noise": case.noise, "frame_size": (size, size), "method": "random"}
        bound = cramer_rao_bound(scene, taken.timing, true, case.num_frames, **of_frames)
    # 3. Errors of the axes that are reliable with one tone.
    for axis, name in enumerate(names):
        if not bool(found.reliable[axis]) or int((found.vibration.amplitude[axis] > 0).sum()) != 1:
            continue
        for quantity in ("amplitude", "frequency", "phase"):
            if quantity == "phase" and bound is None:  # a tracker states it at another time origin
                continue
            values = (float(getattr(part, quantity)[axis, 0]) for part in (found.vibration, true, found.std))
            value, truth, std = values
            error = math.remainder(value - truth, 2 * math.pi) if quantity == "phase" else value - truth
            least = math.nan if bound is None else float(getattr(bound, quantity)[axis, 0])
            yield f"{name if axis > 1 else 'x, y'} {quantity}", error, std, least


# Free motion


def drawn(kind: str, draw: Generator) -> Curve:
    """A random motion of one kind."""
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
        parts = [(draw.uniform(0.2, 1.8), draw.uniform(0.3, 2, 2)) for _ in range(3)]
        parts = parts if kind == "tones" else [(1 + draw.uniform(-0.08, 0.08), np.full(2, 1.5))]
        path = draw.uniform(-2, 2, 2) * turns
        for frequency, size in parts:
            path = path + size * np.sin(2 * np.pi * frequency * turns + draw.uniform(0, 2 * np.pi, 2))
    return Curve(CubicSpline(times, path))


def free_motion(kind: str, number: int) -> Iterator[Error]:
    """Errors of the displacement of the rows of each axis, rms over the rows, and of what differs between frames."""
    draw = generator_of(kind, number)
    motion = drawn(FREE[kind], draw)
    clean = take_frames(draw_scene(ROWS + 80, COLUMNS + 80, int(draw.integers(1000))), TIMING, motion, FRAMES, 0.0)
    found = rsv.detect_motion(torch.from_numpy(clean + NOISE * draw.standard_normal(clean.shape)).float(), TIMING)
    error = found.displacement.numpy() - motion.displacement(found.times.numpy())
    error = (error - error.mean((0, 1)))[:, ::16]
    for value, std in zip(error.ravel(), found.std.numpy()[:, ::16].ravel(), strict=True):
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


# The table


def errors_of(kind: str, number: int, size: int) -> list[Error]:
    """All errors of a recording."""
    if kind in FREE:
        return list(free_motion(kind, number))
    return list(calibration(kind, number) if kind.startswith("row time") else tones(kind, number, size))


def rows(options: argparse.Namespace) -> Rows:
    """The figures of each quantity of each kind."""
    figures: Rows = []
    with one_thread():
        for kind in options.bar_kinds:
            found: dict[str, list[tuple[float, float, float]]] = {}
            for number in range(options.bar_recordings):
                for quantity, *values in errors_of(kind, number, options.bar_size):
                    found.setdefault(quantity, []).append(tuple(values))
            for quantity, values in found.items():
                error, std, bound = np.array(values).T
                z = np.abs(error / std)
                within = {f"within_{share}": float(np.mean(z < limit)) for share, limit in WITHIN.items()}
                z_rms, over = float(np.sqrt(np.mean(z**2))), float(np.median(std / bound))
                spread = {"z": z_rms, **within, "largest": float(z.max()), "std_over_bound": over}
                figures.append({"kind": kind, "quantity": quantity, "number": len(z), **spread})
    return figures


WITHIN = {"68": 1.0, "95": 1.96, "99.7": 3.0}


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as a Markdown table."""
    heads = ("recordings", "quantity", "values", "rms of z", *(f"{share} %" for share in WITHIN), "largest z")
    cells = []
    for row in results:
        within = (f"{row[f'within_{share}']:.1%}".replace("100.0", "100") for share in WITHIN)
        over = "" if math.isnan(row["std_over_bound"]) else f"{row['std_over_bound']:.2f}"
        first = (row["kind"], row["quantity"], row["number"], f"{row['z']:.2f}")
        cells.append((*first, *within, f"{row['largest']:.1f}", over))
    return table((*heads, "median of std / bound"), cells)
