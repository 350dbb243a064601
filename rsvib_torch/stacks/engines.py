"""Parallel processing of windows: threads of this process, or Dask workers."""

import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import torch

from rsvib_torch.checks.values import needed_package
from rsvib_torch.execution.parallel import in_order, in_threads
from rsvib_torch.files.reading import Table
from rsvib_torch.stacks.heap import share_one_heap
from rsvib_torch.stacks.job import StackJob, StoredWindow, WindowFrames, WindowResult, read_windows
from rsvib_torch.stacks.windows import Window

if TYPE_CHECKING:
    from distributed import Client, Future

_Result = TypeVar("_Result")
_distributed = partial(needed_package, "distributed", "the Dask engine", "distributed")
NO_WORKERS_SECONDS = 60.0  # workers of a batch system start within this time after those before them ended


def compute_here(
    job: StackJob, windows: Sequence[Window], finish: Callable[[WindowResult, WindowFrames], _Result], *, at_once: int
) -> Generator[_Result, None, None]:
    """Compute windows in this process; ``finish`` gets a result and its frames in the thread that computed it."""

    def compute(window: Window, pixels: WindowFrames) -> _Result:
        return finish(job.compute(window, pixels), pixels)

    share_one_heap()
    # Sums of floats depend on the number of threads: results must not depend on how many windows are computed at once.
    threads = torch.get_num_threads() if all(window.alone for window in windows) else 1
    return in_threads(compute, read_windows(job, windows), at_once=at_once, threads=threads)


def _compute_on_worker(job: StackJob, window: Window) -> StoredWindow:
    share_one_heap(keep_freed=True)
    if job.options.device.startswith("cuda"):  # workers with a number as their name use the GPUs in turn
        count, name = torch.cuda.device_count(), _distributed().get_worker().name
        if count == 0:
            raise RuntimeError("this worker has no CUDA device; use device='cpu'")
        device = f"cuda:{int(name) % count}" if str(name).isdecimal() else "cuda:0"
        job = replace(job, options=replace(job.options, device=device))
    with closing(compute_here(job, [window], job.stored, at_once=1)) as results:
        return next(results)


def _dask_client(scheduler: str, workers: int) -> "Client":
    """A client of the scheduler at an address, or of a number of workers on this machine, which end with it."""
    options: Table = {"address": scheduler, "timeout": 30}
    if scheduler == "local":
        options = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "memory_limit": 0}
        options |= {"dashboard_address": None, "silence_logs": logging.ERROR}
    try:
        client: Client = _distributed().Client(**options, set_as_default=False)
    except (OSError, ValueError, RuntimeError) as error:
        failed = f"no Dask scheduler answers at {scheduler}"
        failed = "Dask workers cannot be started" if scheduler == "local" else failed
        raise OSError(f"{failed}: {' '.join(str(error).split())}") from error
    return client


def _wait(client: "Client", future: "Future[StoredWindow]", window: Window) -> StoredWindow:
    """The result of a window that Dask workers compute, as long as there are workers and a scheduler."""
    distributed = _distributed()
    last_seen = time.monotonic()
    while True:
        try:
            return future.result(timeout=1.0)
        except (distributed.TimeoutError, UnboundLocalError):  # of distributed, if its own wait is cancelled
            if future.done():
                return future.result()  # or its error
            if client.scheduler_info(n_workers=-1)["workers"]:
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > NO_WORKERS_SECONDS:
                gone = f"no Dask workers for {NO_WORKERS_SECONDS:g} s"
                raise OSError(f"{gone}; start workers, and resume the run") from None
        except distributed.KilledWorker as error:
            raise OSError(
                f"Dask workers died {error.allowed_failures + 1} times while they computed window {window.index} "
                f"(frames {window.first} to {window.last}); check their memory, and resume the run"
            ) from None
        except CancelledError as error:
            raise OSError("the connection to the Dask scheduler was lost; resume the run") from error


def compute_with_dask(
    job: StackJob, windows: Sequence[Window], *, scheduler: str, workers: int
) -> Generator[StoredWindow, None, None]:
    """Compute windows with Dask: each is one task that reads its frames and returns the frames to store, in order.

    Workers must be able to read the stack under the same path. If a worker fails, its tasks are repeated elsewhere. The
    scheduler ``"local"`` starts a number of workers on this machine.
    """
    job = replace(job, source=job.source.absolute())
    waiting: deque[tuple[Future[StoredWindow], Window]] = deque()
    with _dask_client(scheduler, workers) as client:

        def submit(window: Window) -> "tuple[Future[StoredWindow], Window]":
            # the job is sent with every task: scattered data are lost with the worker that holds them
            given = None if job.given is None else {window.index: job.given[window.index]}
            of_window = replace(job, given=given)
            return client.submit(_compute_on_worker, of_window, window, retries=3, pure=False), window

        def capacity() -> int:
            return 2 * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))

        try:
            yield from in_order(windows, submit, capacity, lambda pair: _wait(client, *pair), waiting)
        finally:
            with suppress(Exception):
                client.cancel([task for task, _ in waiting])
