#!/usr/bin/env python
"""Calibration with published recordings: frames of a 1000 Hz LED, and a strobe at two exposures.

The recordings are not part of this project. FOLDER holds gyroflow_rollingshutter/frame_example.png (of
github.com/gyroflow/rollingshutter, readout 15.730 +- 0.004 ms published) and hearv_strobe/rolling0.png, rolling1.png
(of github.com/jia-kai/hearv, exposures 1/1000 and 1/4000 s; 15.7 and 18.3 us are published, the latter from the
heights of bands, rows brighter than 10 of 255, at seven exposures, without gamma; this is repeated here).
"""

import argparse
import sys
from pathlib import Path

import torch

import rsvib_torch as rsv

LED = "gyroflow_rollingshutter/frame_example.png"
STROBE = ("hearv_strobe/rolling0.png", "hearv_strobe/rolling1.png")
PUBLISHED, PUBLISHED_ERROR = 15.730, 0.004  # ms


def tallest_band(brightness: torch.Tensor) -> int:
    """Rows of the tallest band that is brighter than 10 of 255."""
    tallest = current = 0
    for lit in (brightness >= 10 / 255).tolist():
        current = current + 1 if lit else 0
        tallest = max(tallest, current)
    return tallest


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    missing = [name for name in (LED, *STROBE) if not (folder / name).is_file()]
    if missing:
        print(f"{folder}: {', '.join(missing)} not there", file=sys.stderr)
        return 2
    frame = rsv.read_stack(folder / LED)
    rows = frame.shape[-2]
    found = rsv.calibrate_row_time(frame, 1000.0, on_fraction=0.5, gamma=2.2)
    plain = rsv.calibrate_row_time(frame, 1000.0)
    print(f"LED: {1e6 * plain.row_time:.4f} +- {1e6 * plain.row_time_std:.4f} us per row")
    for count, name in ((rows - 1, "from the first row to the last"), (rows, "of all rows")):
        readout = 1e3 * plain.row_time * count
        apart = 100 * (readout / PUBLISHED - 1)
        print(f"     readout {name}: {readout:.4f} ms, {apart:+.3f} % from {PUBLISHED} +- {PUBLISHED_ERROR} ms")
    print(f"     exposure 1/{1 / (found.exposure_time or 1):.0f} s, with gamma 2.2 and a square wave")
    strobe = torch.cat([rsv.read_stack(folder / name) for name in STROBE])
    for gamma in (1.0, 1.5):
        found = rsv.calibrate_row_time_by_exposure(strobe, [1 / 1000, 1 / 4000], gamma=gamma)
        result = f"{1e6 * found.row_time:.2f} +- {1e6 * found.row_time_std:.2f} us per row"
        print(f"strobe, with gamma {gamma:g}: {result} (published: 15.7 to 18.3 us)")
    heights = [tallest_band(brightness) for brightness in strobe.mean((1, 3))]
    by_height = 1e6 * (1 / 1000 - 1 / 4000) / (heights[0] - heights[1])
    print(f"        by the heights of bands, {heights[0]} and {heights[1]} rows: {by_height:.2f} us")
    still = strobe.new_full((1, 256, 256), 0.5) + 0.05 * torch.rand(1, 256, 256)
    try:
        rsv.calibrate_row_time(still, 1000.0)
    except ValueError as error:
        print(f"no flicker: refused ({error})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
