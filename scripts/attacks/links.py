"""Links, foreign files and devices in the place of the work folder: nothing outside is changed."""

import os
import random
import shutil
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Child, Reference, completed_or_refused, content, fork, process
from attacks.trial import Trial

_LINKS = {"link to a folder": "", "link to a file": "precious.txt", "link to nothing": "missing"}


def _victim(folder: Path) -> Path:
    """A folder of the user, with files of the names that a run uses."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("precious.txt", "settings.json", "out.tif", "out/zarr.json", "000000.npy"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"precious\n")
    return folder


def _judged(title: str, victim: Path, before: dict[str, bytes], code: Any, result: Any, difference: str) -> Trial:
    if content(victim) != before:
        return Trial(title, "lost", "files of the user were changed")
    return completed_or_refused(title, code, result, difference)


def _work_folder_is(kind: str, what: str, again: bool, place: Path, victim: Path, reference: Reference) -> Trial:
    """The name of the work folder belongs to something else."""
    name, options = FORMATS[kind]
    work, before = place / f".{name}.rsvib", content(_victim(victim))
    if what in _LINKS:
        work.symlink_to(victim / _LINKS[what])
    elif what == "file":
        os.link(victim / "precious.txt", work)
    elif what == "pipe":
        os.mkfifo(work)
    else:  # a folder of the user
        victim.rename(work)
    watched = work if what == "folder of the user" else victim
    resumed = {"resume": True} if again else {}
    code, result = fork(process, reference.source, place / name, **options, **resumed)
    return _judged(f"{kind}: work folder is a {what}", watched, before, code, result, "written nevertheless")


def _replaced_meanwhile(moment: float, place: Path, victim: Path, reference: Reference) -> Trial:
    """The work folder is renamed during the run, and a link takes its name."""
    kind = list(FORMATS)[int(1e6 * moment) % len(FORMATS)]
    name, options = FORMATS[kind]
    work, before = place / f".{name}.rsvib", content(_victim(victim))
    child = Child(process, reference.source, place / name, **options)
    while not work.exists() and child.runs:
        time.sleep(0.001)
    time.sleep(moment)
    try:
        work.rename(place / "moved")
        work.symlink_to(victim)
    except OSError:
        pass  # the run has ended
    code, result = child.ended()
    difference = "" if content(place / name) == content(reference.whole / name) else "the output differs"
    title = f"{kind}: work folder replaced by a link after {moment:.3f} s"
    return _judged(title, victim, before, code, result, difference if code == 0 else "")


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """All attacks in turn, or ``count`` that are spread over them."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    attacks: list[Callable[[Path, Path, Reference], Trial]] = [
        partial(_work_folder_is, kind, what, bool(number % 2))
        for number, what in enumerate((*_LINKS, "file", "pipe", "folder of the user"))
        for kind in list(FORMATS)[number % 2 :: 2]
    ]
    attacks += [partial(_replaced_meanwhile, choice.uniform(0.02, 0.4)) for _ in range(count - len(attacks))]
    for attack in attacks[:: max(1, len(attacks) // count)][:count]:
        place, victim = folder / "trial", folder / "victim"
        place.mkdir()
        yield attack(place, victim, reference)
        for path in (place, victim):
            shutil.rmtree(path, ignore_errors=True)
