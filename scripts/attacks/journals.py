"""Damaged journals of interrupted runs: a one-line refusal without any change, or the right result."""

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Reference, completed_or_refused, content, fork, kill_run, resume
from attacks.trial import Trial

_JOURNAL = "journal"
_VALUES: dict[str, str] = {
    "null": "null", "true": "true", "text": '"text"', "empty text": '""', "negative": "-1", "fraction": "0.5",
    "huge": "9" * 400, "very huge": "9" * 5000, "infinite": "1e999", "NaN": "NaN", "Infinity": "-Infinity",
    "list": "[]", "table": "{}", "nested": "[" * 100_000 + "]" * 100_000, "nested tables": '{"a":' * 50_000,
    "control": '"\\u0000\\u001b[2J"', "surrogate": '"\\ud800"', "number": "123456789",
}  # fmt: skip


def _of_lines(work: Path, change: Callable[[list[bytes]], list[bytes]]) -> None:
    """Change the lines of the journal: the header and those of the windows."""
    (work / _JOURNAL).write_bytes(b"".join(change((work / _JOURNAL).read_bytes().splitlines(keepends=True))))


def _of_values(work: Path, number: int, keys: tuple[str, ...], text: str) -> None:
    """Replace a value in a line of the journal, which is a digest and JSON."""
    lines = (work / _JOURNAL).read_bytes().splitlines(keepends=True)
    digest, _, body = lines[number].partition(b" ")
    entry, mark = json.loads(body), "\0value\0"
    table = entry
    for key in keys[:-1]:
        table = table[key]
    table[keys[-1]] = mark
    lines[number] = digest + b" " + json.dumps(entry).replace(json.dumps(mark), text).encode() + b"\n"
    (work / _JOURNAL).write_bytes(b"".join(lines))


def _of_window(work: Path, change: Callable[[bytes], bytes]) -> None:
    """Change the line of the first window."""
    _of_lines(work, lambda lines: [lines[0], change(lines[1]), *lines[2:]])


def _as(work: Path, name: str, make: Callable[[Path], Any]) -> None:
    (work / name).unlink()
    make(work / name)


def _attacks() -> dict[str, Callable[[Path], None]]:
    """Changes of a work folder, by name."""
    found: dict[str, Callable[[Path], None]] = {}

    def add(title: str, function: Callable[..., Any], *arguments: Any) -> None:
        found[title] = lambda work: function(work, *arguments)

    for value, text in _VALUES.items():
        for key in ("window", "first", "written", "detection", "bad_frames"):
            add(f"{key} of a record: {value}", _of_values, 1, ("record", key), text)
        for key in ("record", "files"):
            add(f"{key} of a window: {value}", _of_values, 1, (key,), text)
        for key in ("settings", "input"):
            add(f"{key} of the header: {value}", _of_values, 0, (key,), text)
    changes: dict[str, Callable[[bytes], bytes]] = {
        "line is empty": lambda line: b"\n",
        "line is missing": lambda line: b"",
        "line is incomplete": lambda line: line[: len(line) // 2],
        "line without digest": lambda line: line.partition(b" ")[2],
        "line with another digest": lambda line: b"0" * 32 + b" " + line.partition(b" ")[2],
        "line twice": lambda line: line + line,
        "zeros after the line": lambda line: line + bytes(4096),
        "zeros before the line": lambda line: bytes(4096) + line,
        "line is text": lambda line: b"window 0\n",
        "line is nested": lambda line: b"[" * 100_000 + b"\n",
        "a very long line": lambda line: b"9" * 20_000_000 + b"\n",
    }
    for title, change in changes.items():
        add(title, _of_window, change)
    add("windows in another order", _of_lines, lambda lines: [lines[0], *lines[:0:-1]])
    add("window 0 again at the end", _of_lines, lambda lines: [*lines, lines[1]])
    add("last line is incomplete", _of_lines, lambda lines: [*lines[:-1], lines[-1][:-9]])
    add("a file of another name", lambda work: shutil.copyfile(work / _JOURNAL, work / "more.txt"))
    for name in (_JOURNAL, "000000.npy"):
        add(f"{name} is a folder", _as, name, lambda path: path.mkdir())
        add(f"{name} is a pipe", _as, name, os.mkfifo)
        add(f"{name} is a link to a device", _as, name, lambda path: path.symlink_to("/dev/zero"))
        add(f"{name} is a link to nothing", _as, name, lambda path: path.symlink_to("missing"))
        add(f"{name} is a link to itself", _as, name, lambda path: path.symlink_to(path.name))
    add("journal is empty", _of_lines, lambda lines: [])
    add("journal is missing", lambda work: (work / _JOURNAL).unlink())
    add("header is missing", _of_lines, lambda lines: lines[1:])
    add("header is a list", _of_lines, lambda lines: [b"[]\n", *lines[1:]])
    add("header is nested", _of_lines, lambda lines: [b"[" * 200_000 + b"\n", *lines[1:]])
    add("header is longer", _of_lines, lambda lines: [lines[0][:-1] + b" \n", *lines[1:]])
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
    regular = [name for name in files if (folder / name).is_file() and not (folder / name).is_symlink()]
    return {**files, "content": {name: content(folder / name) for name in regular}}
