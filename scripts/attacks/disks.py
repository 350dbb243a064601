"""Full and read-only disks: a one-line error, no incomplete output, and the run can be resumed when there is space.

The runs are in processes that see a small file system of their own; without the right to mount one, there are no
trials.
"""

import ctypes
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

from attacks.small_runs import FORMATS, Reference, fork, process, resume
from attacks.trial import Trial

_PAGE = 4096
_PAGES = (0, 1, 5, 10, 16, 24, 32, 40, 50, 60, 110)  # of 4 KiB that are left, 0: read-only; a run needs 50 to 80
_NEW_MOUNTS, _NEW_USER = 0x20000, 0x10000000  # of unshare(2)


def _mount(disk: Path) -> None:
    """Mount a file system of 1 MB that only this process and its children see."""
    user = os.geteuid()
    ctypes.CDLL(None).unshare(_NEW_MOUNTS | (_NEW_USER if user else 0))
    if user:
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
    disk.mkdir(exist_ok=True)
    for arguments in (("--make-rprivate", "/"), ("-t", "tmpfs", "-o", "size=1m,mode=755", "none", disk)):
        subprocess.run(["mount", *arguments], check=True, capture_output=True)


def _attempt(reference: Reference, disk: Path, kind: str, pages: int) -> str:
    """Message of a run with a number of free pages; resumed when there is space, its result must be right."""
    _mount(disk)
    name = FORMATS[kind]
    sink, ballast, free = disk / "new" / name, disk / "ballast", os.statvfs(disk).f_bavail
    ballast.write_bytes(b"b" * (_PAGE * (free - pages)))
    assert abs(os.statvfs(disk).f_bavail - pages) <= 1
    if pages == 0:
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    message = ""
    try:
        process(reference.source, sink)
    except OSError as error:
        message = str(error)
    assert not (message and sink.exists()), "an incomplete output has its name"
    if pages == 0:
        subprocess.run(["mount", "-o", "remount,rw", disk], check=True)
    ballast.unlink()
    resume(reference.source, sink)
    difference = reference.difference(sink.parent, name)
    assert not difference, difference
    return message


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """All formats, on a read-only disk and on disks with different numbers of free pages."""
    reference, disk = Reference(folder / "reference"), folder / "disk"
    if fork(_mount, disk)[0] != 0:
        return
    wanted = [(kind, pages) for pages in _PAGES for kind in FORMATS]
    for kind, pages in wanted[:: max(1, len(wanted) // count)][:count]:
        title = f"{kind}: {f'{pages} pages left' if pages else 'read-only disk'}"
        code, result = fork(_attempt, reference, disk, kind, pages)
        expected = "No space left on device" if pages else "Read-only file system"
        if code != 0:
            yield Trial(title, "hang" if code is None else "wrong", str(result))
        elif not result:
            yield Trial(title, "completed" if pages else "wrong")
        else:
            is_clear = "\n" not in result and expected in result
            yield Trial(title, "refused" if is_clear else "traceback", str(result))
