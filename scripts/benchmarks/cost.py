"""Time of detection, in seconds and FFT round trips, and of difficult inputs over that of a plain vibration.

A round trip is rfft2 and irfft2 of one frame. The difficult recordings are those of ``honesty_cases`` and some of
other shapes and numbers of frames. An input and its plain counterpart alternate, and the shortest times are compared,
because other load on the machine can only increase them.
"""

import argparse
import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from benchmarks.honesty_cases import BLANKING, FRAME_PERIOD, of_tones, plain, record, recording, tones_of
from harness import Rows, in_turns, named, seconds_of, shown_seconds, table_of

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

OPTIONS = {
    "cost_size": (384, "cost: rows and columns of the difficult inputs"),
    "cost_inputs": (100, "cost: at most so many difficult inputs"),
}
QUICK = {"cost_size": 128, "cost_inputs": 2}
SEED, NOISE = 5, 0.005
CITY = partial(city_and_fields, seed=SEED)
PLAIN_SEED, MARGIN = 11, 40  # of the plain vibration whose time is measured in round trips; px
BOUND = 3.0  # times the time of the plain recording
OF_CLASSES = {  # recordings (class, number) of honesty_cases
    "wrong timing": (
        ("frame_rows +2%", 0),
        ("frame_rows +5%", 0),
        ("frame_rows -10%", 0),
        ("row_time +10%, start times given", 0),
        ("exposure 300, true 200", 0),
        ("exposure x 0.5", 0),
        ("dropped frame", 0),
        ("swapped frames", 0),
        ("reversed readout", 0),
    ),
    "motion": (
        ("random", 3),
        ("random walk", 0),
        ("ringdown", 0),
        ("chirp", 0),
        ("step", 0),
        ("close pair, 3 Hz apart", 0),
        ("roll", 3),
        ("zoom", 4),
        ("large amplitude", 0),
    ),
    "scene": (("objects", 0), ("cloud", 1), ("parallax", 0), ("parallax", 1)),
}


@dataclass(frozen=True, eq=False)
class Input:
    """Frames with the stated timing, and a plain recording of as many pixels."""

    frames: torch.Tensor  # (T, H, W)
    timing: rsv.SensorTiming  # the stated timing
    plain_frames: torch.Tensor  # of the same number of pixels
    plain_timing: rsv.SensorTiming  # their timing


def _frames(values: Any) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float32)


def _plain(size: int, count: int) -> tuple[torch.Tensor, rsv.SensorTiming]:
    """A plain vibration in frames of the city."""
    generator = np.random.default_rng(SEED)
    taken = record(plain(generator, num_frames=count, scene="city"), generator, size)
    return _frames(taken.frames), taken.timing


def _of_class(size: int, name: str, number: int) -> Input:
    """A recording of a class, with a plain one of as many frames."""
    taken = recording(name, number, size)
    return Input(_frames(taken.frames), taken.timing, *_plain(size, len(taken.frames)))


def _simulated(
    size: int,
    height: int = 0,
    width: int = 0,
    draw: Callable[[int, int], torch.Tensor] = CITY,
    exposure: float = 20.0,
    amplitude: tuple[float, ...] = (1.5, 1.2),
) -> Input:
    """A vibration of two or, with roll, three components in four frames, with a square recording of as many pixels."""
    height, width, count = height or size, width or size, len(amplitude)
    timing = rsv.SensorTiming(FRAME_PERIOD / (BLANKING * height), exposure * height / 2048, BLANKING * height)
    vibration = rsv.Vibration(list(amplitude), [53.0, 65.0, 41.0][:count], [0.4, 1.3, 0.2][:count])
    frames = rsv.simulate_frames(
        draw(height + 64, width + 64),
        timing,
        vibration,
        4,
        frame_size=(height, width),
        noise=rsv.SensorNoise(read_noise=NOISE),
        generator=torch.Generator().manual_seed(SEED),
    )
    return Input(frames, timing, *_plain(size, 4))


def _two_waves(height: int, width: int) -> torch.Tensor:
    """A scene that repeats every 12 px along x and every 15 px along y."""
    along = torch.sin(2 * torch.pi * torch.arange(width) / 12)
    across = torch.sin(2 * torch.pi * torch.arange(height) / 15)
    return 0.5 + 0.25 * along + 0.2 * across[:, None]


def _of_number(size: int, count: int, build: Callable[..., Any]) -> Input:
    """A case in some number of frames."""
    generator = np.random.default_rng(SEED)
    case = build(generator)
    taken = record(case, generator, size)
    return Input(_frames(taken.frames), taken.timing, *_plain(size, count))


def _many_tones(generator: np.random.Generator) -> Any:
    """Six tones along each axis in eight frames."""
    axes = [
        tones_of(generator, generator.uniform(0.3, 2.0, 6).tolist(), generator.uniform(10.0, 250.0, 6).tolist())
        for _ in range(2)
    ]
    return of_tones(*axes, num_frames=8)


def _still(size: int, *, uniform: bool) -> Input:
    """Frames of a camera at rest, of the city or of a uniform surface."""
    frames, timing = _plain(size, 4)
    noise = NOISE * torch.randn(frames.shape, generator=torch.Generator().manual_seed(SEED))
    scene = torch.full_like(frames[:1], 0.5) if uniform else frames[:1]
    return Input(scene + noise, timing, frames, timing)


