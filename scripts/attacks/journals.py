"""Damaged journals and headers of interrupted runs: a one-line refusal without any change, or the right result."""

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Reference, content, fork, kill_run, resume
from attacks.trial import Trial

__all__ = ["trials"]

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


def _with_keys(line: bytes, change: Callable[[dict[str, Any]], Any]) -> bytes:
    table = json.loads(line)
    change(table)
    return json.dumps(table).encode() + b"\n"


def _of_values(work: Path, name: str, key: str, text: str) -> None:
    lines = (work / name).read_bytes().splitlines(keepends=True)
    lines[0] = _with_value(lines[0], key, text)
    (work / name).write_bytes(b"".join(lines))


def _of_lines(work: Path, change: Callable[[list[bytes]], list[bytes]]) -> None:
    path = work / "journal.jsonl"
    path.write_bytes(b"".join(change(path.read_bytes().splitlines(keepends=True))))


def _as(work: Path, name: str, make: Callable[[Path], Any]) -> None:
    (work / name).unlink()
    make(work / name)


def _attacks() -> dict[str, Callable[[Path], None]]:
    """Changes of a work folder, by name."""
    found: dict[str, Callable[[Path], None]] = {}

    def add(title: str, function: Callable[..., None], *arguments: Any) -> None:
        found[title] = lambda work: function(work, *arguments)

    for key in ("window", "first", "written", "digests", "position", "detection", "bad_frames", "checksum"):
        for value, text in _VALUES.items():
            add(f"{key} of a line: {value}", _of_values, "journal.jsonl", key, text)
    for key in ("settings", "input"):
        for value, text in _VALUES.items():
            add(f"{key} of the header: {value}", _of_values, "run.json", key, text)
    changes: dict[str, Callable[[list[bytes]], list[bytes]]] = {
        "first line twice": lambda lines: [lines[0], *lines],
        "last line twice": lambda lines: [*lines, lines[-1]],
        "window 0 as window 1": lambda lines: [lines[0], _with_value(lines[0], "window", "1"), *lines[2:]],
        "overlapping windows": lambda lines: [lines[0], _with_value(lines[1], "first", "1"), *lines[2:]],
        "window without frames": lambda lines: [
            _with_keys(lines[0], lambda table: table.update(written=0)),
            *lines[1:],
        ],
        "unknown key": lambda lines: [_with_keys(lines[0], lambda table: table.update(more=1)), *lines[1:]],
        "empty line": lambda lines: [b"\n", *lines],
        "line of text": lambda lines: [b"window 0\n", *lines],
        "bytes": lambda lines: [bytes(range(256)) + b"\n", *lines],
        "zeros before": lambda lines: [bytes(4096) + b"\n", *lines],
        "list": lambda lines: [b"[1, 2]\n", *lines],
        "number": lambda lines: [b"1\n", *lines],
        "without digests": lambda lines: [_with_keys(lines[0], lambda table: table.pop("digests")), *lines[1:]],
        "without checksum": lambda lines: [_with_keys(lines[0], lambda table: table.pop("checksum")), *lines[1:]],
        "without window": lambda lines: [_with_keys(lines[0], lambda table: table.pop("window")), *lines[1:]],
        "nested line": lambda lines: [b"[" * 100_000 + b"\n", *lines],
        "lines reversed": lambda lines: lines[::-1],
        "first line missing": lambda lines: lines[1:],
        "last line incomplete": lambda lines: [*lines[:-1], lines[-1][: len(lines[-1]) // 2]],
        "zeros after": lambda lines: [*lines, bytes(4096)],
        "a very long line": lambda lines: [b"9" * 20_000_000 + b"\n", *lines],
    }
    for title, change in changes.items():
        add(title, _of_lines, change)
    for name in ("journal.jsonl", "run.json", "lock"):
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
        if code is None:
            yield Trial(title, "hang")
        elif code == 0:
            difference = reference.difference(place, name)
            yield Trial(title, "wrong" if difference else "completed", difference)
        elif code != 2 or "\n" in str(result):
            yield Trial(title, "traceback", str(result))
        else:
            changed = _listing(place) != before
            yield Trial(title, "lost" if changed else "refused", str(result))
        shutil.rmtree(place)


def _listing(folder: Path) -> dict[str, Any]:
    """Names, kinds and content of everything in a folder."""
    files = {str(path.relative_to(folder)): path.lstat().st_mode for path in folder.rglob("*") if path.name != "lock"}
    regular = {
        name: mode for name, mode in files.items() if (folder / name).is_file() and not (folder / name).is_symlink()
    }
    return {**files, "content": {name: content(folder / name) for name in regular}}
