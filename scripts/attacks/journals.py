"""Damaged markers and headers of interrupted runs: a one-line refusal without any change, or the right result."""

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Reference, completed_or_refused, content, fork, kill_run, resume
from attacks.trial import Trial

__all__ = ["trials"]

_MARKER = "000000.done"
_VALUES: dict[str, str] = {
    "null": "null", "true": "true", "text": '"text"', "empty text": '""', "negative": "-1", "fraction": "0.5",
    "huge": "9" * 400, "very huge": "9" * 5000, "infinite": "1e999", "NaN": "NaN", "Infinity": "-Infinity",
    "list": "[]", "table": "{}", "nested": "[" * 100_000 + "]" * 100_000, "nested tables": '{"a":' * 50_000,
    "control": '"\\u0000\\u001b[2J"', "surrogate": '"\\ud800"', "number": "123456789",
}  # fmt: skip


def _with_value(line: bytes, key: str, text: str) -> bytes:
    """A line of JSON with another value of a key."""
    table = json.loads(line)
    mark = "\0value\0"
    return json.dumps({**table, key: mark}).replace(json.dumps(mark), text).encode() + b"\n"


def _of_values(work: Path, name: str, key: str, text: str) -> None:
    """Replace a value in the first line of a file, which is JSON."""
    first, *rest = (work / name).read_bytes().splitlines(keepends=True)
    (work / name).write_bytes(_with_value(first, key, text) + b"".join(rest))


def _of_record(work: Path, key: str, text: str) -> None:
    """Replace a value of the record of the first window."""
    body, checksum = (work / _MARKER).read_bytes().splitlines()
    entry = json.loads(body)
    mark = "\0value\0"
    changed = json.dumps({**entry, "record": {**entry["record"], key: mark}}).replace(json.dumps(mark), text)
    (work / _MARKER).write_bytes(changed.encode() + b"\n" + checksum)


def _of_marker(work: Path, change: Callable[[bytes], bytes]) -> None:
    (work / _MARKER).write_bytes(change((work / _MARKER).read_bytes()))


def _copied(work: Path, source: str, target: str) -> None:
    shutil.copyfile(work / source, work / target)


def _as(work: Path, name: str, make: Callable[[Path], Any]) -> None:
    (work / name).unlink()
    make(work / name)


def _attacks() -> dict[str, Callable[[Path], None]]:
    """Changes of a work folder, by name."""
    found: dict[str, Callable[[Path], None]] = {}

    def add(title: str, function: Callable[..., None], *arguments: Any) -> None:
        found[title] = lambda work: function(work, *arguments)

    for value, text in _VALUES.items():
        for key in ("window", "first", "written", "detection", "bad_frames"):
            add(f"{key} of a record: {value}", _of_record, key, text)
        for key in ("record", "files"):
            add(f"{key} of a marker: {value}", _of_values, _MARKER, key, text)
        for key in ("settings", "input"):
            add(f"{key} of the header: {value}", _of_values, "run.json", key, text)
    changes: dict[str, Callable[[bytes], bytes]] = {
        "marker is empty": lambda data: b"",
        "marker is incomplete": lambda data: data[: len(data) // 2],
        "marker without checksum": lambda data: data.splitlines()[0],
        "marker with another checksum": lambda data: data.splitlines()[0] + b"\n" + b"0" * 32,
        "marker twice": lambda data: data + b"\n" + data,
        "zeros after the marker": lambda data: data + bytes(4096),
        "zeros before the marker": lambda data: bytes(4096) + data,
        "marker is text": lambda data: b"window 0\n",
        "marker is nested": lambda data: b"[" * 100_000 + b"\n",
        "a very long marker": lambda data: b"9" * 20_000_000 + b"\n",
    }
    for title, change in changes.items():
        add(title, _of_marker, change)
    add("window 0 as window 1", _copied, _MARKER, "000001.done")
    add("window 0 as a window that does not exist", _copied, _MARKER, "000099.done")
    add("a file of another name", _copied, _MARKER, "more.txt")
    for name in (_MARKER, "run.json", "000000.npy"):
        add(f"{name} is a folder", _as, name, lambda path: path.mkdir())
        add(f"{name} is a pipe", _as, name, os.mkfifo)
        add(f"{name} is a link to a device", _as, name, lambda path: path.symlink_to("/dev/zero"))
        add(f"{name} is a link to nothing", _as, name, lambda path: path.symlink_to("missing"))
        add(f"{name} is a link to itself", _as, name, lambda path: path.symlink_to(path.name))
    add("header is empty", lambda work: (work / "run.json").write_bytes(b""))
    add("header is missing", lambda work: (work / "run.json").unlink())
    add("header is a list", lambda work: (work / "run.json").write_bytes(b"[]"))
    add("header is nested", lambda work: (work / "run.json").write_bytes(b"[" * 200_000))
    add("header of another run", lambda work: (work / "run.json").write_bytes((work / "run.json").read_bytes() + b" "))
    return found


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """All attacks in turn, or ``count`` that are spread over them, each on its own copy of one interrupted run."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    name, options = FORMATS["TIFF"]
    killed, place = folder / "killed", folder / "trial"
    kill_run(reference, killed, "TIFF", choice, windows=3)
    attacks = list(_attacks().items())
    for title, attack in attacks[:: max(1, len(attacks) // count)][:count]:
        shutil.copytree(killed, place)
        work = place / f".{name}.rsvib"
        attack(work)
        before = _listing(place)
        code, result = fork(resume, reference.source, place / name, options)
        trial = completed_or_refused(title, code, result, reference.difference(place, name) if code == 0 else "")
        if trial.outcome == "refused" and _listing(place) != before:
            trial = Trial(title, "lost", str(result))
        yield trial
        shutil.rmtree(place)


def _listing(folder: Path) -> dict[str, Any]:
    """Names, kinds and content of everything in a folder."""
    files = {str(path.relative_to(folder)): path.lstat().st_mode for path in folder.rglob("*")}
    regular = {
        name: mode for name, mode in files.items() if (folder / name).is_file() and not (folder / name).is_symlink()
    }
    return {**files, "content": {name: content(folder / name) for name in regular}}
