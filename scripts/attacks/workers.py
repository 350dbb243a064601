"""Dask workers that are killed, die in every window, or are all gone: the run completes, or ends with a message."""

import os
import signal
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import distributed
import numpy as np
from attacks.files import FULL_SCALE, vibrating_counts, write_tiff
from attacks.trial import Trial
from small_stack import TIMING

import rsvib_torch as rsv
from rsvib_torch.stacks import engines

_FRAMES, _WINDOW = 33, 3
_SECONDS = 150.0  # limit of a trial


class _DyingWorker(distributed.WorkerPlugin):
    """Kills its worker some time after it has started."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def setup(self, worker: distributed.Worker) -> None:
        signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        signal.setitimer(signal.ITIMER_REAL, self.seconds)


def _process(folder: Path, sink: str, **options: object) -> None:
    common = {"detection": {"method": "bands", "tones": 1}, "restoration": {"method": "dewarp"}, "window": _WINDOW}
    common |= {"full_scale": FULL_SCALE, "workers": 2}
    rsv.process_stack(folder / "frames.tif", folder / sink, TIMING, **common | options)


def _same(folder: Path, sink: str) -> bool:
    return (folder / sink).read_bytes() == (folder / "expected.tif").read_bytes()


def _killed(folder: Path, cluster: distributed.LocalCluster, sink: str, after: int) -> Trial:
    """A worker is killed when some windows are complete; another one starts, and the output is the same."""
    name, killed = f"a worker is killed after {after} frames", []

    def kill(done: int, total: int) -> None:
        if done > after and not killed:
            worker = next(iter(cluster.workers.values()))
            killed.append(worker.process.process.pid)
            os.kill(killed[0], signal.SIGKILL)

    _process(folder, sink, scheduler=cluster.scheduler_address, progress=kill)
    if not killed:
        return Trial(name, "wrong", "no worker was killed")
    return Trial(name, "completed" if _same(folder, sink) else "wrong")


def _refused(name: str, folder: Path, sink: str, words: str, scheduler: str) -> Trial:
    """The run is complete, or ends with an ``OSError`` with ``words``; ``resume`` completes it without Dask."""
    begin = time.monotonic()
    try:
        _process(folder, sink, scheduler=scheduler)
        # workers that complete a window before they die complete the run
        return Trial(name, "completed" if _same(folder, sink) else "wrong", "the run did not end with an error")
    except OSError as error:
        message = str(error)
    if words not in message or "\n" in message:
        return Trial(name, "traceback", message)
    if time.monotonic() - begin > _SECONDS:
        return Trial(name, "hang", f"{time.monotonic() - begin:.0f} s")
    _process(folder, sink, resume=True)
    return Trial(name, "refused" if _same(folder, sink) else "lost", message)


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Up to ``count`` trials, most of them with a worker that is killed at a random time."""
    write_tiff(folder / "frames.tif", vibrating_counts(TIMING, _FRAMES, (96, 96), seed))
    _process(folder, "expected.tif")
    generator = np.random.default_rng(seed)
    engines.NO_WORKERS_SECONDS = 10.0
    cluster_of = partial(distributed.LocalCluster, threads_per_worker=1, dashboard_address=None, silence_logs=50)
    failing = ("every worker dies while it computes", "no worker", "the scheduler ends")
    with cluster_of(n_workers=2) as cluster:
        for trial in range(max(0, count - len(failing))):
            after = int(generator.integers(1, _FRAMES - 2 * _WINDOW))
            yield _killed(folder, cluster, f"killed{trial}.tif", after)
    if count < len(failing):
        return
    with cluster_of(n_workers=1) as cluster, distributed.Client(cluster, set_as_default=False) as client:
        client.register_plugin(_DyingWorker(0.5))
        yield _refused(failing[0], folder, "dying.tif", "Dask workers", cluster.scheduler_address)
    with cluster_of(n_workers=0) as cluster:
        yield _refused(failing[1], folder, "none.tif", "no Dask workers for 10 s", cluster.scheduler_address)
    cluster = cluster_of(n_workers=0)
    address = cluster.scheduler_address
    cluster.close()
    yield _refused(failing[2], folder, "closed.tif", "no Dask scheduler answers", address)
