"""Runs are killed at random calls and times, and resumed: the result must be that of an uninterrupted run."""

import random
from collections.abc import Iterator
from pathlib import Path

from attacks.small_runs import (
    FORMATS,
    Child,
    Reference,
    calls_of,
    content,
    counted_run,
    finished_windows,
    fork,
    in_turn,
    resumed_trial,
)
from attacks.trial import Trial

_LONGEST = 0.6  # s; a run takes 0.2 to 0.5 s on an idle core


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Every other trial is killed at a random call, the others at a random time; every third is killed twice."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    for number, kind, place in in_turn(folder, count):
        name, options = FORMATS[kind]
        moments, arguments = [], (reference.source, place / name, {**options, "resume": True})
        for _ in range(2 if number % 3 == 0 else 1):
            if number % 2:
                moment = choice.uniform(0.0, _LONGEST)
                Child(counted_run, *arguments, 0).ended(moment)
                moments.append(f"{moment:.4f} s")
            else:
                call = choice.randint(1, calls_of(reference, kind))
                fork(counted_run, *arguments, call)
                moments.append(f"call {call}")
        title, out = f"{kind}, killed at {' and '.join(moments)}", place / name
        if kind != "PNG folder" and out.exists() and content(out) != content(reference.whole / name):
            yield Trial(title, "wrong", "an incomplete output has its name")
        else:
            yield resumed_trial(reference, place, kind, title, finished_windows(place, name))
