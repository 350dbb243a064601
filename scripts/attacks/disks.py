"""Full and read-only disks: a one-line error, no incomplete output, and the run can be resumed when there is space.

The runs are those of ``tests/stacks/small_disk.py``, in a mount namespace of their own; without the right to mount
file systems there are no trials.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from attacks.trial import Trial

_TESTS = Path(__file__).parents[2] / "tests"
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


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """All formats, on a read-only disk and on disks with different numbers of free pages."""
    mount = _unshare()
    if mount is None:
        return
    names = ("out.tif", "out.zarr", "out.h5", "out.raw", "frames", "out.npy")
    wanted = [(name, pages) for pages in _PAGES for name in names][:count]
    whole, disk = folder / "whole", folder / "disk"
    whole.mkdir()
    disk.mkdir()
    prepare = (
        "import sys, pathlib; from small_stack import process_small, write_small\n"
        "folder = pathlib.Path(sys.argv[1]); write_small(folder / 'frames.tif')\n"
        "for name in sys.argv[2:]: process_small(folder / 'frames.tif', folder / name)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(_TESTS), str(_TESTS / "stacks"), *sys.path])}
    subprocess.run([sys.executable, "-c", prepare, str(whole), *names], check=True, env=environment)
    shell = f'mount -t tmpfs -o size=1m,mode=755 none "{disk}" && exec "$@"'
    program = [sys.executable, str(_TESTS / "stacks" / "small_disk.py")]
    command = [*mount, shell, "sh", *program, str(whole / "frames.tif"), str(whole), str(disk), json.dumps(wanted)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        yield Trial("full disk", "traceback", done.stderr[-2000:])
        return
    for (name, pages), run in zip(wanted, json.loads(done.stdout.splitlines()[-1])["runs"], strict=True):
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
