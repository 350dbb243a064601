"""Short runs of ``process_stack`` in all formats, in child processes that can be killed, for the attacks on storage.

Children are forked from a server that has imported the package, because the import takes longer than a run.
"""

import functools
import itertools
import json
import multiprocessing
import os
import random
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from attacks.files import DETECTION, FULL_SCALE, vibrating_counts, write_tiff
from attacks.trial import Trial

import rsvib_torch as rsv
from rsvib_torch.stacks import read_manifest

FRAMES, SIZE, WINDOW = 13, 64, 3
TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=72)
WINDOWS = 6
FORMATS = {"TIFF": "out.tif", "npy": "out.npy", "HDF5": "out.h5", "PNG folder": "frames", "video": "out.mkv"}
_CALLS = ("write", "pwrite", "replace", "fsync", "fdatasync", "ftruncate", "unlink", "mkdir", "rmdir", "rename")
LIMIT = 100.0  # s for one run, which takes less than one on an idle machine


@functools.cache
def server() -> Any:
    """Context of multiprocessing whose server has imported the package."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        [
            "rsvib_torch.commands.main",
            "rsvib_torch.report.results",
            "rsvib_torch.stacks.process",
            "rsvib_torch.restoration.restore",
            "rsvib_torch.detection.detect",
            "torch.fx.experimental.symbolic_shapes",  # torch imports it when it is used first
            "h5py",
            "av",
            "attacks.small_runs",
        ]
    )
    return context


def process(source: Path, sink: Path, **options: Any) -> Any:
    """Restore the small stack with known vibrations, so that a run takes a fraction of a second."""
    torch.set_num_threads(1)
    common = {"window": WINDOW, "restoration": {"method": "dewarp"}, "full_scale": FULL_SCALE, "workers": 1}
    if "given" not in options:
        common["given"] = read_manifest(source.with_name("vibrations.json")).detections()
    return rsv.process_stack(source, sink, TIMING, **common | options)


def _prepare(folder: Path) -> None:
    """Write the stack, the vibrations of its windows, and the results of uninterrupted runs in all formats."""
    torch.set_num_threads(1)
    source = folder / "frames.tif"
    write_tiff(source, vibrating_counts(TIMING, FRAMES, (SIZE, SIZE), seed=2))
    manifest = folder / "vibrations.json"
    process(source, folder / "first.npy", given=None, detection=DETECTION, manifest=manifest)
    for name in FORMATS.values():
        report = process(source, folder / "whole" / name)
        assert (report.frames, report.windows) == (FRAMES, WINDOWS)
        assert report.restored > 0


class Reference:
    """The stack and the results of uninterrupted runs, in a folder."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        code, message = fork(_prepare, folder)
        if code != 0:
            raise RuntimeError(f"the reference cannot be computed: {message}")
        self.source, self.whole = folder / "frames.tif", folder / "whole"

    def difference(self, folder: Path, name: str) -> str:
        """How a result differs from that of an uninterrupted run, with the other files in its folder; "" if not."""
        if not (folder / name).exists():
            return "the output is missing"
        if content(folder / name) != content(self.whole / name):
            return "the output differs from that of an uninterrupted run"
        manifest = f"{name}.manifest.json"
        records = [path / manifest for path in (folder, self.whole)]
        if not records[0].exists() or len({json.dumps(json.loads(path.read_text())) for path in records}) > 1:
            return "the manifest differs"
        extra = {path.name for path in folder.iterdir()} - {name, manifest}
        return f"files are left: {', '.join(sorted(extra))}" if extra else ""


