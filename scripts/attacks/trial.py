"""The result of one trial of an attack, and how a child process is watched."""

import contextlib
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import psutil

Outcome = Literal["completed", "refused", "lost", "wrong", "traceback", "hang", "memory"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
FAILURES = OUTCOMES[2:]


@dataclass(frozen=True)
class Trial:
    """One trial."""

    name: str  # what was tried, precise enough to repeat it
    # ``completed``: correct result. ``refused``: a one-line error, and nothing was changed. ``lost``: a file of the
    # user, or a finished part of the result, is damaged or missing. ``wrong``: success was reported, but the result is
    # wrong or incomplete. ``traceback``: an exception that is neither ValueError, TypeError nor OSError in Python, or a
    # traceback or another exit code than 0 and 2 on the command line. ``hang``: the time limit passed. ``memory``: more
    # memory than permitted was used.
    outcome: Outcome
    detail: str = ""  # message or difference, for the list of failures


@dataclass(frozen=True)
class Process:
    """A finished child process: exit code (None after the time limit), output, seconds, peak memory in bytes."""

    code: int | None
    output: str
    seconds: float
    peak_memory: int


def run_watched(command: Sequence[str], *, limit: float, folder: Path) -> Process:
    """Run a command in a folder and measure the peak resident memory of its process tree.

    All processes of the tree are ended after ``limit`` s; ``output.txt`` in the folder receives the output.
    """
    begin = time.perf_counter()
    path = folder / "output.txt"
    with path.open("wb") as output:
        child = subprocess.Popen(command, cwd=folder, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        tree, peak = psutil.Process(child.pid), 0
        while child.poll() is None and time.perf_counter() - begin < limit:
            with contextlib.suppress(psutil.NoSuchProcess):  # of a process that has ended since it was listed
                # a child that has not started its own program yet shares the memory of its parent
                others = [one for one in tree.children(recursive=True) if one.cmdline() != tree.cmdline()]
                peak = max(peak, sum(member.memory_info().rss for member in [tree, *others]))
            time.sleep(0.02)
        expired = child.poll() is None
        if expired:
            for member in [*tree.children(recursive=True), tree]:
                member.kill()
        child.wait()
    text = path.read_text(encoding="utf-8", errors="replace")
    return Process(None if expired else child.returncode, text, time.perf_counter() - begin, peak)


def rsvib(*arguments: str | Path) -> list[str]:
    """Command line of the ``rsvib`` program of this interpreter."""
    return [sys.executable, "-m", "rsvib_torch", *map(str, arguments)]


def outcome_of_command(process: Process) -> Outcome:
    """``completed``, ``refused``, ``traceback`` or ``hang``, from exit code and output of ``rsvib``."""
    if process.code is None:
        return "hang"
    if "Traceback (most recent call last)" in process.output or process.code not in (0, 2):
        return "traceback"
    return "completed" if process.code == 0 else "refused"
