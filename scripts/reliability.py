#!/usr/bin/env python
"""Attack the package: kills, power losses, damaged and crafted files, API misuse, memory limits.

Each attack is a module of scripts/attacks. Its trials are counted by outcome (see attacks/trial.py). The program prints
a table and all failures, and its exit code is 1 if a trial failed. With --store the table is written to
docs/reliability.md.
"""

import argparse
import datetime
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from attacks import (
    concurrent,
    crafted,
    damaged_parts,
    disks,
    inputs,
    journals,
    kills,
    links,
    memory,
    power_losses,
    workers,
)
from attacks.api import api_trials
from attacks.mutated import mutated_trials
from attacks.trial import FAILURES, OUTCOMES, Trial

import rsvib_torch as rsv

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
BEGIN, END = "<!-- begin of the generated table -->", "<!-- end of the generated table -->"


@dataclass(frozen=True)
class Attack:
    """One kind of attack.

    Attributes:
        title: First column of the table.
        trials: ``trials(folder, count, seed)`` runs up to ``count`` trials with files in ``folder`` and yields their
            results; what is drawn at random depends on ``seed`` only.
        count: Number of trials for the table of the page.
    """

    title: str
    trials: Callable[[Path, int, int], Iterator[Trial]]
    count: int


# A new attack is one module in scripts/attacks and one line here.
ATTACKS: dict[str, Attack] = {
    "kills": Attack("runs killed and resumed", kills.trials, 270),
    "power_losses": Attack("power losses, resumed", power_losses.trials, 450),
    "damaged_parts": Attack("damaged parts of interrupted runs, resumed", damaged_parts.trials, 126),
    "journals": Attack("damaged journals", journals.trials, 250),
    "links": Attack("links and foreign files as work folders", links.trials, 110),
    "inputs": Attack("outputs that are or contain inputs", inputs.trials, 250),
    "concurrent": Attack("several runs with one output", concurrent.trials, 45),
    "disks": Attack("full and read-only disks", disks.trials, 69),
    "memory": Attack("`--memory` in different layouts", memory.trials, 17),
    "crafted": Attack("crafted files", crafted.trials, 500),
    "workers": Attack("killed and missing Dask workers", workers.trials, 9),
    "api": Attack("hostile arguments of Python functions", api_trials, 4000),
    "mutated": Attack("randomly damaged files", mutated_trials, 2400),
}


def table(results: dict[str, list[Trial]]) -> list[str]:
    """Markdown table: one row per attack, one column per outcome."""
    lines = ["| attack | trials | " + " | ".join(OUTCOMES) + " |", "|---" * (2 + len(OUTCOMES)) + "|"]
    for name, trials in results.items():
        counts = Counter(trial.outcome for trial in trials)
        cells = [ATTACKS[name].title, str(len(trials)), *(str(counts[outcome]) for outcome in OUTCOMES)]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def store(lines: list[str]) -> None:
    """Replace the generated part of the page."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    date = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
    origin = f"Measured by `python scripts/reliability.py --store` with rsvib_torch {rsv.__version__} on {date}."
    PAGE.write_text("\n".join([before + BEGIN, origin, "", *lines, END + after]), encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=ATTACKS, nargs="+", default=list(ATTACKS), help="attacks (default: all)")
    parser.add_argument("--count", type=int, help="trials of each attack (default: the number of docs/reliability.md)")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything that is drawn at random (default: 0)")
    parser.add_argument("--store", action="store_true", help="write the table to docs/reliability.md")
    options = parser.parse_args()
    results: dict[str, list[Trial]] = {}
    for name in options.only:
        attack, begin = ATTACKS[name], time.perf_counter()
        with tempfile.TemporaryDirectory(prefix="reliability-") as folder:
            results[name] = list(attack.trials(Path(folder), options.count or attack.count, options.seed))
        for trial in results[name]:
            if trial.outcome in FAILURES:
                print(f"{name}: {trial.outcome}: {trial.name}: {trial.detail}", flush=True)
        print(f"{name}: {len(results[name])} trials in {time.perf_counter() - begin:.0f} s", flush=True)
    lines = table(results)
    print("\n".join(lines))
    if options.store:
        store(lines)
    return int(any(trial.outcome in FAILURES for trials in results.values() for trial in trials))


if __name__ == "__main__":
    sys.exit(main())
