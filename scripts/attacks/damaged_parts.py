"""After a kill, a file of the work folder is damaged, edited, or replaced by something else, and the run is resumed.

The result must be complete, or a refusal in one line leaves everything as it was. Files of the user, to which links
lead, must not change.
"""

import os
import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Reference, completed_or_refused, content, fork, in_turn, kill_run, resume
from attacks.trial import Trial

_VALUES = ("null", "-1", "0.5", "9" * 400, "1e999", '"text"', "[]", "{}", "[" * 100_000, '"\\u0000\\ud800"')


def _swapped(file: Path, data: bytes, at: int) -> None:
    """Exchange a file with the next one of its kind, or the parts of a single one."""
    others = [other for other in sorted(file.parent.glob(f"0*{file.suffix}")) if other != file]
    if others:
        file.write_bytes(others[0].read_bytes())
        others[0].write_bytes(data)
    else:
        file.write_bytes(data[at:] + data[:at])


def _edited(file: Path, data: bytes, at: int) -> None:
    """Replace a value of a JSON file, or some bytes."""
    numbers = list(re.finditer(rb"\b\d+\b", data[33:])) if file.suffix == ".json" else []
    start, end = numbers[at % len(numbers)].span() if numbers else (at, at + 3)
    head = 33 if numbers else 0
    file.write_bytes(data[: head + start] + _VALUES[at % len(_VALUES)].encode() + data[head + end :])


def _replaced(make: Callable[[Path], Any]) -> Callable[[Path, bytes, int], None]:
    def replace(file: Path, data: bytes, at: int) -> None:
        file.unlink()
        make(file)

    return replace


# changes of a file with its content, and a random byte of it
_DAMAGES: dict[str, Callable[[Path, bytes, int], Any]] = {
    "deleted": lambda file, data, at: file.unlink(),
    "truncated": lambda file, data, at: file.write_bytes(data[:at]),
    "emptied": lambda file, data, at: file.write_bytes(b""),
    "zeroed": lambda file, data, at: file.write_bytes(data[:at] + bytes(min(4096, len(data) - at)) + data[at + 4096 :]),
    "bit flipped": lambda file, data, at: file.write_bytes(data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]),
    "swapped": _swapped,
    "extended": lambda file, data, at: file.write_bytes(data + b"more"),
    "edited": _edited,
    "nested": lambda file, data, at: file.write_bytes(b"[" * 200_000),
    "named differently": lambda file, data, at: file.rename(file.with_name("more.txt")),
    "a folder": _replaced(Path.mkdir),
    "a pipe": _replaced(os.mkfifo),
    "a link to a device": _replaced(lambda file: file.symlink_to("/dev/zero")),
    "a link to itself": _replaced(lambda file: file.symlink_to(file.name)),
    "a link": _replaced(lambda file: file.symlink_to(_precious(file))),
    "a hard link": _replaced(lambda file: os.link(_precious(file), file)),
}


def _precious(file: Path) -> Path:
    """A file of the user, beside the folder of the output."""
    return file.parents[2] / "precious"


def _listing(folder: Path) -> dict[str, Any]:
    """Names, kinds and content of everything in a folder."""
    kinds = {str(path.relative_to(folder)): path.lstat().st_mode for path in folder.rglob("*")}
    regular = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    return {**kinds, "content": {str(path): content(path) for path in regular}}


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Kinds of damage take turns, on other formats and files each time."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    for number, kind, place in in_turn(folder, count):
        damage, out, name = list(_DAMAGES)[number % len(_DAMAGES)], place / "out", FORMATS[kind][0]
        kill_run(reference, out, kind, choice, windows=2)
        files = sorted((out / f".{name}.rsvib").iterdir())
        file = choice.choice([path for path in files if path.stat().st_size])
        data, at = file.read_bytes(), choice.randrange(file.stat().st_size)
        _precious(file).write_bytes(b"precious")
        _DAMAGES[damage](file, data, at)
        before = _listing(place)
        code, result = fork(resume, reference.source, out / name, FORMATS[kind][1])
        trial = completed_or_refused(
            f"{kind}: {file.name} {damage} at byte {at}",
            code,
            result,
            reference.difference(out, name) if code == 0 else "",
        )
        if _precious(file).read_bytes() != b"precious":
            trial = Trial(trial.name, "lost", "a file of the user was changed")
        elif trial.outcome == "refused" and _listing(place) != before:
            trial = Trial(trial.name, "lost", f"refused, but changed: {result}")
        yield trial
