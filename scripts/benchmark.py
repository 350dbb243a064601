#!/usr/bin/env python
"""Speed and accuracy of the package and of other software, in one run on one machine.

Results are printed as Markdown tables and written to --out; with --store also to scripts/benchmarks/results, from which
scripts/benchmark_page.py generates docs/benchmarks.md. ``--only NAME --help`` lists the options of a section, and
``--quick`` measures a few cases in seconds.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import benchmarks.needed
import harness
import torch
from benchmarks.sections import EARLIER_NAMES, SECTIONS, module_of

__all__ = ["benchmarks", "main"]


def set_environment() -> None:
    """Restart this program with the environment variables of benchmarks, unless they are set."""
    missing = {name: value for name, value in harness.ENVIRONMENT.items() if name not in os.environ}
    if missing:
        os.environ.update(missing)
        os.execv(sys.executable, sys.orig_argv)


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """Options of the command line: those of all sections, and those of the chosen ones."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, add_help=False
    )
    default = [name for name, section in SECTIONS.items() if section.by_default]
    parser.add_argument(
        "--only",
        choices=SECTIONS,
        type=lambda name: EARLIER_NAMES.get(name, name),
        nargs="+",
        default=default,
        help=f"default: {' '.join(default)}",
    )
    chosen = parser.parse_known_args(arguments)[0].only
    parser.add_argument("-h", "--help", action="help", help="print this text")
    parser.add_argument(
        "--out", type=Path, default=Path("out/benchmark"), help="folder of the tables, as Markdown and JSON"
    )
    parser.add_argument("--store", action="store_true", help="store the results for docs/benchmarks.md")
    parser.add_argument("--quick", action="store_true", help="a few cases in seconds")
    parser.add_argument("--size", type=int, default=2048, help="rows and columns of the frames (default: 2048)")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each method (default: 5)")
    there = harness.devices()
    parser.add_argument("--device", choices=there, nargs="+", default=there, help="devices (default: all available)")
    options, quick = {}, {"size": 256, "runs": 1}
    for name in chosen:
        try:
            section = module_of(name)
        except ModuleNotFoundError as error:
            parser.error(f"section {name} needs the package {error.name}")
        options |= section.OPTIONS
        quick |= section.QUICK
    harness.add_options(parser, options)
    if parser.parse_known_args(arguments)[0].quick:
        parser.set_defaults(**quick)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    options = parsed(arguments)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)))
    text = [harness.machine_line(harness.machine())]
    print(text[0])
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        section, begin = module_of(name), time.perf_counter()
        try:
            rows = section.rows(options)
        except ModuleNotFoundError as error:
            raise SystemExit(f"benchmark: section {name} needs the package {error.name}") from error
        seconds = time.perf_counter() - begin
        for folder in (options.out, harness.RESULTS) if options.store else (options.out,):
            harness.write_result(name, rows, options, seconds, folder)
        tables = ["", *section.lines(rows, options), "", f"({name}: {seconds:.0f} s)"]
        text += tables
        (options.out / "benchmark.md").write_text("\n".join(text) + "\n", encoding="utf-8")
        print("\n".join(tables), flush=True)


if __name__ == "__main__":
    set_environment()
    main()
