"""Dask on one machine: time per frame with one and two workers, CPU time of each process, and bytes transferred.

Workers are processes with one thread each; they start, import and warm up before anything is timed. Costs are CPU
seconds, which depend little on other load of the machine; the limit of linear scaling is computed from them.
"""

import argparse
import pickle
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks import streaming
from harness import Rows, table

from rsvib_torch.io import open_stack
from rsvib_torch.stacks.job import StackJob
from rsvib_torch.stacks.windows import cut_windows

OPTIONS = {
    "dask_frames": (113, "dask: length of the stack"),
    "dask_size": (512, "dask: rows and columns"),
    "dask_workers": ((1, 2), "dask: numbers of workers"),
}
QUICK = {"dask_frames": 22, "dask_size": 96, "dask_workers": (1,)}
_LINKS = {"1 Gbit/s": 125e6, "10 Gbit/s": 1250e6}  # bytes per second


def _local_bytes() -> int | None:
    """Bytes sent through the loopback interface, if the system reports them."""
    path = Path("/proc/net/dev")
    if not path.exists():
        return None
    line = next(line for line in path.read_text(encoding="utf-8").splitlines() if line.strip().startswith("lo:"))
    return int(line.split(":")[1].split()[8])


def _payload(source: Path, size: int) -> dict[str, float]:
    """Bytes read and bytes returned by a window, per frame that it writes."""
    reader = open_stack(source)
    info = replace(reader.info, full_scale=4095.0)
    job = StackJob(source, info, streaming.timing_of(size), 4095.0, streaming.DETECTION, streaming.RESTORATION)
    window = cut_windows(info.shape[0], streaming.WINDOW)[0]
    pixels = [reader.frame(index) for index in window.frames]
    reader.close()
    stored = job.stored(job.compute(window, list(pixels)), list(pixels))
    read = sum(frame.nbytes for frame in pixels)
    return {"read": read / window.kept, "sent": len(pickle.dumps(stored, protocol=5)) / window.kept}


def _one_cluster(workers: int, source: Path, few: Path, sink: Path, size: int, runs: int) -> dict[str, Any]:
    import distributed  # noqa: PLC0415 - an extra

    with (
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        streaming.process(few, sink, size, scheduler=cluster.scheduler_address)  # imports and warm-up of every worker
        timed = []
        for _ in range(runs):
            there, here = sum(client.run(time.process_time).values()), time.process_time()
            moved, begin = _local_bytes(), time.perf_counter()
            report = streaming.process(source, sink, size, scheduler=cluster.scheduler_address)
            seconds = time.perf_counter() - begin
            moved = None if moved is None else (_local_bytes() or 0) - moved
            cost = sum(client.run(time.process_time).values()) - there
            timed.append((seconds, cost, time.process_time() - here, moved, report.frames))
    frames = timed[0][-1]
    return {
        "name": f"Dask, {workers} workers",
        "seconds_a_frame": min(run[0] for run in timed) / frames,
        "worker_cpu_a_frame": statistics.median(run[1] for run in timed) / frames,
        "here_cpu_a_frame": statistics.median(run[2] for run in timed) / frames,
        "moved_a_frame": None if timed[0][3] is None else statistics.median(run[3] for run in timed) / frames,
    }


def rows(options: argparse.Namespace) -> Rows:
    """A local run on one thread, then Dask with each number of workers; the output must be the same."""
    size, runs = options.dask_size, max(1, min(options.runs, 3))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, few = folder / "frames.npy", folder / "few.npy"
        streaming.write_long(source, options.dask_frames, size)
        streaming.write_long(few, 8 * (streaming.WINDOW - 1) + 1, size)
        payload = _payload(source, size)
        here = [streaming.process(source, folder / "out.tif", size, workers=1).seconds for _ in range(runs)]
        results = [{"name": "here, one worker", "seconds_a_frame": min(here) / options.dask_frames, **payload}]
        expected = (folder / "out.tif").read_bytes()
        for workers in options.dask_workers:
            results.append(_one_cluster(workers, source, few, folder / "dask.tif", size, runs))
            results[-1]["same"] = (folder / "dask.tif").read_bytes() == expected
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as a Markdown table, and the limits of linear scaling."""
    cells = []
    for row in results:
        cpu = (f"{row[key]:.4f}" if key in row else "" for key in ("worker_cpu_a_frame", "here_cpu_a_frame"))
        moved = "" if row.get("moved_a_frame") is None else f"{row['moved_a_frame'] / 1e6:.2f}"
        same = "" if "same" not in row else "yes" if row["same"] else "NO"
        cells.append((row["name"], f"{row['seconds_a_frame']:.4f}", *cpu, moved, same))
    heads = ("run", "s per frame", "CPU s of workers", "CPU s of scheduler, client and writer")
    text = [
        f"Dask on this machine: {options.dask_frames} frames of {options.dask_size} x {options.dask_size} px, 16 bit.",
        "",
        *table((*heads, "MB over the local network", "same bytes"), cells),
    ]
    clusters = results[1:]
    if len(clusters) > 1:
        gain = clusters[0]["seconds_a_frame"] / clusters[-1]["seconds_a_frame"]
        text += [f"{clusters[-1]['name']}: {gain:.2f} times the rate of {clusters[0]['name']}.", ""]
    read, sent = results[0]["read"], results[0]["sent"]
    work, here = clusters[0]["worker_cpu_a_frame"], min(row["here_cpu_a_frame"] for row in clusters)
    limits = {"this process": work / here, **{link: work * rate / sent for link, rate in _LINKS.items()}}
    return [
        *text,
        f"Per frame: {read / 1e6:.2f} MB read by a worker, {sent / 1e6:.2f} MB returned.",
        "Linear scaling ends when the writing process or its network link is saturated: "
        + ", ".join(f"{name} at {count:.0f} workers" for name, count in limits.items())
        + ".",
    ]
