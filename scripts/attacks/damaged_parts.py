"""After a kill, the work folder or a file of it is damaged, edited or replaced by something else; the run is resumed.

The result must be complete, or a refusal in one line leaves everything as it was. Files of the user, to which links
lead, must not change.
"""

import os
import random
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Reference, completed_or_refused, content, fork, in_turn, kill_run, resume
from attacks.trial import Trial

_VALUES = ("null", "-1", "0.5", "9" * 400, "1e999", '"text"', "[]", "{}", "[" * 100_000, '"\\u0000\\ud800"')
_USER = "user"  # folder of the user, beside that of the output


def _swapped(file: Path, data: bytes, at: int) -> None:
    """Exchange a file with the next one of its kind, or the parts of a single one."""
    others = [other for other in sorted(file.parent.glob(f"0*{file.suffix}")) if other != file]
    if others:
        file.write_bytes(others[0].read_bytes())
        others[0].write_bytes(data)
    else:
        file.write_bytes(data[at:] + data[:at])


def _edited(file: Path, data: bytes, at: int) -> None:
    """Replace a number of a JSON file behind its hash, or some bytes."""
    numbers = list(re.finditer(rb"\b\d+\b", data[33:])) if file.suffix == ".json" else []
    start, end = numbers[at % len(numbers)].span() if numbers else (at, at + 3)
    head = 33 if numbers else 0
    file.write_bytes(data[: head + start] + _VALUES[at % len(_VALUES)].encode() + data[head + end :])


def _replaced(make: Callable[[Path], Any]) -> Callable[[Path, bytes, int], None]:
    def replace(path: Path, data: bytes, at: int) -> None:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        make(path)

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
}
_REPLACED = {  # also of the work folder itself
    "a folder": _replaced(Path.mkdir),
    "a pipe": _replaced(os.mkfifo),
    "a link to a device": _replaced(lambda path: path.symlink_to("/dev/zero")),
    "a link to itself": _replaced(lambda path: path.symlink_to(path.name)),
    "a link to a folder": _replaced(lambda path: path.symlink_to(_user_of(path))),
    "a link to a file": _replaced(lambda path: path.symlink_to(_user_of(path) / "000000.npy")),
    "a hard link": _replaced(lambda path: os.link(_user_of(path) / "000000.npy", path)),
}


def _user_of(path: Path) -> Path:
    return next(above / _USER for above in path.parents if (above / _USER).is_dir())


def _listing(folder: Path) -> dict[str, Any]:
    """Names, kinds and content of everything in a folder."""
    kinds = {str(path.relative_to(folder)): path.lstat().st_mode for path in folder.rglob("*")}
    regular = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    return {**kinds, "content": {str(path): content(path) for path in regular}}


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Kinds of damage take turns, on other formats and files each time."""
    reference, choice, damages = Reference(folder / "reference"), random.Random(seed), _DAMAGES | _REPLACED
    for number, kind, place in in_turn(folder, count):
        damage, out, name = list(damages)[number % len(damages)], place / "out", FORMATS[kind]
        kill_run(reference, out, kind, choice, windows=2)
        (place / _USER).mkdir()
        for of_user in ("settings.json", "000000.npy", name):
            (place / _USER / of_user).write_bytes(b"precious")
        work = out / f".{name}.rsvib"
        path = choice.choice([one for one in sorted(work.iterdir()) if one.stat().st_size])
        data, at = path.read_bytes(), choice.randrange(path.stat().st_size)
        if damage in _REPLACED and choice.random() < 0.5:
            path = work
        damages[damage](path, data, at)
        before, precious = _listing(place), content(place / _USER)
        code, result = fork(resume, reference.source, out / name)
        difference = reference.difference(out, name) if code == 0 else ""
        trial = completed_or_refused(f"{kind}: {path.name}, {damage}, at byte {at}", code, result, difference)
        if content(place / _USER) != precious:
            trial = Trial(trial.name, "lost", "a file of the user was changed")
        elif trial.outcome == "refused" and _listing(place) != before:
            trial = Trial(trial.name, "lost", f"refused, but changed: {result}")
        yield trial
