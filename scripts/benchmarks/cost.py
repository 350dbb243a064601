"""Time of difficult inputs over that of a plain vibration in as many frames of the same size.

The difficult recordings are those of ``honesty_cases``. An input and its plain counterpart alternate, and the shortest
times are compared, because other load on the machine can only increase them.
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from benchmarks.honesty_cases import Recording, plain, record, recording
from harness import Rows, in_turns, table_of

import rsvib_torch as rsv

OPTIONS = {
    "cost_size": (384, "cost: rows and columns of the difficult inputs"),
    "cost_inputs": (100, "cost: at most so many difficult inputs"),
}
QUICK = {"cost_size": 128, "cost_inputs": 2}
SEED = 5
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


def _recorded(taken: Recording) -> Recorded:
    return torch.from_numpy(taken.frames).float(), taken.timing


def _simple(size: int, count: int) -> Recorded:
    """A plain vibration of the city."""
    generator = np.random.default_rng(SEED)
    return _recorded(record(plain(generator, num_frames=count, scene="city"), generator, size))


def measure(difficult: Recorded, simple: Recorded, runs: int) -> dict[str, Any]:
    """Shortest times of both recordings and their ratios, and the first reason against the difficult one."""
    works: dict[str, Callable[[], Any]] = {}
    for kind, recorded in (("plain_", simple), ("", difficult)):
        found = rsv.detect_vibration(*recorded)
        works[f"{kind}detection"] = partial(rsv.detect_vibration, *recorded)
        works[f"{kind}restoration"] = partial(rsv.restore, *recorded, found)
    least = {name: float(seconds.min()) for name, seconds in in_turns(works, runs).items()}
    ratios = {f"{step}_ratio": least[step] / least[f"plain_{step}"] for step in ("detection", "restoration")}
    codes = [reason.code for of_axis in found.findings for reason in of_axis]
    return {"shape": list(difficult[0].shape), **least, **ratios, "reason": codes[0] if codes else ""}


def rows(options: argparse.Namespace) -> Rows:
    size, results = options.cost_size, []
    inputs = [(kind, name, number) for kind, classes in OF_CLASSES.items() for name, number in classes]
    for kind, name, number in inputs[: options.cost_inputs]:
        difficult = _recorded(recording(name, number, size))
        figures = measure(difficult, _simple(size, len(difficult[0])), options.runs)
        results.append({"name": f"{kind}: {name} {number}", **figures})
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
        f"{len(results)} difficult inputs of {options.cost_size} x {options.cost_size} px; times "
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
