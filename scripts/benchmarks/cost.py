"""Time of difficult inputs over that of a plain vibration in as many frames of the same size.

The difficult recordings are those of ``honesty_cases`` and some of other shapes and numbers of frames. An input and its
plain counterpart alternate, and the shortest times are compared, because other load on the machine can only increase
them.
"""

import argparse
import itertools
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from benchmarks import honesty_cases as cases
from harness import Rows, in_turns, table_of

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

OPTIONS = {
    "cost_size": (384, "cost: rows and columns of the difficult inputs"),
    "cost_inputs": (100, "cost: at most so many difficult inputs"),
}
QUICK = {"cost_size": 128, "cost_inputs": 2}
SEED, NOISE = 5, 0.005
CITY = partial(city_and_fields, seed=SEED)
Recorded = tuple[torch.Tensor, rsv.SensorTiming]  # frames (T, H, W), and the stated timing
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


def _of(taken: cases.Recording) -> Recorded:
    return torch.from_numpy(taken.frames).float(), taken.timing


def _recorded(size: int, build: Callable[[np.random.Generator], cases.Case]) -> Recorded:
    """Frames of a case."""
    generator = np.random.default_rng(SEED)
    return _of(cases.record(build(generator), generator, size))


def _plain(size: int, count: int, scene: str = "city") -> Recorded:
    """A plain vibration."""
    return _recorded(size, partial(cases.plain, num_frames=count, scene=scene))


def _simulated(
    size: int,
    height: int = 0,
    width: int = 0,
    draw: Callable[[int, int], torch.Tensor] = CITY,
    exposure: float = 20.0,
    amplitude: tuple[float, ...] = (1.5, 1.2),
) -> Recorded:
    """A vibration of two or, with roll, three components in four frames."""
    height, width, count = height or size, width or size, len(amplitude)
    frame_rows = cases.BLANKING * height
    timing = rsv.SensorTiming(cases.FRAME_PERIOD / frame_rows, exposure * height / 2048, frame_rows)
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
    return frames, timing


def _two_waves(height: int, width: int) -> torch.Tensor:
    """A scene that repeats every 12 px along x and every 15 px along y."""
    along = torch.sin(2 * torch.pi * torch.arange(width) / 12)
    across = torch.sin(2 * torch.pi * torch.arange(height) / 15)
    return 0.5 + 0.25 * along + 0.2 * across[:, None]


def _many_tones(generator: np.random.Generator) -> cases.Case:
    """Six tones along each axis in eight frames."""
    axes = [
        cases.tones_of(generator, generator.uniform(0.3, 2.0, 6).tolist(), generator.uniform(10.0, 250.0, 6).tolist())
        for _ in range(2)
    ]
    return cases.of_tones(*axes, num_frames=8)


def _still(size: int, *, uniform: bool) -> Recorded:
    """Frames of a camera at rest, of the city or of a uniform surface."""
    frames, timing = _plain(size, 4)
    noise = NOISE * torch.randn(frames.shape, generator=torch.Generator().manual_seed(SEED))
    return (torch.full_like(frames[:1], 0.5) if uniform else frames[:1]) + noise, timing


# functions of the size, by name
INPUTS: dict[str, Callable[[int], Recorded]] = {
    f"{kind}: {name} {number}": lambda size, name=name, number=number: _of(cases.recording(name, number, size))
    for kind, classes in OF_CLASSES.items()
    for name, number in classes
} | {
    "no vibration": partial(_still, uniform=False),
    "uniform image": partial(_still, uniform=True),
    "six tones, 8 frames": partial(_recorded, build=_many_tones),
    "30 frames": partial(_plain, count=30, scene="texture"),
    "periodic scene": partial(_simulated, draw=_two_waves),
    "exposure 200, 3 and 5 px": partial(_simulated, exposure=200.0, amplitude=(3.1, 5.2)),
    "roll, exposure 200": lambda size: _simulated(size, exposure=200.0, amplitude=(1.5, 1.2, 1 / size)),
    "long frames": lambda size: _simulated(size, 4 * size, size // 4),
    "wide frames": lambda size: _simulated(size, max(96, size // 4), size * size // max(96, size // 4)),
}


def measure(difficult: Recorded, simple: Recorded, runs: int) -> dict[str, Any]:
    """Shortest times of both recordings and their ratios, and the first reason against the difficult one."""
    works: dict[str, Callable[[], Any]] = {}
    for kind, recorded in (("plain_", simple), ("", difficult)):
        found = rsv.detect_vibration(*recorded)
        works[f"{kind}detection"] = partial(rsv.detect_vibration, *recorded)
        works[f"{kind}restoration"] = partial(rsv.restore, *recorded, found)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rsv.RestorationWarning)
        least = {name: min(timed.runs) for name, timed in in_turns(works, runs).items()}
    ratios = {f"{step}_ratio": least[step] / least[f"plain_{step}"] for step in ("detection", "restoration")}
    codes = [reason.code for of_axis in found.findings for reason in of_axis]
    return {"shape": list(difficult[0].shape), **least, **ratios, "reason": codes[0] if codes else ""}


def rows(options: argparse.Namespace) -> Rows:
    """Times of all difficult inputs."""
    size, results = options.cost_size, []
    for name, build in itertools.islice(INPUTS.items(), options.cost_inputs):
        difficult = build(size)
        results.append({"name": name, **measure(difficult, _plain(size, len(difficult[0])), options.runs)})
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The table in Markdown, with the slowest first."""
    both = {
        row["name"]: (row["detection"] + row["restoration"]) / (row["plain_detection"] + row["plain_restoration"])
        for row in results
    }
    of_parts = [[row[f"{of}_ratio"] for row in results] for of in ("detection", "restoration")]
    beyond = [sum(ratio > BOUND for ratio in ratios) for ratios in (list(both.values()), *of_parts)]
    return [
        f"{len(results)} difficult inputs of {options.cost_size} x {options.cost_size} px, or as many pixels; times "
        "over those of a plain vibration of the same size, the shortest of alternating runs. Restoration uses the "
        f"result of detection. More than {BOUND:g} times as long: both together of {beyond[0]} inputs, detection of "
        f"{beyond[1]}, restoration of {beyond[2]}.",
        "",
        *table_of(
            sorted(results, key=lambda row: -both[row["name"]]),
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
