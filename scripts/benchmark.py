#!/usr/bin/env python
"""Speed and accuracy of the package and of other software, in one run on one machine.

Sections (see benchmarks/sections.py): registration, cost, detection, restoration, pipeline, live, video, scaling,
roofline, finer, mosaic, streaming, memory, dask, regularisation, difficulty, slanted_edge, verdict, honesty, timing.
Results are printed as Markdown tables and written to --out; with --store also to scripts/benchmarks/results, from which
scripts/benchmark_page.py generates docs/benchmarks.md.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import torch
from benchmarks import (
    bounded_cost,
    detection,
    detection_report,
    difficulty,
    finer,
    honesty,
    live,
    measure,
    mosaic,
    pipeline,
    regularisation,
    restoration,
    scaling,
    slanted_edge,
    streaming,
    streaming_dask,
    streaming_memory,
    timing_mistakes,
    verdict_roc,
    video,
)
from benchmarks.sections import SECTIONS, machine_line
from benchmarks.store import write_result


def set_environment() -> None:
    """Restart this program with the environment variables of benchmarks, unless they are set."""
    missing = {name: value for name, value in measure.ENVIRONMENT.items() if name not in os.environ}
    if missing:
        os.environ.update(missing)
        os.execv(sys.executable, sys.orig_argv)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=Path("out/benchmark"), help="folder of the tables, as Markdown and JSON"
    )
    parser.add_argument("--store", action="store_true", help="store the results for docs/benchmarks.md")
    parser.add_argument("--size", type=int, default=2048, help="rows and columns of the frames (default: 2048)")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each method (default: 5)")
    default = [name for name, section in SECTIONS.items() if section.by_default]
    parser.add_argument(
        "--only",
        choices=SECTIONS,
        nargs="+",
        default=default,
        help="default: all sections but verdict, honesty and timing",
    )
    for part in (
        measure,
        bounded_cost,
        restoration,
        pipeline,
        live,
        video,
        scaling,
        detection,
        streaming,
        streaming_memory,
        streaming_dask,
        regularisation,
        difficulty,
        finer,
        mosaic,
        slanted_edge,
        verdict_roc,
        honesty,
        timing_mistakes,
    ):
        part.add_options(parser)
    options = parser.parse_args()
    torch.set_num_threads(os.cpu_count() or 1)
    text = [machine_line(measure.machine())]
    print(text[0])
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        begin = time.perf_counter()
        rows = SECTIONS[name].rows(options)
        seconds = time.perf_counter() - begin
        write_result(name, rows, options, seconds, options.out)
        if options.store:
            write_result(name, rows, options, seconds)
        tables = ["", *SECTIONS[name].lines(rows, options), "", f"({name}: {seconds:.0f} s)"]
        text += tables
        (options.out / "benchmark.md").write_text("\n".join(text) + "\n", encoding="utf-8")
        print("\n".join(tables), flush=True)
        if name == "detection":
            detection_report.draw(rows, options.out)


if __name__ == "__main__":
    set_environment()
    main()
