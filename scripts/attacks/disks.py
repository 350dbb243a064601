"""Full and read-only disks: a one-line error, no incomplete output, and the run can be resumed when there is space.

The runs are in a process with a mount namespace of its own; without the right to mount file systems there are no
trials.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from attacks.small_runs import content
from attacks.trial import Trial
from small_stack import process_small, write_small

_PAGE = 4096
# of 4 KiB that are left, 0: read-only; windows and output have 55 to 60 each
_PAGES = (0, 2, 9, 20, 37, 52, 58, 70, 106, 114, 125)


def _unshare() -> list[str] | None:
    if shutil.which("unshare") is None:
        return None
    for options in ("-m", "-rm"):
        command = ["unshare", options, "sh", "-c"]
        mount = [*command, "mount -t tmpfs -o size=64k none /mnt"]
        if subprocess.run(mount, capture_output=True, check=False).returncode == 0:
            return command
    return None


def _free_pages(folder: Path) -> int:
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize // _PAGE


def _attempt(source: Path, whole: Path, disk: Path, name: str, pages: int) -> dict[str, Any]:
    """Message of a run with a number of free pages, whether it has an output, and whether it is right once resumed."""
    with (disk / "ballast").open("wb") as file:
        file.write(b"b" * (_PAGE * (_free_pages(disk) - pages)))
    assert abs(_free_pages(disk) - pages) <= 1
    if pages == 0:
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    message, new = "done", disk / "new"
    try:
        process_small(source, new / name)
    except OSError as error:
        message = str(error)
    exists = (new / name).exists()
    if pages == 0:
        subprocess.run(["mount", "-o", "remount,rw", disk], check=True)
    (disk / "ballast").unlink()
    process_small(source, new / name, resume=True)
    same = content(new / name) == content(whole / name)
    shutil.rmtree(new)
    return {"message": message, "output_exists": exists, "same": same}


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """All formats, on a read-only disk and on disks with different numbers of free pages."""
    mount = _unshare()
    if mount is None:
        return
    names = ("out.tif", "out.zarr", "out.h5", "out.raw", "frames", "out.npy")
    wanted = [(name, pages) for pages in _PAGES for name in names][:count]
    source, whole, disk = folder / "frames.tif", folder / "whole", folder / "disk"
    whole.mkdir()
    disk.mkdir()
    write_small(source)
    for name in names:
        process_small(source, whole / name)
    shell = f'mount -t tmpfs -o size=1m,mode=755 none "{disk}" && exec "$@"'
    program = [sys.executable, "-m", "attacks.disks", str(source), str(whole), str(disk), json.dumps(wanted)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([*mount, shell, "sh", *program], capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        yield Trial("full disk", "traceback", done.stderr[-2000:])
        return
    for (name, pages), run in zip(wanted, json.loads(done.stdout.splitlines()[-1]), strict=True):
        title, message = f"{name}: {f'{pages} pages left' if pages else 'read-only disk'}", run["message"]
        expected = "No space left on device" if pages else "Read-only file system"
        if not run["same"]:
            yield Trial(title, "wrong", "the resumed output differs")
        elif message == "done":
            yield Trial(title, "completed" if pages else "wrong")
        elif "\n" in message or expected not in message:
            yield Trial(title, "traceback", message)
        else:
            yield Trial(title, "lost" if run["output_exists"] else "refused", message)


if __name__ == "__main__":
    torch.set_num_threads(1)
    places = [Path(text) for text in sys.argv[1:4]]
    print(json.dumps([_attempt(*places, *trial) for trial in json.loads(sys.argv[4])]))
