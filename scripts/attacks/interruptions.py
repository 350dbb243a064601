"""Runs are killed, or the machine loses power, and they are resumed: the result must be that of an uninterrupted run.

A run is killed at a random call that changes a file, or after a random time. In two of three rounds the machine loses
power as well. The calls ``fsync`` and ``fdatasync`` of a run are recorded: the content of a file when it was
synchronised last, and the names in a folder when it was. The folder is then replaced by what was recorded: files that
were never synchronised are empty, names that were not are missing. In every other of these rounds a random part of the
later changes is kept as well, because a file system may write any of them at any time: new names, removed names, and
parts of the content.
"""

import json
import os
import random
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import (
    FORMATS,
    FRAMES,
    LIMIT,
    WINDOWS,
    Child,
    Reference,
    calls_of,
    completed_or_refused,
    content,
    count_file_calls,
    fork,
    in_turn,
    process,
    resume,
)
from attacks.trial import Trial

_LONGEST = 0.6  # s; a run takes 0.2 to 0.5 s on an idle core
_KEPT = ("all", "no", "some")  # later changes
_FRAMES = "frames"  # name of the file with the number of frames that a run has reported as complete


def _recorded_run(source: Path, sink: Path, root: Path, records: Path, die_at: int) -> int:
    """Process the stack; record what is synchronised below ``root``, and die at a call."""
    opened: dict[int, int] = {}  # open files, so that their numbers are not given to other files

    def record(name: str, arguments: tuple[Any, ...]) -> None:
        if name not in ("fsync", "fdatasync"):
            return
        file = arguments[0]
        path, status = Path(os.readlink(f"/proc/self/fd/{file}")), os.fstat(file)
        if path != root and root not in path.parents:
            return
        if status.st_ino not in opened:
            opened[status.st_ino] = os.dup(file)
        part = records / "part"
        if stat.S_ISDIR(status.st_mode):
            names = {entry.name: (entry.inode(), entry.is_dir()) for entry in os.scandir(file)}
            part.write_text(json.dumps(names))
            part.rename(records / f"{status.st_ino}.names")
        else:
            part.write_bytes(Path(f"/proc/self/fd/{file}").read_bytes())  # it may be open for writing only
            part.rename(records / str(status.st_ino))

    names = {entry.name: (entry.inode(), entry.is_dir()) for entry in os.scandir(root)}
    (records / f"{root.stat().st_ino}.names").write_text(json.dumps(names))
    done = count_file_calls(die_at, record)
    process(source, sink, resume=True, progress=lambda frames, _: (records / _FRAMES).write_text(str(frames)))
    return done[0]


class _PowerLoss:
    """Builds the folder that is left after a power loss."""

    def __init__(self, root: Path, records: Path, choice: random.Random | None) -> None:
        self._records, self._choice = records, choice
        self._now = {path.lstat().st_ino: path for path in root.rglob("*")}

    def build(self, number: int, current: Path | None, target: Path) -> None:
        """Build the folder of a number; ``current`` is the folder as the processes saw it."""
        target.mkdir()
        record = self._records / f"{number}.names"
        names = json.loads(record.read_text()) if record.exists() else {}
        for name, (member, is_folder) in self._mixed(names, current).items():
            path = self._now.get(member)
            if is_folder:
                self.build(member, path, target / name)
            else:
                (target / name).write_bytes(self._content(member, path))

    def _mixed(self, names: dict[str, Any], current: Path | None) -> dict[str, Any]:
        if self._choice is None or current is None:
            return names
        present = {entry.name: [entry.inode(), entry.is_dir()] for entry in os.scandir(current)}
        mixed = {}
        for name in sorted(names.keys() | present.keys()):
            old, new = names.get(name), present.get(name)
            if new is None and old[0] in self._now:  # renamed: the name is lost only if the other one is there
                mixed[name] = old
            else:
                kept = self._choice.choice([old, new])
                if kept is not None:
                    mixed[name] = kept
        return mixed

    def _content(self, number: int, path: Path | None) -> bytes:
        record = self._records / str(number)
        old = record.read_bytes() if record.exists() else b""
        if self._choice is None or path is None or not path.is_file():
            return old
        new = path.read_bytes()
        kind = self._choice.choice(["old", "new", "blocks", "zeros"])
        if kind in ("old", "new") or new == old:
            return old if kind == "old" else new
        mixed, block = bytearray(new), 512
        for start in range(0, len(new), block):
            if self._choice.random() < 0.5:
                before = old[start : start + block] if kind == "blocks" else b""
                size = len(new[start : start + block])
                mixed[start : start + size] = before.ljust(size, b"\0")[:size]
        for index, (before_it, after_it) in enumerate(zip(old, new, strict=False)):
            if before_it == after_it:  # synchronised, and not changed later
                mixed[index] = after_it
        return bytes(mixed)


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """The formats take turns; every other run that keeps all changes is killed twice."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    for number, kind, place in in_turn(folder, count):
        name = FORMATS[kind]
        root, records, after = place / "disk", place / "records", place / "after"
        for path in (root, records):
            path.mkdir()
        kept, code, ends = _KEPT[number // len(FORMATS) % len(_KEPT)], None, []
        for _ in range(1 + (kept == "all" and number % 2)):
            by_time = choice.random() < 0.5
            call, moment = choice.randint(1, calls_of(reference, kind)), choice.uniform(0.0, _LONGEST)
            ends.append(f"after {moment:.4f} s" if by_time else f"at call {call}")
            arguments = (root, records, 0 if by_time else call)
            run = Child(_recorded_run, reference.source, root / "new" / name, *arguments)
            code, result = run.ended(moment if by_time else LIMIT)
        title, left = f"{kind}, {' and '.join(ends)}, {kept} later changes", root
        if code in (1, 2):
            yield Trial(title, "traceback", str(result))
            continue
        if kept != "all":
            _PowerLoss(root, records, choice if kept == "some" else None).build(root.stat().st_ino, root, after)
            left = after
        sink = left / "new" / name
        if kind != "PNG folder" and sink.exists() and content(sink) != content(reference.whole / name):
            yield Trial(title, "wrong", "an incomplete output has its name")
            continue
        frames = (records / _FRAMES).read_text() if (records / _FRAMES).exists() else ""
        finished = int(frames or 0) // ((FRAMES - 1) // WINDOWS)  # the last window has one more frame
        code, result = fork(resume, reference.source, sink)
        difference = reference.difference(sink.parent, name) if code == 0 else ""
        trial = completed_or_refused(title, code, result, difference)
        if trial.outcome == "refused" or (trial.outcome == "completed" and result < finished):
            trial = Trial(title, "lost", f"{finished} windows were complete, resumed: {result}")
        yield trial
