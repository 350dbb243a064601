"""Links, foreign files and devices in the place of the work folder and in it: nothing outside is changed."""

import os
import random
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from attacks.small_runs import FORMATS, Child, Reference, completed_or_refused, content, fork, kill_run, process, resume
from attacks.trial import Trial

_TARGETS = dict.fromkeys(("TIFF", "npy, frames skipped", "video"), ("journal", "000000.npy", "000004.npy", "out.tif"))


def _victim(folder: Path) -> Path:
    """A folder of the user, with files of the names that a run uses."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("precious.txt", "journal", "out.tif", "out/zarr.json", "000000.npy"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"precious\n")
    return folder


def _linked(path: Path, victim: Path, kind: str) -> None:
    """Replace a file or folder by a link to the victim's."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
        path.symlink_to(victim)
        return
    path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    if kind == "hard link":
        os.link(victim / "precious.txt", path)
    else:
        path.symlink_to(victim / "precious.txt")


def _judged(title: str, victim: Path, before: dict[str, bytes], code: Any, result: Any, difference: str) -> Trial:
    if content(victim) != before:
        return Trial(title, "lost", "files of the user were changed")
    return completed_or_refused(title, code, result, difference)


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """All attacks in turn, or ``count`` that are spread over them."""
    reference, choice = Reference(folder / "reference"), random.Random(seed)
    found = [*_of_the_folder(folder, reference), *_in_the_folder(folder, reference, choice)]
    moments = [choice.uniform(0.02, 0.4) for _ in range(max(0, count - len(found)))]
    kinds = [*found, *(_replaced_meanwhile(folder, reference, moment) for moment in moments)]
    for attack in kinds[:: max(1, len(kinds) // count)][:count]:
        yield attack()
        for name in ("trial", "victim"):
            shutil.rmtree(folder / name, ignore_errors=True)


def _of_the_folder(folder: Path, reference: Reference) -> Iterator[Callable[[], Trial]]:
    """The name of the work folder belongs to something else."""
    place, victim = folder / "trial", folder / "victim"
    links = {"link to a folder": "", "link to a file": "precious.txt", "link to nothing": "missing"}

    def attack(kind: str, what: str, again: bool) -> Trial:
        name, options = FORMATS[kind]
        place.mkdir()
        work, before = place / f".{name}.rsvib", content(_victim(victim))
        if what in links:
            work.symlink_to(victim / links[what])
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

    for number, what in enumerate((*links, "file", "pipe", "folder of the user")):
        for kind in list(FORMATS)[number % 2 :: 2]:
            yield lambda kind=kind, what=what, again=bool(number % 2): attack(kind, what, again)


def _in_the_folder(folder: Path, reference: Reference, choice: random.Random) -> Iterator[Callable[[], Trial]]:
    """A file or folder in the work folder is replaced by a link."""
    place, victim = folder / "trial", folder / "victim"

    def attack(kind: str, target: str, link: str) -> Trial:
        name, options = FORMATS[kind]
        kill_run(reference, place, kind, choice, windows=2)
        before = content(_victim(victim))
        _linked(place / f".{name}.rsvib" / target, victim, link)
        code, result = fork(resume, reference.source, place / name, options)
        difference = reference.difference(place, name) if code == 0 else ""
        return _judged(f"{kind}: {target} is a {link}", victim, before, code, result, difference)

    for kind, targets in _TARGETS.items():
        for target in targets:
            for link in ("link", "hard link"):
                yield lambda kind=kind, target=target, link=link: attack(kind, target, link)


def _replaced_meanwhile(folder: Path, reference: Reference, moment: float) -> Callable[[], Trial]:
    """The work folder is renamed during the run, and a link takes its name."""
    place, victim = folder / "trial", folder / "victim"

    def attack() -> Trial:
        kind = list(FORMATS)[int(1e6 * moment) % len(FORMATS)]
        name, options = FORMATS[kind]
        place.mkdir()
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

    return attack
