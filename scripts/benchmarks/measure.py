"""Measurement for all benchmarks: alternating timed runs, medians and ranges, peak memory, and the machine."""

import argparse
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

# Environment variables that must be set before a process starts. PyTorch uses huge pages, as NumPy does by default.
# glibc keeps freed memory of all threads for the next call; virtual machines may take long to provide memory again.
HUGE_PAGES = "THP_MEM_ALLOC_ENABLE"
KEPT = {
    "MALLOC_MMAP_THRESHOLD_": str(1 << 40),
    "MALLOC_TRIM_THRESHOLD_": str(1 << 40),
    "MALLOC_TOP_PAD_": str(1 << 26),
}
ENVIRONMENT = {HUGE_PAGES: "1", **KEPT}
_LIBRARIES = {
    "OpenCV": ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
    "SciPy": ("scipy",),
    "scikit-image": ("scikit-image",),
    "Kornia": ("kornia",),
    "NumPy": ("numpy",),
    "PyLops": ("pylops",),
    "deepinv": ("deepinv",),
    "vidstab": ("vidstab",),
}


@dataclass(frozen=True, eq=False)
class Timed:
    """Timed runs of a task.

    Attributes:
        result: Return value of the task.
        runs: Seconds of each run.
    """

    result: Any
    runs: tuple[float, ...]

    @property
    def seconds(self) -> float:
        """The median."""
        return statistics.median(self.runs)

    def __add__(self, other: "Timed") -> "Timed":
        """Sum of the times of two tasks, run by run; the result is that of the second."""
        return Timed(other.result, tuple(a + b for a, b in zip(self.runs, other.runs, strict=True)))

    def scaled(self, factor: float) -> "Timed":
        """Times multiplied by a factor."""
        return Timed(self.result, tuple(factor * seconds for seconds in self.runs))

    def figures(self) -> dict[str, float]:
        """Median, shortest and longest time."""
        return {"seconds": self.seconds, "seconds_least": min(self.runs), "seconds_most": max(self.runs)}


def shown_seconds(row: dict[str, Any]) -> str:
    """Median and range of ``Timed.figures`` as a cell of a table."""
    return f"{row['seconds']:.3f} ({row['seconds_least']:.3f} to {row['seconds_most']:.3f})"


def seconds_of(work: Callable[[], Any]) -> float:
    """Seconds of one run, including the pending work of a GPU."""
    _finish()
    begin = time.perf_counter()
    work()
    _finish()
    return time.perf_counter() - begin


def _finish() -> None:
    """Wait for a GPU, if it is used."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread: small tensors are slower on several."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def in_turns(works: dict[str, Callable[[], Any]], runs: int) -> dict[str, Timed]:
    """Timed runs of each task; the tasks alternate, so that other load on the machine affects all of them alike."""
    results = {name: work() for name, work in works.items()}  # warm-up
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(max(1, runs)):
        for name, work in works.items():
            seconds[name].append(seconds_of(work))
    return {name: Timed(results[name], tuple(seconds[name])) for name in works}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of all sections."""
    there = devices()
    parser.add_argument(
        "--device",
        choices=there,
        nargs="+",
        default=there,
        help="devices that the package is timed on; peers run on the CPU (default: all available)",
    )


def devices() -> list[str]:
    """Devices of this machine."""
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def named(name: str, device: str) -> str:
    """Name of a task on a device."""
    return name if device == "cpu" else f"{name} on {device}"


def machine() -> dict[str, Any]:
    """Processor, devices, libraries and settings of this machine."""
    return {
        "cores": os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "processor": _processor(),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "huge_pages": os.environ.get(HUGE_PAGES) == "1",
        "kept_memory": all(name in os.environ for name in KEPT),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "libraries": {name: version for name in _LIBRARIES if (version := _version(name)) is not None},
    }


def _processor() -> str:
    """Name of the processor, or of its architecture if the system does not provide the name."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(library: str) -> str | None:
    for distribution in _LIBRARIES[library]:
        try:
            return metadata.version(distribution)
        except metadata.PackageNotFoundError:
            continue
    return None


def plain_environment() -> dict[str, str]:
    """Environment of processes whose memory is measured, without the settings that keep freed memory."""
    return {name: value for name, value in os.environ.items() if name not in KEPT}


_MEMORY_PROBE = """
import re, sys, torch, rsvib_torch as rsv
from pathlib import Path

device, threads, work, num_frames, height, width = sys.argv[1], int(sys.argv[2]), sys.argv[3], *map(int, sys.argv[4:])
torch.set_num_threads(threads)
torch.manual_seed(0)

def memory(name):
    return 1024 * int(re.search(name + r":\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])

def run(num_frames, height, width):
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=max(height, 2048))
    frame = torch.rand(height, width)
    frames = torch.stack([frame.roll(3 * index, -1) for index in range(num_frames)]).to(device)
    begin()
    if work == "detection":
        rsv.detect_vibration(frames, timing)
    else:
        rsv.restore(frames, timing, rsv.Vibration([3.1, 5.2], [50.0, 30.0]), method=work, check=False)

def begin():
    global before
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
    else:
        Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
        before = memory("VmRSS")

run(min(num_frames, 2), 160, 160)
run(num_frames, height, width)
peak = torch.cuda.max_memory_allocated() if device == "cuda" else memory("VmHWM")
print(peak - before)
"""


def peak_memory(work: str, num_frames: int, height: int, width: int, device: str = "cpu") -> float | None:
    """Peak of the additional memory of a task in bytes, measured in a separate process; None if it cannot be measured.

    Args:
        work: ``"detection"``, or a method of restoration.
        num_frames: Frames of the stack.
        height: Rows of a frame.
        width: Columns of a frame.
        device: Device of the frames.
    """
    numbers = [str(number) for number in (num_frames, height, width)]
    command = [sys.executable, "-c", _MEMORY_PROBE, device, str(torch.get_num_threads()), work, *numbers]
    done = subprocess.run(command, env=plain_environment(), capture_output=True, text=True, check=False)
    return float(done.stdout) if done.returncode == 0 else None
