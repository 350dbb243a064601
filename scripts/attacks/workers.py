"""Dask workers that are killed, or die in every window: the run completes, or ends with a message."""

import os
import signal
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import distributed
import numpy as np
from attacks.trial import Trial
from small_stack import FRAMES, process_small, write_small

_SECONDS = 150.0  # limit of the run whose workers die


class _DyingWorker(distributed.WorkerPlugin):
    """Kills its worker half a second after it has started."""

    def setup(self, worker: distributed.Worker) -> None:
        signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        signal.setitimer(signal.ITIMER_REAL, 0.5)


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

    process_small(folder / "frames.tif", folder / sink, scheduler=cluster.scheduler_address, progress=kill)
    if not killed:
        return Trial(name, "wrong", "no worker was killed")
    return Trial(name, "completed" if _same(folder, sink) else "wrong")


def _dying(folder: Path, scheduler: str) -> Trial:
    """Every worker dies: the run is complete, or ends with one line; it is completed without Dask."""
    name, begin, message = "every worker dies while it computes", time.monotonic(), ""
    try:
        process_small(folder / "frames.tif", folder / "dying.tif", scheduler=scheduler)
    except OSError as error:
        message = str(error)
        process_small(folder / "frames.tif", folder / "dying.tif", resume=True)
    if message and ("Dask workers" not in message or "\n" in message):
        return Trial(name, "traceback", message)
    if time.monotonic() - begin > _SECONDS:
        return Trial(name, "hang", f"{time.monotonic() - begin:.0f} s")
    done = "refused" if message else "completed"  # by workers that complete a window before they die
    return Trial(name, done if _same(folder, "dying.tif") else "lost", message)


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """A worker is killed at a random time; in the last trial, all die."""
    write_small(folder / "frames.tif")
    process_small(folder / "frames.tif", folder / "expected.tif")
    generator = np.random.default_rng(seed)
    cluster_of = partial(distributed.LocalCluster, threads_per_worker=1, dashboard_address=None, silence_logs=50)
    with cluster_of(n_workers=2) as cluster:
        for trial in range(count - 1):
            yield _killed(folder, cluster, f"killed{trial}.tif", int(generator.integers(1, FRAMES - 6)))
    with cluster_of(n_workers=1) as cluster, distributed.Client(cluster, set_as_default=False) as client:
        client.register_plugin(_DyingWorker())
        yield _dying(folder, cluster.scheduler_address)
