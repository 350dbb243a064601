"""Memory limit and measured peak, for every restoration method with one and two windows at a time."""

import argparse
import tempfile
from pathlib import Path
from typing import Any

from benchmarks import streaming
from harness import Rows, table

from rsvib_torch.io import read_stack_info
from rsvib_torch.stacks.memory import memory_needed

OPTIONS = {
    "memory_sizes": ((512,), "memory: rows and columns"),
    "memory_windows": ((1, 2), "memory: windows at once"),
    "memory_methods": (8, "memory: at most so many of the options of restoration"),
}
QUICK = {"memory_sizes": (128,), "memory_windows": (1,), "memory_methods": 1}
RESTORATIONS: list[dict[str, Any]] = [
    {"method": "dewarp"},
    {"method": "banded"},
    {"method": "exact"},
    {"method": "exact", "joint": 3},
    {"method": "exact", "joint": True},
    {"method": "exact", "prior": "edges"},
    {"method": "richardson-lucy"},
    {"method": "richardson-lucy", "joint": 3},
]


def rows(options: argparse.Namespace) -> Rows:
    """Runs whose memory limit is the estimated requirement of one or two windows."""
    results = []
    with tempfile.TemporaryDirectory() as name:
        source, sink = Path(name) / "frames.npy", Path(name) / "out.tif"
        for size in options.memory_sizes:
            streaming.write_long(source, 4 * (streaming.WINDOW - 1) + 1, size)
            info = read_stack_info(source)
            for restoration in RESTORATIONS[: options.memory_methods]:
                for count in options.memory_windows:
                    asked = memory_needed(info, streaming.WINDOW, restoration, count)
                    run = streaming.run_apart(
                        source=str(source),
                        sink=str(sink),
                        size=size,
                        memory=asked,
                        workers=count,
                        restoration=restoration,
                    )
                    results.append(
                        {"size": size, "restoration": restoration, "windows_at_once": count, "asked_gb": asked / 1e9}
                        | run
                    )
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as a Markdown table."""
    cells = []
    for row in results:
        asked, peak = row["asked_gb"], row["peak_memory_gb"]
        how = ", ".join(f"{key}={value!r}" for key, value in row["restoration"].items())
        numbers = (row["windows_at_once"], f"{asked:.2f}", f"{peak:.2f}", f"{100 * peak / asked:.0f} %")
        cells.append((f"{row['size']} x {row['size']}", how, *numbers))
    most = max(row["peak_memory_gb"] / row["asked_gb"] for row in results)
    return [
        f"Memory of a run with windows of {streaming.WINDOW} frames, detection by bands.",
        "",
        *table(("frames", "restoration", "windows at a time", "limit (GB)", "peak (GB)", "peak / limit"), cells),
        f"At most {100 * most:.0f} % of the limit.",
    ]
