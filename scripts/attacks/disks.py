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

from attacks.small_runs import FORMATS, Reference, content, fork, process
from attacks.trial import Trial

_TESTS = Path(__file__).parents[2] / "tests"
_PAGES = (2, 9, 20, 37, 52, 58, 70, 106, 114, 125)  # of 4 KiB that are left; windows and output have 55 to 60 each


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
    """Every tenth trial is a read-only disk."""
    mount = _unshare()
    if mount is None:
        return
    read_only = min(len(FORMATS), count // 10)
    names = ("out.tif", "out.zarr", "out.h5", "out.raw", "frames", "out.npy")
    wanted = [[name, pages, {}] for pages in _PAGES for name in names][: count - read_only]
    yield from _full(folder, mount, wanted)
    reference = Reference(folder / "reference")
    for kind in list(FORMATS)[:read_only]:
        yield _read_only(folder, mount, reference, kind)


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(_TESTS), str(_TESTS / "stacks"), *sys.path])}


def _full(folder: Path, mount: list[str], wanted: list[list[object]]) -> Iterator[Trial]:
    whole, disk = folder / "whole", folder / "disk"
    whole.mkdir()
    disk.mkdir()
    prepare = (
        "import sys, pathlib; from small_stack import CONFIG, process_small, write_small\n"
        "folder = pathlib.Path(sys.argv[1]); write_small(folder / 'frames.tif')\n"
        "(folder / 'camera.toml').write_text(CONFIG)\n"
        "for name in sys.argv[2:]: process_small(folder / 'frames.tif', folder / name)"
    )
    names = sorted({str(name) for name, _, _ in wanted})
    subprocess.run([sys.executable, "-c", prepare, str(whole), *names], check=True, env=_environment())
    shell = f'mount -t tmpfs -o size=1m,mode=755 none "{disk}" && exec "$@"'
    program = [sys.executable, str(_TESTS / "stacks" / "small_disk.py")]
    arguments = [str(whole / "frames.tif"), str(whole), str(disk), json.dumps(wanted)]
    command = [*mount, shell, "sh", *program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=_environment())
    if done.returncode != 0:
        yield Trial("full disk", "traceback", done.stderr[-2000:])
        return
    for (name, pages, _), run in zip(wanted, json.loads(done.stdout.splitlines()[-1])["runs"], strict=True):
        title, message = f"{name}: {pages} pages left", run["message"]
        if not run["same"]:
            yield Trial(title, "wrong", "the resumed output differs")
        elif message == "done":
            yield Trial(title, "completed")
        elif "\n" in message or "No space left on device" not in message:
            yield Trial(title, "traceback", message)
        else:
            yield Trial(title, "lost" if run["output_exists"] else "refused", message)


def _read_only(folder: Path, mount: list[str], reference: Reference, kind: str) -> Trial:
    """A run into a folder of a read-only file system."""
    name, options = FORMATS[kind]
    disk = folder / "read-only"
    disk.mkdir(exist_ok=True)
    code, message = fork(_process_on_read_only, mount, disk, reference.source, name, options)
    title = f"{kind}: read-only disk"
    if content(disk):
        return Trial(title, "wrong", "files were written")
    one_line = code == 0 and str(message).startswith("refused: ") and "\n" not in str(message)
    return Trial(title, "refused" if one_line else "traceback", str(message))


def _process_on_read_only(mount: list[str], disk: Path, source: Path, name: str, options: dict[str, object]) -> str:
    """Mount a read-only file system in this child only, and process the stack into it."""
    import ctypes  # noqa: PLC0415

    library = ctypes.CDLL(None, use_errno=True)
    new_namespace, private, read_only, remount = 0x00020000, 0x44000, 0x1, 0x20
    if library.unshare(new_namespace) != 0:
        return "refused: namespaces are not permitted here"
    library.mount(b"none", b"/", None, private, None)
    library.mount(b"none", str(disk).encode(), b"tmpfs", 0, b"size=64k")
    library.mount(b"none", str(disk).encode(), b"tmpfs", read_only | remount, b"size=64k")
    try:
        process(source, disk / name, **options)
    except OSError as error:
        return f"refused: {error}"
    return "written"
