#!/usr/bin/env python
"""Write rsvib_torch/motion/readout_times.csv, measured readout times of camera models, from a table of calibrations.

    python scripts/readout_times.py CALIBRATIONS.csv

The calibrations are lens profiles of github.com/gyroflow/lens_profiles (CC0 1.0) that state a readout time, one per
row: brand, model, lens, width, height, fps, readout_ms, direction, file. Users contributed them, and many are wrong. An
entry is left out if it is

* at least 0.99 of the frame period (30 of 50 that have other entries in their mode differ by more than 10 % from the
  median of the others), or 4.89 ms (10 of 10), or 15.99, 19.99, 32.99 or 39.99 ms (16 of 17), defaults or limits;
* below 3 ms: 5 of 7 differ by more than 30 %;
* an automatic estimate (six decimals or more): 19 of 49 differ by more than 10 %; of all others 100 of 497;
* of a picture that is stored upright, whose rows are not those of the sensor, or more than 10 % from the median of its
  mode.

A mode is left out unless most of its entries agree.
"""

import argparse
import csv
import re
from collections import Counter, defaultdict
from pathlib import Path
from statistics import median

TARGET = Path(__file__).resolve().parents[1] / "rsvib_torch" / "motion" / "readout_times.csv"
HEAD = """\
# Measured readout times of camera models, reduced from the lens profiles of https://github.com/gyroflow/lens_profiles
# by scripts/readout_times.py. Licence of the profiles and of this table: CC0 1.0 (public domain dedication).
"""
COLUMNS = ["brand", "model", "lens", "width", "height", "frame_rate", "readout_ms", "spread_ms", "entries", "direction"]
DEFAULTS_MS = (4.89, 15.99, 19.99, 32.99, 39.99)
RATES = (24, 25, 30, 48, 50, 60, 100, 120, 240)  # nominal frame rates
FIELDS_OF_VIEW = ("Wide", "Ultra Wide", "Super", "Linear", "Narrow")  # lenses or crops of cameras with a fixed lens
MIN_SPREAD = 0.03  # of the readout time; modes of one readout (Sony a7S III: 8.7 to 8.92 ms) differ by as much


def letters(text: str) -> str:
    """A name without case, spaces and signs, which users write in many ways."""
    return re.sub(r"[\W_]", "", text.casefold())


def usable(row: dict[str, str]) -> bool:
    """Whether an entry is none of those that are often wrong."""
    readout = abs(float(row["readout_ms"]))
    decimals = len(row["readout_ms"].partition(".")[2])
    at_limit = readout * float(row["fps"]) >= 990 or any(abs(readout - value) < 1e-3 for value in DEFAULTS_MS)
    return readout >= 3 and decimals < 6 and not at_limit and int(row["width"]) >= int(row["height"])


def agreeing(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """The entries within 10 % of the median; none unless they are most of them."""
    middle = median(abs(float(row["readout_ms"])) for row in rows)
    near = [row for row in rows if abs(abs(float(row["readout_ms"])) / middle - 1) <= 0.1]
    return near if 2 * len(near) > len(rows) else []


def nominal_rate(rate: float) -> float:
    """The nominal frame rate within 3 %, or the rate itself."""
    nearest = min(RATES, key=lambda nominal: abs(nominal / rate - 1))
    return nearest if abs(nearest / rate - 1) < 0.03 else round(rate, 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("calibrations", type=Path, help="CSV file with one calibration per row")
    with parser.parse_args().calibrations.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names: defaultdict[str, Counter[tuple[str, str]]] = defaultdict(Counter)
    modes = defaultdict(list)
    for row in filter(usable, rows):
        name = letters(row["brand"] + row["model"])
        names[name][row["brand"], row["model"]] += 1
        modes[name, int(row["width"]), int(row["height"]), nominal_rate(float(row["fps"]))].append(row)
    lines = []
    for (name, *mode), entries in modes.items():
        lenses = {"": entries}
        if not agreeing(entries) and all(row["lens"] in FIELDS_OF_VIEW for row in entries):
            lenses = {
                lens: [row for row in entries if row["lens"] == lens] for lens in {row["lens"] for row in entries}
            }
        for lens, of_lens in lenses.items():
            kept = agreeing(of_lens)
            if not kept:
                continue
            times = [abs(float(row["readout_ms"])) for row in kept]
            middle = median(times)
            spread = max(1.4826 * median(abs(time - middle) for time in times), MIN_SPREAD * middle)
            direction = "forward" if any(row["direction"] == "TopToBottom" for row in kept) else ""
            camera = names[name].most_common(1)[0][0]
            lines.append((*camera, lens, *mode, f"{middle:.6g}", f"{spread:.2g}", len(kept), direction))
    lines.sort(key=lambda line: (line[0].casefold(), line[1].casefold(), *line[2:]))
    with TARGET.open("w", encoding="utf-8", newline="") as file:
        file.write(HEAD)
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows(lines)
    models = {line[:2] for line in lines}
    print(f"{len(rows)} calibrations: {sum(line[8] for line in lines)} in {len(lines)} modes of {len(models)} models")


if __name__ == "__main__":
    main()
