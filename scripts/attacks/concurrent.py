"""Several processes write the same output at once, while others read it."""

import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Child, Reference, completed_or_refused, content, in_turn, process
from attacks.trial import Trial

# one file, which is replaced
_READ_AT_ALL_TIMES = ("TIFF", "TIFF, zlib", "npy", "npy, frames skipped", "HDF5", "video")


def _run(source: Path, sink: Path, options: dict[str, Any], delay: float) -> None:
    time.sleep(delay)
    process(source, sink, resume=True, **options)


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Three processes per trial, with random delays; the first trial of a format has no output before."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    for _, kind, place in in_turn(folder, count):
        name, options = FORMATS[kind]
        whole = content(reference.whole / name)
        delays = [choice.uniform(0.0, 0.3) for _ in range(3)]
        children = [Child(_run, reference.source, place / name, options, delay) for delay in delays]
        incomplete, end = "", time.monotonic() + 120.0
        while any(child.runs for child in children) and time.monotonic() < end:
            if kind in _READ_AT_ALL_TIMES and (place / name).exists() and content(place / name) != whole:
                incomplete = "a reader saw an incomplete output"
            time.sleep(0.002)
        title = f"{kind}: three runs after {', '.join(f'{delay:.3f}' for delay in delays)} s"
        ends = [child.ended(0.0) for child in children]
        difference = incomplete or reference.difference(place, name)
        found = {one.outcome: one for one in (completed_or_refused(title, *end, difference) for end in ends)}
        worst = next((found[one] for one in ("hang", "traceback", "wrong", "completed") if one in found), None)
        yield worst or Trial(title, "wrong", f"no run succeeded: {ends}")
