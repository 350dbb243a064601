#!/usr/bin/env python
"""Speed and accuracy next to peers, in one run on one machine.

Registration: all bands of a pair of frames, against OpenCV and scikit-image band by band.
Cost: detection in FFT round trips. Detection: errors against the Cramer-Rao bound, and whether error bars cover.
Restoration: one frame, see benchmarks/restoration.py. Pipeline: from a pair of frames to both restored, against chains
of libraries; goals met and missed, see benchmarks/pipeline.py. Scaling: time and memory against size, frames, exposure,
bandwidth and tones. Roofline: bytes and operations of restoration against what the device copies and multiplies.
Streaming: long stacks, see benchmarks/streaming.py.
Memory: asked for and measured, see benchmarks/streaming_memory.py.
Dask: workers of a cluster on this machine, see benchmarks/streaming_dask.py.
"""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from benchmarks import (
    detection,
    detection_cost,
    detection_report,
    pipeline,
    registration,
    restoration,
    roofline,
    scaling,
    streaming,
    streaming_dask,
    streaming_memory,
)
from benchmarks.measure import ENVIRONMENT, add_options, machine

PARTS: dict[str, tuple[Callable[..., list[dict[str, Any]]], Callable[..., list[str]]]] = {
    "registration": (registration.rows, registration.lines),
    "cost": (detection_cost.rows, detection_cost.lines),
    "detection": (detection.rows, detection.lines),
    "restoration": (restoration.rows, restoration.lines),
    "pipeline": (pipeline.rows, pipeline.lines),
    "scaling": (scaling.rows, scaling.lines),
    "roofline": (roofline.rows, roofline.lines),
    "streaming": (streaming.rows, streaming.lines),
    "memory": (streaming_memory.rows, streaming_memory.lines),
    "dask": (streaming_dask.rows, streaming_dask.lines),
}


def machine_line(machine: dict[str, Any]) -> str:
    """What the figures were taken on, in words."""
    libraries = ", ".join(f"{name} {version}" for name, version in machine["libraries"].items())
    load = "" if machine["load"] is None else f" Load at the start: {machine['load']:.1f}."
    pages = "huge pages asked for" if machine["huge_pages"] else "pages of the usual size"
    pages += ", freed memory kept" if machine["kept_memory"] else ""
    cuda = "No CUDA device here: tables are of the CPU alone." if machine["cuda"] is None else f"{machine['cuda']}."
    return (
        f"{machine['cores']} cores ({machine['processor']}), Python {machine['python']}, torch {machine['torch']} on "
        f"{machine['threads']} threads, {libraries}, {pages}.{load} {cuda}"
    )


def in_environment() -> None:
    """Begin anew in the environment that benchmarks run in, where it is another."""
    missing = {name: value for name, value in ENVIRONMENT.items() if name not in os.environ}
    if missing:
        os.environ.update(missing)
        os.execv(sys.executable, sys.orig_argv)


def finite(figures: Any) -> Any:
    """Figures with None for those that are not numbers, which JSON does not know."""
    if isinstance(figures, dict):
        return {name: finite(value) for name, value in figures.items()}
    if isinstance(figures, list | tuple):
        return [finite(value) for value in figures]
    return None if isinstance(figures, float) and not math.isfinite(figures) else figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/benchmark"), help="folder for benchmark.md and .json")
    parser.add_argument("--size", type=int, default=2048, help="rows and columns of the frames (default: 2048)")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each (default: 5)")
    parser.add_argument("--only", choices=PARTS, nargs="+", default=PARTS, help="parts to run (default: all)")
    add_options(parser)
    restoration.add_options(parser)
    pipeline.add_options(parser)
    scaling.add_options(parser)
    detection.add_options(parser)
    streaming.add_options(parser)
    streaming_memory.add_options(parser)
    streaming_dask.add_options(parser)
    options = parser.parse_args()
    torch.set_num_threads(os.cpu_count() or 1)
    summary: dict[str, Any] = {
        "size": options.size,
        "runs": options.runs,
        "machine": machine(),
    }
    text = [machine_line(summary["machine"])]
    print(text[0])
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        rows, lines = PARTS[name]
        begin = time.perf_counter()
        summary[name] = rows(options)
        found = ["", *lines(summary[name], options), "", f"({name}: {time.perf_counter() - begin:.0f} s)"]
        text += found
        # after every part, so that a later one that fails takes nothing away
        stated = json.dumps(finite(summary), indent=1, allow_nan=False)
        (options.out / "benchmark.json").write_text(stated + "\n", encoding="utf-8")
        (options.out / "benchmark.md").write_text("\n".join(text) + "\n", encoding="utf-8")
        print("\n".join(found), flush=True)
    if "detection" in summary:
        detection_report.draw(summary["detection"], options.out)


if __name__ == "__main__":
    in_environment()
    main()