def inputs() -> dict[str, Callable[[int], Input]]:
    """Functions of the size, by name."""
    built: dict[str, Callable[[int], Input]] = {
        f"{kind}: {name} {number}": partial(_of_class, name=name, number=number)
        for kind, classes in OF_CLASSES.items()
        for name, number in classes
    }
    built["no vibration"] = partial(_still, uniform=False)
    built["uniform image"] = partial(_still, uniform=True)
    built["six tones, 8 frames"] = partial(_of_number, count=8, build=_many_tones)
    built["30 frames"] = partial(_of_number, count=30, build=partial(plain, num_frames=30, scene="texture"))
    built["periodic scene"] = partial(_simulated, draw=_two_waves)
    built["exposure 200, 3 and 5 px"] = partial(_simulated, exposure=200.0, amplitude=(3.1, 5.2))
    built["roll, exposure 200"] = lambda size: _simulated(size, exposure=200.0, amplitude=(1.5, 1.2, 1 / size))
    built["long frames"] = lambda size: _simulated(size, 4 * size, size // 4)
    built["wide frames"] = lambda size: _simulated(size, max(96, size // 4), size * size // max(96, size // 4))
    return built


def _timed(frames: torch.Tensor, timing: rsv.SensorTiming) -> tuple[float, float | None, str]:
    """Seconds of detection and of restoration with its result, and the first reason against it."""
    found: list[rsv.DetectionResult] = []
    try:
        detection = seconds_of(lambda: found.append(rsv.detect_vibration(frames, timing)))
    except ValueError as error:
        return 0.0, None, f"error: {error}"
    restoration = seconds_of(lambda: rsv.restore(frames, timing, found[0]))
    codes = [reason.code for of_axis in found[0].findings for reason in of_axis]
    return detection, restoration, codes[0] if codes else ""


def measure(task: Input, runs: int) -> dict[str, Any]:
    """Ratios of the shortest times, and the outcome."""
    seconds: list[tuple[float, ...]] = []
    reason = ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rsv.RestorationWarning)
        for _ in range(max(1, runs)):
            own = _timed(task.frames, task.timing)
            reason = own[2]
            normal = _timed(task.plain_frames, task.plain_timing)
            seconds.append((own[0], own[1] or 0.0, normal[0], normal[1] or 0.0))
    detection, restoration, plain_detection, plain_restoration = (min(values) for values in zip(*seconds, strict=True))
    return {
        "shape": list(task.frames.shape),
        "detection": detection,
        "plain_detection": plain_detection,
        "restoration": restoration,
        "plain_restoration": plain_restoration,
        "detection_ratio": detection / plain_detection,
        "restoration_ratio": restoration / plain_restoration,
        "reason": reason,
    }


def plain_rows(options: argparse.Namespace) -> Rows:
    """Time of each method for two and four frames of a plain vibration, alternating with the round trip."""
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=options.size)
    vibration = rsv.Vibration([3.1, 5.2], [50.0, 30.0], [0.7, 2.1])
    scene = city_and_fields(options.size + 2 * MARGIN, options.size + 2 * MARGIN, seed=PLAIN_SEED)
    frames = rsv.simulate_frames(scene, timing, vibration, 4, frame_size=(options.size, options.size))
    frames = frames + NOISE * torch.randn(frames.shape, generator=torch.Generator().manual_seed(PLAIN_SEED))
    results = []
    for device in options.device:
        taken = frames.to(device)
        tasks = {"round trip": lambda f=taken: torch.fft.irfft2(torch.fft.rfft2(f[0]))}
        for method, count in itertools.product(("bands", "direct"), (2, 4)):
            tasks[f"{method}, {count} frames"] = partial(rsv.detect_vibration, taken[:count], timing, method=method)
        done = in_turns(tasks, options.runs)
        unit = done["round trip"].seconds
        results += [
            {"name": named(name, device), **timed.figures(), "round_trips": timed.seconds / unit}
            for name, timed in done.items()
        ]
    return results


def rows(options: argparse.Namespace) -> Rows:
    """Time of a plain vibration, then of all difficult inputs."""
    return plain_rows(options) + [
        {"part": "bounded", "name": name, **measure(build(options.cost_size), options.runs)}
        for name, build in itertools.islice(inputs().items(), options.cost_inputs)
    ]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """Both tables in Markdown; the difficult inputs with the slowest first."""
    plain_cases = [row for row in results if row.get("part") != "bounded"]
    difficult = [row for row in results if row.get("part") == "bounded"]
    both = {
        row["name"]: (row["detection"] + row["restoration"]) / (row["plain_detection"] + row["plain_restoration"])
        for row in difficult
    }
    of_parts = [[row[f"{of}_ratio"] for row in difficult] for of in ("detection", "restoration")]
    beyond = [sum(ratio > BOUND for ratio in ratios) for ratios in (list(both.values()), *of_parts)]
    return [
        *table_of(
            plain_cases,
            (f"detection, {options.size}^2", "{name}"),
            ("seconds", shown_seconds),
            ("FFT round trips", "{round_trips:.1f}"),
        ),
        f"{len(difficult)} difficult inputs of {options.cost_size} x {options.cost_size} px, or as many pixels; times "
        "over those of a plain vibration of the same size, the shortest of alternating runs. Restoration uses the "
        f"result of detection. More than {BOUND:g} times as long: both together of {beyond[0]} inputs, detection of "
        f"{beyond[1]}, restoration of {beyond[2]}.",
        "",
        *table_of(
            sorted(difficult, key=lambda row: -both[row["name"]]),
            ("input", "{name}"),
            ("frames", "{shape[0]} of {shape[1]} x {shape[2]}"),
            ("detection (s)", "{detection:.2f}"),
            ("ratio", "{detection_ratio:.1f}"),
            ("restoration (s)", "{restoration:.2f}"),
            ("ratio", "{restoration_ratio:.1f}"),
            ("ratio of both", lambda row: f"{both[row['name']]:.1f}"),
            ("first reason", "{reason}"),
        ),
    ]