def content(path: Path) -> dict[str, bytes]:
    """All files at and below a path."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def _call(function: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any], channel: Any) -> None:
    try:
        result = function(*arguments, **options)
    except (ValueError, TypeError, OSError) as error:
        channel.send((2, str(error)))
    except BaseException as error:
        channel.send((1, repr(error)))
    else:
        channel.send((0, result if isinstance(result, (int, str)) else ""))


class Child:
    """A function that runs in a child process."""

    def __init__(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> None:
        self._answer, sending = server().Pipe(duplex=False)
        self._process = server().Process(target=_call, args=(function, arguments, options, sending))
        self._process.start()
        sending.close()

    @property
    def runs(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.exitcode is None

    def ended(self, seconds: float = LIMIT) -> tuple[Any, Any]:
        """Exit code, and result or message, of a process that is killed after some seconds.

        The code is 0 after a success, 2 after a ``ValueError``, ``TypeError`` or ``OSError``, 1 after another
        exception, and None if the process was killed.
        """
        self._process.join(seconds)
        if self.runs:
            self._process.kill()
            self._process.join()
            return (None, "killed after the time limit")
        try:
            return self._answer.recv()
        except EOFError:
            return self._process.exitcode, ""


def fork(function: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[Any, Any]:
    """Call a function in a child process; returns what ``Child.ended`` does."""
    return Child(function, *arguments, **options).ended()


def count_file_calls(die_at: int, after: Callable[[str, Any], None] | None = None) -> list[int]:
    """Kill this process at its n-th call that changes a file (0: never); returns the number of calls so far.

    ``after`` is called with the name of a call and its arguments after it has succeeded.
    """
    numbers, lock, done = itertools.count(1), threading.RLock(), [0]
    inside = threading.local()

    def wrap(name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if getattr(inside, "call", False):  # of ``after`` itself
                return real(*arguments, **options)
            with lock:
                done[0] = next(numbers)
                if done[0] == die_at:
                    os.kill(os.getpid(), signal.SIGKILL)
                    time.sleep(60)
                result = real(*arguments, **options)
                if after is not None:
                    inside.call = True
                    after(name, arguments)
                    inside.call = False
                return result

        return call

    for name in _CALLS:
        setattr(os, name, wrap(name, getattr(os, name)))
    return done


def counted_run(source: Path, sink: Path, die_at: int) -> int:
    """Process the stack, and die at a call; returns the number of calls."""
    done = count_file_calls(die_at)
    process(source, sink)
    return done[0]


def resume(source: Path, sink: Path) -> int:
    """Resume a run; returns the number of windows that were complete before."""
    resumed: int = process(source, sink, resume=True).resumed
    return resumed


def in_turn(folder: Path, count: int) -> Iterator[tuple[int, str, Path]]:
    """Numbers of trials, formats that take turns, and an empty folder, which is removed after the trial."""
    place = folder / "trial"
    for number, kind in zip(range(count), itertools.cycle(FORMATS), strict=False):
        place.mkdir()
        yield number, kind, place
        shutil.rmtree(place)


@functools.cache
def calls_of(reference: Reference, kind: str) -> int:
    """Number of calls of an uninterrupted run that change files."""
    folder = reference.whole.with_name("counted")
    folder.mkdir(exist_ok=True)
    code, calls = fork(counted_run, reference.source, folder / FORMATS[kind], 0)
    assert code == 0, calls
    return int(calls)


def finished_windows(folder: Path, name: str) -> int:
    """Number of windows of an interrupted run that have a complete record."""
    records = (folder / f".{name}.rsvib").glob("0*.json")
    return sum(path.read_bytes().endswith(b"}") and b"\0" not in path.read_bytes() for path in records)


def kill_run(reference: Reference, folder: Path, kind: str, choice: random.Random, *, windows: int) -> None:
    """A folder with a run that was killed after at least a number of windows."""
    name = FORMATS[kind]
    while True:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        die_at = choice.randint(1, calls_of(reference, kind))
        fork(counted_run, reference.source, folder / name, die_at)
        if finished_windows(folder, name) >= windows:
            return


def completed_or_refused(title: str, code: int | None, result: Any, difference: str) -> Trial:
    """Trial of a process that may refuse in one line; ``difference`` of its result if it is complete."""
    if code is None:
        return Trial(title, "hang")
    if code == 0:
        return Trial(title, "wrong" if difference else "completed", difference)
    return Trial(title, "traceback" if code != 2 or "\n" in str(result) else "refused", str(result))
