"""After a kill, a file of the work folder is damaged: the result of the resumed run must be complete nevertheless."""

import random
from collections.abc import Iterator
from pathlib import Path

from attacks.small_runs import FORMATS, Reference, in_turn, kill_run, resumed_trial
from attacks.trial import Trial

_DAMAGES = ("deleted", "truncated", "emptied", "zeroed", "bit flipped", "swapped", "extended")


def _damage(file: Path, others: list[Path], kind: str, choice: random.Random) -> str:
    """Damage a file, or swap two parts of the output; returns a description."""
    data = bytearray(file.read_bytes())
    start = choice.randrange(max(1, len(data)))
    if kind == "deleted":
        file.unlink()
        return ""
    if kind == "truncated":
        data = data[:start]
    elif kind == "emptied":
        data = bytearray()
    elif kind == "zeroed":
        data[start : start + 4096] = bytes(len(data[start : start + 4096]))
    elif kind == "bit flipped" and data:
        data[start] ^= 1 << choice.randrange(8)
    elif kind == "swapped" and others:
        other = choice.choice(others)
        content = other.read_bytes()
        other.write_bytes(data)
        file.write_bytes(content)
        return f" with {other.name}"
    elif kind == "swapped":  # two parts of one file
        half = len(data) // 2
        data = data[half:] + data[:half]
    elif kind == "extended":
        data += b"more"
    file.write_bytes(data)
    return f" at byte {start}"


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Formats and kinds of damage take turns."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    for number, kind, place in in_turn(folder, count):
        damage = _DAMAGES[number // len(FORMATS) % len(_DAMAGES)]
        work = place / f".{FORMATS[kind][0]}.rsvib"
        files: list[Path] = []
        while not files:
            kill_run(reference, place, kind, choice, windows=2)
            files = sorted(file for file in work.iterdir() if file.name != "journal")
        file = choice.choice(files)
        where = _damage(file, [other for other in files if other != file], damage, choice)
        yield resumed_trial(reference, place, kind, f"{kind}: {file.relative_to(work)} {damage}{where}")
