"""Long stacks: memory and time per frame over the number of frames, overlap of computation with input and output.

A few simulated frames are repeated to form long stacks. Every run is a separate process, in which peak memory is
measured.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from harness import Rows, plain_environment, table

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.stacks import process_stack
from rsvib_torch.stacks.job import StackJob
from rsvib_torch.stacks.windows import cut_windows

OPTIONS = {
    "frames": ((100, 1000), "streaming: lengths of the stacks"),
    "frame_size": (1024, "streaming: rows and columns"),
    "memory": ("2GB", "streaming: memory of the process"),
}
QUICK = {"frames": (22,), "frame_size": 128}
_DRAWN, WINDOW = 14, 8  # frames; period of the vibration, and of the stack
DETECTION = {"method": "bands", "tones": 1, "band_step": 32, "search": 8}
RESTORATION = {"method": "dewarp"}
_RUN = """
import json, sys
import torch
torch.set_num_threads(1)
from benchmarks import streaming
print(json.dumps(streaming.one_run(**json.loads(sys.argv[1]))))
"""


def timing_of(size: int) -> rsv.SensorTiming:
    """A camera with this number of rows, and some blanking rows."""
    return rsv.SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=size + 32)


def write_long(path: Path, count: int, size: int) -> None:
    """A stack of 16-bit frames, written piece by piece."""
    scene = city_and_fields(size + 80, size + 80, seed=3)
    timing = timing_of(size)
    frequencies = [turns / (_DRAWN * timing.frame_period) for turns in (21, 33)]
    vibration = rsv.Vibration([1.6, 1.1], frequencies, [0.6, -1.2])
    taken = rsv.simulate_frames(scene, timing, vibration, _DRAWN, frame_size=(size, size))
    noise = np.random.default_rng(1)
    drawn = [np.clip(np.round(frame * 4095 + noise.normal(0, 8, frame.shape)), 0, 4095) for frame in taken.numpy()]
    stack = np.lib.format.open_memmap(path, "w+", "u2", (count, size, size))
    for index in range(count):
        stack[index] = drawn[index % _DRAWN]
    stack.flush()


def peak_memory() -> float:
    """Peak memory of this process in bytes."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return 1024.0 * int(line.split()[1])
    raise OSError("the kernel does not report peak memory")


def process(source: Path | str, sink: Path | str, size: int, **options: Any) -> Any:
    """Process a stack; returns its report."""
    common: dict[str, Any] = {"window": WINDOW, "detection": DETECTION, "restoration": RESTORATION, "full_scale": 4095}
    return process_stack(source, sink, timing_of(size), **common | options)


def one_run(source: str, sink: str, size: int, **options: Any) -> dict[str, Any]:
    """Process a stack in this process."""
    import resource  # noqa: PLC0415 - not available on all systems

    begin = time.perf_counter()
    report = process(source, sink, size, **options)
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = time.perf_counter() - begin
    return {
        "frames": report.frames,
        "restored_windows": report.restored,
        "windows": report.windows,
        "seconds": seconds,
        "seconds_a_frame": seconds / report.frames,
        "cpu_seconds_a_frame": (used.ru_utime + used.ru_stime) / report.frames,
        "peak_memory_gb": peak_memory() / 1e9,
    }


def run_apart(**arguments: Any) -> dict[str, Any]:
    """``one_run`` in a separate process."""
    done = subprocess.run(
        [sys.executable, "-c", _RUN, json.dumps(arguments)],
        cwd=Path(__file__).parents[1],
        env=plain_environment(),
        check=True,
        capture_output=True,
        text=True,
    )
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def _computing_alone(source: Path, size: int, windows: int) -> float:
    """Seconds per frame of computation only: frames are in memory, and nothing is written; one thread."""
    reader = rsv.open_stack(source)
    job = StackJob(source, reader.info, timing_of(size), 4095.0, DETECTION, RESTORATION)
    cut = cut_windows(reader.info.shape[0], WINDOW)[:windows]
    pixels = [[reader.frame(index) for index in window.frames] for window in cut]
    reader.close()
    job.compute(cut[0], list(pixels[0]))
    begin = time.perf_counter()
    for window, frames in zip(cut, pixels, strict=True):
        job.compute(window, list(frames))
    return (time.perf_counter() - begin) / sum(window.kept for window in cut)


def rows(options: argparse.Namespace) -> Rows:
    """Runs of each length; then one worker with and without input and output, alternating."""
    import torch  # noqa: PLC0415

    results: Rows = []
    size = options.frame_size
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sink = folder / "out.tif"
        for count in options.frames:
            source = folder / "frames.npy"
            write_long(source, count, size)
            common = {"source": str(source), "sink": str(sink), "size": size}
            run = run_apart(**common, memory=options.memory)
            results.append({"name": f"{count} frames, memory {options.memory}", **run})
        few = 3 * (WINDOW - 1) + 1
        write_long(folder / "few.npy", few, size)
        common |= {"source": str(folder / "few.npy")}
        torch.set_num_threads(1)
        works: dict[str, Callable[[], Any]] = {
            "computation only, one thread": lambda: _computing_alone(folder / "few.npy", size, 3),
            "with input and output, one worker": lambda: one_run(**common, workers=1),
        }
        best = dict.fromkeys(works, math.inf)
        for turn in range(1 + options.runs):
            for what, work in works.items():
                result = work()
                seconds = result if isinstance(result, float) else result["seconds_a_frame"]
                best[what] = min(best[what], seconds if turn else math.inf)  # the first run is a warm-up
        results += [{"name": name, "seconds_a_frame": seconds} for name, seconds in best.items()]
        results[-1]["rate"] = results[-2]["seconds_a_frame"] / results[-1]["seconds_a_frame"]
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as Markdown tables."""
    names = ("seconds_a_frame", "cpu_seconds_a_frame", "peak_memory_gb")
    text = [
        f"Stacks of {options.frame_size} x {options.frame_size} 16-bit frames, windows of {WINDOW}, bands and dewarp.",
        "",
        *table(
            ("run", "s per frame", "CPU s per frame", "peak memory (GB)"),
            [(row["name"], *(f"{row[name]:.3f}" if name in row else "" for name in names)) for row in results],
        ),
    ]
    runs = [row for row in results if "memory" in row["name"]]
    if len(runs) > 1:
        time_, cpu, peak = (runs[-1][name] / runs[0][name] for name in names)
        text += [
            f"Longest over shortest: memory {peak:.3f}, time per frame {time_:.3f}, CPU time {cpu:.3f}.",
            "",
        ]
    rate = next(row["rate"] for row in results if "rate" in row)
    return [*text, f"With reading and writing: {100 * rate:.0f} % of the rate of computation only."]
