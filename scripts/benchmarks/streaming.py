"""Long stacks: time and memory over the number of frames, and memory limits of all methods.

A few simulated frames are repeated to form long stacks. Every run is a separate process, in which peak memory is
measured.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import Rows, plain_environment, table

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.stacks import process_stack
from rsvib_torch.stacks.memory import memory_needed

OPTIONS = {
    "frames": ((100, 1000), "streaming: lengths of the long stacks"),
    "frame_size": (1024, "streaming: rows and columns of the long stacks"),
    "memory": ("2GB", "streaming: memory of the process for the long stacks"),
    "smaller_size": (512, "streaming: rows and columns of other stacks"),
    "smaller_frames": (29, "streaming: length of the stack for limits of the memory"),
    "windows": ((1, 2), "streaming: windows at once"),
    "methods": (8, "streaming: at most so many options of restoration"),
}
QUICK = {"frames": (22,), "frame_size": 128, "smaller_size": 96, "smaller_frames": 22}
QUICK |= {"windows": (1,), "methods": 1}
_DRAWN, WINDOW = 14, 8  # frames; period of the vibration, and of the stack
DETECTION = {"method": "bands", "tones": 1, "band_step": 32, "search": 8}
RESTORATIONS: list[dict[str, Any]] = [
    {"method": "dewarp"},
    {"method": "banded"},
    {"method": "exact"},
    {"method": "exact", "joint": 3},
    {"method": "exact", "joint": True},
    {"method": "exact", "prior": "edges"},
    {"method": "richardson-lucy"},
]


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


def one_run(source: str, sink: str, size: int, **options: Any) -> dict[str, Any]:
    """Process a stack in this process."""
    common = {"window": WINDOW, "detection": DETECTION, "restoration": RESTORATIONS[0], "full_scale": 4095} | options
    before = time.perf_counter(), time.process_time()
    report = process_stack(source, sink, timing_of(size), **common)
    seconds, cpu = time.perf_counter() - before[0], time.process_time() - before[1]
    return {
        "frames": report.frames,
        "restored_windows": report.restored,
        "windows": report.windows,
        "seconds_a_frame": seconds / report.frames,
        "cpu_seconds_a_frame": cpu / report.frames,
        "peak_memory_gb": peak_memory() / 1e9,
    }


def run_apart(**arguments: Any) -> dict[str, Any]:
    """``one_run`` in a separate process, which is this module as a program."""
    command, folder = [sys.executable, "-m", "benchmarks.streaming", json.dumps(arguments)], Path(__file__).parents[1]
    done = subprocess.run(command, cwd=folder, env=plain_environment(), check=True, capture_output=True, text=True)
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def rows(options: argparse.Namespace) -> Rows:
    """Runs of each length; runs whose limit is the estimated memory of some windows."""
    results: Rows = []
    with tempfile.TemporaryDirectory() as folder:
        source, sink = Path(folder) / "frames.npy", Path(folder) / "out.tif"
        size = options.frame_size
        for count in options.frames:
            write_long(source, count, size)
            run = run_apart(source=str(source), sink=str(sink), size=size, memory=options.memory)
            results.append({"name": f"{count} frames of {size} px, memory {options.memory}", **run})
        size, paths = options.smaller_size, {"source": str(source), "sink": str(sink)}
        write_long(source, options.smaller_frames, size)
        info = rsv.read_stack_info(source)
        for restoration in RESTORATIONS[: options.methods]:
            for count in options.windows:
                asked = memory_needed(info, WINDOW, restoration, count)
                run = run_apart(**paths, size=size, memory=asked, workers=count, restoration=restoration)
                text = ", ".join(f"{key}={value!r}" for key, value in restoration.items())
                results.append({"name": f"{text}; {count} windows at once", "asked_gb": asked / 1e9, **run})
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    columns = {
        "s per frame": "seconds_a_frame",
        "CPU s per frame of this process": "cpu_seconds_a_frame",
        "limit (GB)": "asked_gb",
        "peak (GB)": "peak_memory_gb",
    }
    cells = [(row["name"], *(f"{row[key]:.3f}" if key in row else "" for key in columns.values())) for row in results]
    return [
        f"Frames of 16 bits, windows of {WINDOW}, detection by bands, restoration by dewarp if not stated; frames of "
        f"later runs have {options.smaller_size} x {options.smaller_size} px.",
        "",
        *table(("run", *columns), cells),
    ]


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(one_run(**json.loads(sys.argv[1]))))
