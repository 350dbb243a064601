"""Several processes write the same output at once, while others read it, or replace its work folder by a link."""

import random
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from attacks.small_runs import FORMATS, Child, Reference, completed_or_refused, content, in_turn, process
from attacks.trial import Trial

# one file, which is replaced
_READ_AT_ALL_TIMES = ("TIFF", "TIFF, zlib", "npy", "HDF5", "video")


def _run(source: Path, sink: Path, delay: float) -> None:
    time.sleep(delay)
    process(source, sink, resume=True)


def _three_runs(reference: Reference, kind: str, place: Path, choice: random.Random) -> Trial:
    """Three processes begin after random delays."""
    name = FORMATS[kind]
    whole = content(reference.whole / name)
    delays = [choice.uniform(0.0, 0.3) for _ in range(3)]
    children = [Child(_run, reference.source, place / name, delay) for delay in delays]
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
    return worst or Trial(title, "wrong", f"no run succeeded: {ends}")


def _replaced_folder(reference: Reference, kind: str, place: Path, choice: random.Random) -> Trial:
    """The work folder is renamed during the run, and a link to a folder of the user takes its name."""
    name = FORMATS[kind]
    out, user, moment = place / "out", place / "user", choice.uniform(0.02, 0.4)
    user.mkdir()
    for precious in ("settings.json", "000000.npy", name):
        (user / precious).write_bytes(b"precious")
    before, work = content(user), out / f".{name}.rsvib"
    child = Child(process, reference.source, out / name)
    while not work.exists() and child.runs:
        time.sleep(0.001)
    time.sleep(moment)
    with suppress(OSError):  # the run has ended
        work.rename(out / "moved")
        work.symlink_to(user)
    code, result = child.ended()
    title = f"{kind}: work folder replaced by a link after {moment:.3f} s"
    if content(user) != before:
        return Trial(title, "lost", "files of the user were changed")
    difference = code == 0 and content(out / name) != content(reference.whole / name)
    return completed_or_refused(title, code, result, "the output differs" if difference else "")


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Both kinds in turn; the first run of a format has no output before."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    for number, kind, place in in_turn(folder, count):
        yield (_replaced_folder if number % 2 else _three_runs)(reference, kind, place, choice)
