"""Trials in a warm child process, which has imported the package: one trial takes milliseconds instead of seconds."""

import contextlib
import math
import multiprocessing
import os
import resource
import signal
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from attacks.trial import Trial

Attempt = Callable[[Path, Any], str]


def _unclear(text: str) -> str:
    """What is wrong with the form of a message; empty if nothing is."""
    lines = text.splitlines()
    if len(lines) not in range(1, 26) or len(max(lines, key=len)) > 1200:  # a path has 40 characters here
        return f"message of {len(lines)} lines, {len(text)} characters: {text}"
    return ""


def _tried(attempt: Attempt, folder: Path, name: str, item: Any) -> Trial:
    try:
        wrong = attempt(folder, item)
    except (ValueError, TypeError, OSError) as error:
        text = str(getattr(error, "strerror", None) or error)  # the system repeats names that are too long
        fault = _unclear(text)
        return Trial(name, "wrong" if fault else "refused", (fault or str(error))[:300])
    except MemoryError as error:
        return Trial(name, "memory", str(error)[:300])
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        detail = f"{Path(last.filename).name}:{last.lineno}: {type(error).__name__}: {error}"[:300]
        return Trial(name, "memory" if "allocate" in str(error) else "traceback", detail)
    return Trial(name, "wrong" if wrong else "completed", wrong)


def _serve(
    connection: Connection,
    attempt: Attempt,
    prepare: Callable[[Path], Any] | None,
    folder: Path,
    limit: float,
    memory: int,
) -> None:
    """Run trials until the other end closes the connection; output of libraries is discarded."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    if prepare is not None:
        prepare(folder)
    with open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), 1)
        os.dup2(nothing.fileno(), 2)
    used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()  # data and stack
    resource.setrlimit(resource.RLIMIT_DATA, (used + memory, used + memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (memory, memory))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    connection.send(None)
    with contextlib.suppress(EOFError):
        while True:
            name, item = connection.recv()
            end = math.ceil(sum(os.times()[:2]) + limit)  # s of processor time; then SIGXCPU ends the process
            resource.setrlimit(resource.RLIMIT_CPU, (end, resource.RLIM_INFINITY))
            connection.send(_tried(attempt, folder, name, item))


def in_warm_child(
    attempt: Attempt,
    items: Iterable[tuple[str, Any]],
    folder: Path,
    *,
    limit: float = 60.0,
    memory: int = 10**9,
    prepare: Callable[[Path], Any] | None = None,
) -> Iterator[Trial]:
    """Run one trial per item in a child process, which is replaced after a trial that ended or blocked it.

    Args:
        attempt: ``attempt(folder, item)``, a function of a module; it returns what is wrong with the result, an empty
            text if nothing is.
        items: Names of the trials, and what is tried.
        folder: Folder for files.
        limit: Limit of the processor time of a trial in s; ten times as much may pass on a busy machine.
        memory: Bytes that the child may allocate in addition to what it uses at the start.
        prepare: Makes what all trials share, in every new child.
    """
    context = multiprocessing.get_context("spawn")
    child = None
    try:
        for name, item in items:
            if child is None:
                connection, other = context.Pipe()
                arguments = (other, attempt, prepare, folder, limit, memory)
                child = context.Process(target=_serve, args=arguments, daemon=True)
                child.start()
                other.close()
                connection.recv()
            connection.send((name, item))
            hangs = not connection.poll(10 * limit)
            try:
                if not hangs:
                    yield connection.recv()
                    continue
            except EOFError:
                child.join()
                hangs = child.exitcode == -signal.SIGXCPU
            if hangs:
                yield Trial(name, "hang", f"not finished after {limit:g} s of processor time")
            else:
                yield Trial(name, "traceback", f"the process ended with exit code {child.exitcode}")
            child.kill()
            child = None
    finally:
        if child is not None:
            child.kill()
