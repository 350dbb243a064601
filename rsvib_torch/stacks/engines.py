"""Who works on the windows: threads of this process, or Dask workers."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, TypeVar

import torch

from rsvib_torch.io.formats import needed_package
from rsvib_torch.stacks.heap import keep_freed_memory, share_one_heap
from rsvib_torch.stacks.job import StackJob, StoredWindow, WindowFrames, WindowReader, WindowResult
from rsvib_torch.stacks.windows import Window

__all__ = ["compute_here", "compute_with_dask"]

_Done = TypeVar("_Done")
_RETRIES = 3
_AHEAD = 2  # windows a Dask worker is given beyond the one that it works on


def _several(windows: Sequence[Window]) -> bool:
    """Whether every window is to be computed on one thread: where there are several.

    Sums of floats depend on how many threads share them: with one, a window comes out the same however many others
    are worked on at once.
    """
    return not all(window.alone for window in windows)


def compute_here(
    job: StackJob,
    windows: Sequence[Window],
    finish: Callable[[WindowResult, WindowFrames], _Done],
    *,
    at_once: int,
) -> Iterator[_Done]:
    """Work on windows in threads of this process; one more thread reads ahead.

    Args:
        job: What to do.
        windows: The windows, in order.
        finish: What to make of a result and the pixels it came from, still in the thread that computed it.
        at_once: Windows to work on at once.

    Yields:
        What ``finish`` made, in the order of the windows.
    """
    share_one_heap()
    reader = WindowReader(job.source, job.info)
    before = torch.get_num_threads()

    def set_threads() -> None:
        torch.set_num_threads(1 if _several(windows) else before)

    reading = ThreadPoolExecutor(1, "rsvib-read")
    computing = ThreadPoolExecutor(at_once, "rsvib-compute", initializer=set_threads)
    stopped = threading.Event()

    def compute(window: Window, frames: "Future[WindowFrames]") -> _Done:
        pixels = frames.result()
        if stopped.is_set():
            raise RuntimeError("stopped")
        return finish(job.compute(window, pixels), pixels)

    waiting: deque[Future[_Done]] = deque()
    left = iter(windows)
    try:
        while True:
            while len(waiting) < at_once + 1 and (window := next(left, None)) is not None:
                waiting.append(computing.submit(compute, window, reading.submit(reader.read, window)))
            if not waiting:
                break
            yield waiting.popleft().result()
    finally:
        stopped.set()
        reading.shutdown(wait=True, cancel_futures=True)
        computing.shutdown(wait=True, cancel_futures=True)
        torch.set_num_threads(before)  # what threads that start later begin with
        reader.close()


def _compute_there(job: StackJob, window: Window, several: bool) -> StoredWindow:
    """Read, compute and store one window, on a Dask worker."""
    share_one_heap()
    keep_freed_memory()
    threads = torch.get_num_threads()
    if several:
        torch.set_num_threads(1)
    try:
        if job.device.startswith("cuda"):
            job = replace(job, device=_own_device())
        reader = WindowReader(job.source, job.info)
        try:
            pixels = reader.read(window)
        finally:
            reader.close()
        return job.stored(job.compute(window, pixels), pixels)
    finally:
        torch.set_num_threads(threads)


def _own_device() -> str:
    """The GPU of this worker: workers are numbered, and take turns."""
    count = torch.cuda.device_count()
    if count == 0:
        raise RuntimeError("this worker has no CUDA device")
    name = needed_package("distributed", "the Dask engine", "distributed").get_worker().name
    return f"cuda:{int(name) % count}" if str(name).isdecimal() else "cuda:0"


@contextmanager
def _dask_client(scheduler: str, workers: int) -> Iterator[Any]:
    distributed = needed_package("distributed", "the Dask engine", "distributed")
    if scheduler != "local":
        try:
            client = distributed.Client(scheduler, timeout=30, set_as_default=False)
        except (OSError, ValueError) as error:
            raise OSError(f"no Dask scheduler answers at {scheduler}: {' '.join(str(error).split())}") from error
        with client:
            yield client
        return
    options = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.ERROR}
    with (
        distributed.LocalCluster(**options, processes=True, memory_limit=0) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


def compute_with_dask(
    job: StackJob, windows: Sequence[Window], *, scheduler: str, workers: int
) -> Iterator[StoredWindow]:
    """Work on windows with Dask: one task a window, which reads its frames itself and sends back what is to be stored.

    Workers must see the stack under the same path. A task whose worker is lost goes to another one.

    Args:
        job: What to do.
        windows: The windows, in order.
        scheduler: Address like ``tcp://host:8786``, or ``"local"`` for workers on this machine.
        workers: Workers of a local cluster.

    Yields:
        Frames to store, in the order of the windows.
    """
    job = replace(job, source=job.source.absolute())
    several = _several(windows)
    with _dask_client(scheduler, workers) as client:
        waiting: deque[Any] = deque()
        left = iter(windows)
        try:
            while True:
                room = max(1, _AHEAD * max(1, len(client.scheduler_info(n_workers=-1)["workers"])))
                while len(waiting) < room and (window := next(left, None)) is not None:
                    # the job goes along: what is scattered is lost with the worker that holds it
                    task = (job.of_window(window), window, several)
                    waiting.append(client.submit(_compute_there, *task, retries=_RETRIES, pure=False))
                if not waiting:
                    break
                yield waiting.popleft().result()
        finally:
            with suppress(Exception):
                client.cancel(list(waiting))
