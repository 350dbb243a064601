"""How all benchmarks measure: pieces of work in turns, and the machine they ran on."""

import os
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch


def in_turns(works: dict[str, Callable[[], Any]], runs: int) -> dict[str, tuple[float, Any]]:
    """Median time of each piece of work, and its result, all taking turns so that a busy moment hits all alike."""
    results = {name: work() for name, work in works.items()}  # warms up
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(runs):
        for name, work in works.items():
            begin = time.perf_counter()
            work()
            seconds[name].append(time.perf_counter() - begin)
    return {name: (statistics.median(seconds[name]), results[name]) for name in works}


def machine() -> dict[str, Any]:
    """What the figures were taken on."""
    return {
        "cores": os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "processor": platform.processor() or platform.machine(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
