"""Several processes write the same output at once, while others read it."""

import random
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Reference, content, process, server
from attacks.trial import Trial

__all__ = ["trials"]

_READ_AT_ALL_TIMES = (
    "TIFF",
    "TIFF, zlib",
    "npy",
    "npy, frames skipped",
    "HDF5",
    "video",
)  # one file, which is replaced


def _run(source: Path, sink: Path, options: dict[str, Any], delay: float, answers: Any) -> None:
    time.sleep(delay)
    try:
        process(source, sink, resume=True, **options)
    except (OSError, ValueError) as error:
        answers.put(("refused", str(error)))
    except BaseException as error:
        answers.put(("traceback", repr(error)))
    else:
        answers.put(("completed", ""))


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Three processes per trial, with random delays; the first trial of a format has no output before."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    for number in range(count):
        kind = list(FORMATS)[number % len(FORMATS)]
        name, options = FORMATS[kind]
        place, answers = folder / "trial", server().SimpleQueue()
        place.mkdir()
        whole = content(reference.whole / name)
        delays = [choice.uniform(0.0, 0.3) for _ in range(3)]
        arguments = [(reference.source, place / name, options, delay, answers) for delay in delays]
        children = [server().Process(target=_run, args=one) for one in arguments]
        for child in children:
            child.start()
        incomplete, end = "", time.monotonic() + 120.0
        while any(child.exitcode is None for child in children) and time.monotonic() < end:
            if kind in _READ_AT_ALL_TIMES and (place / name).exists() and content(place / name) != whole:
                incomplete = "a reader saw an incomplete output"
            time.sleep(0.002)
        title = f"{kind}: three runs after {', '.join(f'{delay:.3f}' for delay in delays)} s"
        if any(child.exitcode is None for child in children):
            for child in children:
                child.kill()
            yield Trial(title, "hang")
            shutil.rmtree(place)
            continue
        found = [answers.get() for _ in children]
        tracebacks = [detail for outcome, detail in found if outcome == "traceback" or "\n" in detail]
        difference = incomplete or reference.difference(place, name)
        if tracebacks:
            yield Trial(title, "traceback", tracebacks[0])
        elif difference or ("completed", "") not in found:
            yield Trial(title, "wrong", difference or f"no run succeeded: {found}")
        else:
            yield Trial(title, "completed")
        shutil.rmtree(place)
