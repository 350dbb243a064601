#!/usr/bin/env python
"""Attack the package: kills, power losses, damaged and crafted files, API misuse, memory limits.

Each attack is a module of scripts/attacks. Its trials are counted by outcome (see attacks/trial.py). The program prints
a table and all failures, and its exit code is 1 if a trial failed. With --store the results replace earlier ones
of the same attacks and seeds in scripts/attacks/results.json, and the table of all is written to docs/reliability.md.
"""

import argparse
import importlib
import itertools
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from attacks.trial import FAILURES, OUTCOMES, Trial
from harness import machine, table, today, with_generated_part

import rsvib_torch as rsv

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
RESULTS = Path(__file__).parent / "attacks" / "results.json"
sys.path.append(str(PAGE.parents[1] / "tests"))  # attacks share cases with the tests


# A new attack is one module in scripts/attacks and one line here. Its ``trials(folder, count, seed)`` runs up to
# ``count`` trials with files in ``folder`` and yields their results; what is drawn at random depends on ``seed`` only.
# Modules are imported when they are used: child processes of the attacks on storage import this file for every trial.
ATTACKS: dict[str, tuple[str, int]] = {  # first column of the table, and number of trials for the page
    "interruptions": ("runs killed, or without power, and resumed", 540),
    "damaged_parts": ("damaged, edited and replaced files of interrupted runs, resumed", 204),
    "inputs": ("outputs that are or contain inputs", 150),
    "concurrent": ("several runs with one output", 45),
    "disks": ("full and read-only disks", 99),
    "live_sessions": ("recordings of a camera", 196),
    "memory": ("`--memory` in different layouts", 15),
    "crafted": ("crafted files", 200),
    "api": ("hostile arguments of Python functions", 4000),
    "mutated": ("randomly damaged files", 2400),
    "spans": ("frames over long time spans", 50),
    "images": ("frames that do not determine a motion", 200),
}


def summary(trials: list[Trial]) -> dict[str, Any]:
    """What is stored of the trials of one attack and seed."""
    counts = Counter(trial.outcome for trial in trials)
    of_outcomes = {outcome: counts[outcome] for outcome in OUTCOMES}
    return {"date": today(), "version": rsv.__version__, "machine": machine()["processor"], "counts": of_outcomes}


def counted(results: dict[str, dict[str, Any]]) -> list[str]:
    """Markdown table of the summaries by attack and seed: one row per attack, one column per outcome."""
    lines = []
    for name, seeds in results.items():
        counts = [sum(one["counts"][outcome] for one in seeds.values()) for outcome in OUTCOMES]
        oldest = min(one["date"] for one in seeds.values())
        lines.append((f"{ATTACKS[name][0]} (`{name}`)", oldest, sum(counts), *counts))
    return table(("attack", "date", "trials", *OUTCOMES), lines)[:-1]


def store(results: dict[str, dict[str, Any]]) -> None:
    """Replace the stored results and the generated part of the page."""
    origin = f"Measured by `python scripts/reliability.py --store` with rsvib_torch {rsv.__version__}."
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    page = with_generated_part(PAGE.read_text(encoding="utf-8"), [origin, "", *counted(results)])
    PAGE.write_text(page, encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=ATTACKS, nargs="+", default=list(ATTACKS), help="attacks (default: all)")
    parser.add_argument("--count", type=int, help="trials of each attack and seed (default: as in docs/reliability.md)")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0], help="each attack runs once per seed of its random numbers"
    )
    parser.add_argument("--store", action="store_true", help="put the results into docs/reliability.md")
    options = parser.parse_args()
    failed = False
    stored: dict[str, Any] = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    latest: dict[str, Any] = {}
    for name, seed in itertools.product(options.only, options.seeds):
        count, begin, trials = options.count or ATTACKS[name][1], time.perf_counter(), []
        with tempfile.TemporaryDirectory(prefix="reliability-") as folder:
            run = importlib.import_module(f"attacks.{name}").trials
            for trial in run(Path(folder), count, seed):
                trials.append(trial)
                if trial.outcome in FAILURES:
                    failed = True
                    print(f"{name}: {trial.outcome}: {trial.name}: {trial.detail}", flush=True)
        print(f"{name}, seed {seed}: {len(trials)} trials in {time.perf_counter() - begin:.0f} s", flush=True)
        latest.setdefault(name, {})[str(seed)] = summary(trials)
        if options.store:  # after each attack: an interrupted run keeps the finished ones
            stored[name] = stored.get(name, {}) | latest[name]
            store({one: stored[one] for one in ATTACKS if one in stored})
    print("\n".join(counted(latest)))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
